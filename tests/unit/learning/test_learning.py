"""Ridge models, refinement by the mesh, error measures, and splits."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.augmentation import Augmenter, Source, UserContact, reference_motion, uniform_variations
from pasdedeux.augmentation.energy import fit_terms
from pasdedeux.augmentation.source import complete_scales, points_of
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import PAPER_SCALES, bone_variations, group_variations
from pasdedeux.errors import InputError
from pasdedeux.fitting.terms import total_energy
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.learning.baselines import NaiveFkModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.meter import UNITS, ModelMeter, key_contacts, model_errors
from pasdedeux.learning.model import Training, TrainingItem, VariantModel, VariantRequest
from pasdedeux.learning.registry import ModelDescription, load_model
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.splits import SPLIT_NAMES, VariantKey, make_split
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(6), 30.0, "sway")
ROOTS = Contacts(
    np.array([[[0, 0, 22, 22]]]),
    np.array([[[0.0, 1.0, 0.0, -1.0]]]),
    np.ones((1, 1)),
    np.zeros((1, 1, 2)),
    objects=np.full((1, 1), -1),
    places_m=np.zeros((1, 1, 3)),
)


def _request(take: Source, scale: float) -> VariantRequest:
    (variation,) = uniform_variations([scale], ["A"])
    return VariantRequest(take.name, take, variation.bone_scale)


def _quadratic_items(scales: list[float]) -> list[TrainingItem]:
    linear, square = np.random.default_rng(0).normal(size=(2, *TAKE.positions_m.shape))
    items = []
    for scale in scales:
        motion_m = TAKE.positions_m + linear * (scale - 1.0) + square * (scale - 1.0) ** 2
        items.append(TrainingItem(str(scale), _request(TAKE, scale), motion_m))
    return items


def _keys(takes: list[str]) -> list[VariantKey]:
    """Return keys of every scale; `waltz-1` and `waltz-2` are of one interaction."""
    variations = uniform_variations((0.65, *PAPER_SCALES, 1.3), ["A", "B"])
    return [
        VariantKey(take, variation.variant_id, variation.bone_scale, take.partition("-")[0] if "-" in take else "")
        for take in takes
        for variation in variations
    ]


def _scales(keys: Sequence[VariantKey]) -> set[float]:
    return {round(key.furthest_scale, 2) for key in keys}


def _train_ridge(items: list[TrainingItem]) -> tuple[VariantModel, dict[str, float]]:
    trained = RidgeScaleModel.train(Training(lambda: iter(items)))
    return trained.model, {entry.quantity: entry.value for entry in trained.log}


def test_ridge_recovers_a_quadratic_in_scale_from_two_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pasdedeux.learning.ridge_scale.RIDGE", 1e-9)
    train, test = _quadratic_items([0.95, 1.05]), _quadratic_items([0.75, 1.25])
    model, figures = _train_ridge(train)
    for item in test:
        np.testing.assert_allclose(model.predict(item.request), item.motion_m, atol=1e-4)
    assert figures["num_variants"] == 2
    assert figures["train_error_cm"] < 1e-4


def test_ridge_gives_the_source_at_scale_one() -> None:
    model, _ = _train_ridge(_quadratic_items([0.9, 1.1]))
    np.testing.assert_array_equal(model.predict(VariantRequest("sway", TAKE, np.ones((2, 22)))), TAKE.positions_m)


def test_ridge_tells_limb_groups_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pasdedeux.learning.ridge_scale.RIDGE", 1e-9)
    items = []
    for variation in group_variations([0.8, 0.9, 1.1], ["A"], ["arms", "legs"]):
        request = VariantRequest("sway", TAKE, variation.bone_scale)
        change = variation.bone_scale[0, BODY22.index("left_wrist")] - 1.0
        motion = TAKE.positions_m.copy()
        motion[..., 0] += change
        items.append(TrainingItem(variation.variant_id, request, motion))
    model, _ = _train_ridge(items)
    for group, change in (("arms", 0.2), ("legs", 0.0)):
        (variation,) = group_variations([1.2], ["A"], [group])
        moved = model.predict(VariantRequest("sway", TAKE, variation.bone_scale)) - TAKE.positions_m
        np.testing.assert_allclose(moved, np.broadcast_to([change, 0.0, 0.0], moved.shape), atol=1e-3)


def test_on_an_unseen_take_ridge_learns_what_forward_kinematics_can_tell() -> None:
    items = []
    for variation in uniform_variations([0.8, 0.9, 1.1, 1.2], ["A", "B"]):
        motion = reference_motion(TAKE, variation.bone_scale[None])[0]
        items.append(TrainingItem(variation.variant_id, VariantRequest("sway", TAKE, variation.bone_scale), motion))
    model, _ = _train_ridge(items)
    unseen = Source(swaying_pair(6, seed=9), 30.0, "unseen")
    request = _request(unseen, 0.85)
    truth = reference_motion(unseen, request.bone_scale[None])[0]
    assert model_errors(model.predict(request), truth)["E_r"] < 0.5
    assert model_errors(unseen.positions_m, truth)["E_r"] > 3.0


def test_an_unseen_take_that_is_adapted_to_comes_near_the_solver_at_far_scales() -> None:
    unseen = Source(swaying_pair(6, seed=9), 30.0, "unseen")
    (truth,) = Augmenter(unseen).solve(uniform_variations([0.8], ["A"]))
    ridge, _ = _train_ridge(_quadratic_items([0.9, 1.1]))
    settings = RidgeAdaptedModel.settings()
    model = RidgeAdaptedModel.train(Training(lambda: iter([]), settings=settings, start=ridge)).model
    request = _request(unseen, 0.8)
    adapted, fk = (model_errors(some.predict(request), truth.positions_m)["E_r"] for some in (model, NaiveFkModel()))
    assert adapted < 0.4 * fk
    seen = _request(TAKE, 0.9)
    nearest = seen.with_exact_bones(ridge.predict(seen), is_nearest=True)
    np.testing.assert_array_equal(model.predict(seen), nearest)
    (arms,) = group_variations([0.8], ["A"], ["arms"])
    of_arms = VariantRequest(unseen.name, unseen, arms.bone_scale)
    np.testing.assert_array_equal(model.predict(of_arms), model.predict(of_arms))


def test_the_mesh_goes_on_from_where_a_model_puts_the_pair_and_its_energy_falls() -> None:
    request = _request(TAKE, 0.8)
    problem = build_problem(TAKE)
    targets = build_targets(problem, complete_scales(TAKE, request.bone_scale[None]))
    terms = fit_terms(problem, targets, 0)
    energies = []
    for start in ("naive_fk", "copy"):
        first = load_model(ModelDescription(model=start), {})
        for count in (0, 2, 6, 60):
            settings = MeshRefineModel.settings(num_iterations=count, start=start)
            model = MeshRefineModel.train(Training(lambda: iter([]), settings=settings, start=first)).model
            energies.append(total_energy(terms, points_of(model.predict(request))))
    from_fk, from_copy = energies[:4], energies[4:]
    assert from_fk == sorted(from_fk, reverse=True)
    assert from_copy == sorted(from_copy, reverse=True)
    assert from_fk[0] < from_copy[0]
    assert from_copy[-1] == pytest.approx(from_fk[-1], rel=0.02)
    fk = NaiveFkModel().predict(request)
    assert energies[0] == pytest.approx(total_energy(terms, points_of(fk)))


def test_a_long_take_is_refined_in_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    request = _request(TAKE, 0.8)
    long = Source(swaying_pair(70), 10.0, "sway")
    asked = replace(request, source=long)
    whole = MeshRefineModel(NaiveFkModel(), num_iterations=6).predict(asked)
    monkeypatch.setattr("pasdedeux.learning.mesh_refine.LONGEST_S", 6.5)
    short = MeshRefineModel(NaiveFkModel(), num_iterations=6).predict(asked)
    moved = np.linalg.norm(whole - NaiveFkModel().predict(asked), axis=-1).mean()
    assert np.linalg.norm(short - whole, axis=-1).mean() < 0.1 * moved


def test_a_meter_finds_the_solver_good_and_plain_kinematics_apart_from_it_in_every_respect() -> None:
    (truth,) = Augmenter(TAKE).solve(uniform_variations([0.8], ["A"]))
    request = _request(TAKE, 0.8)
    fk = NaiveFkModel().predict(request)
    meter = ModelMeter(request)
    found = meter.measure(request.bone_scale, {"naive_fk": fk, "same": truth.positions_m}, truth.positions_m)
    solver, plain, same = found["solver"], found["naive_fk"], found["same"]
    assert set(plain) | {"E_r_of_best_baseline"} == set(UNITS)
    assert solver["stance_excursion"] == pytest.approx(1000.0 * truth.quality.stance_excursion_m), "millimetres"
    assert {name: same[name] for name in solver} == solver
    assert {same[name] for name in set(same) - set(solver)} == {0.0}
    assert solver["energy_gap"] == 0.0
    assert plain["energy_gap"] > 5.0
    assert solver["contact_error"] < 0.3 * plain["contact_error"]
    assert plain["E_r"] == model_errors(fk, truth.positions_m)["E_r"]
    assert "wrist" in meter.key_names()


def test_contacts_that_are_known_of_a_take_are_measured_in_place_of_those_found() -> None:
    contact = UserContact(joint_a="head", joint_b="head", stop_frame=6)
    request = VariantRequest("sway", TAKE, np.ones((2, 22)), contacts=(contact,))
    meter = ModelMeter(request)
    assert meter.key_names() == "A's head and B's head"
    lifted = TAKE.positions_m.copy()
    heads = lifted[:, :, BODY22.index("head")]
    heads[:, 0] += 0.01 * normalise(heads[:, 0] - heads[:, 1])
    figures = meter.measure(np.ones((2, 22)), {"lifted": lifted}, TAKE.positions_m)
    assert figures["lifted"]["contact_error"] == pytest.approx(10.0)
    assert figures["lifted"]["JPD"] == pytest.approx(1.0)
    assert figures["solver"]["contact_error"] == pytest.approx(0.0, abs=1e-9)


def test_metrics_are_in_the_papers_units() -> None:
    truth = TAKE.positions_m
    shifted = truth + np.array([0.01, 0.0, 0.0])
    errors = model_errors(shifted, truth, ROOTS)
    assert errors["E_r"] == pytest.approx(1.0)
    assert errors["E_b"] == pytest.approx(0.0, abs=1e-9)
    assert errors["JPD"] == pytest.approx(0.0, abs=1e-9)
    assert errors["PWD"] == pytest.approx(0.0, abs=1e-9)
    one_moved = truth.copy()
    one_moved[:, 1] += np.array([0.0, 0.0, 0.01])
    assert 0.0 < model_errors(one_moved, truth)["PWD"] < 1.0
    stretched, (neck, head) = truth.copy(), BODY22.indices(["neck", "head"])
    stretched[:, 0, head] += (truth[:, 0, head] - truth[:, 0, neck]) * 0.042 / TAKE.lengths_m[0, head]
    assert model_errors(stretched, truth, ROOTS)["E_b"] == pytest.approx(1.0)
    apart = truth.copy()
    apart[:, 1] += 0.02 * (truth[:, 1] - truth[:, 0, :1])
    distance_m = np.linalg.norm(truth[:, 1, 0] - truth[:, 0, 0], axis=-1).mean()
    assert model_errors(apart, truth, ROOTS)["JPD"] == pytest.approx(2.0 * distance_m)


def test_key_pairs_are_those_in_contact_and_none_when_apart() -> None:
    found = key_contacts(TAKE.contacts(), max_pairs=2)
    forearms = set(BODY22.indices(["left_wrist", "right_wrist"]))
    assert found.weights.shape == (1, 2)
    assert set((found.bones() % BODY22.num_joints).ravel().tolist()) <= forearms
    assert key_contacts(Source(swaying_pair(4, apart_m=5.0), 30.0).contacts()).weights.size == 0
    assert np.isnan(model_errors(TAKE.positions_m, TAKE.positions_m)["JPD"])


def test_cross_scale_trains_near_and_tests_far_on_the_same_takes() -> None:
    split = make_split("cross_scale", _keys(["a", "b"]), np.random.default_rng(0))
    assert _scales(split.train) == {0.95, 1.05}
    assert _scales(split.test) == {0.75, 0.8, 0.85, 1.15, 1.2, 1.25}
    assert _scales(split.validation) == {0.9, 1.1}
    assert split.shares_takes


def test_extrapolation_tests_beyond_the_far_scales_and_no_other_split_has_those() -> None:
    split = make_split("extrapolation", _keys(["a", "b"]), np.random.default_rng(0))
    assert _scales(split.train) == {0.95, 1.05}
    assert _scales(split.test) == {0.65, 1.3}
    assert _scales(split.validation) == set(PAPER_SCALES) - {0.95, 1.05}
    for name in set(SPLIT_NAMES) - {"extrapolation"}:
        nearer = make_split(name, _keys(["a", "b"]), np.random.default_rng(0))
        assert not _scales((*nearer.train, *nearer.validation, *nearer.test)) & {0.65, 1.3}


def test_the_scale_of_a_variant_is_that_of_whoever_is_scaled_whichever_bones() -> None:
    for variation in (*uniform_variations([0.8, 1.2], ["A", "B", "AB"]), *bone_variations([0.8, 1.2], ["B"])):
        key = VariantKey("a", variation.variant_id, variation.bone_scale)
        assert f"{key.furthest_scale:.2f}" == variation.variant_id[-4:]


@pytest.mark.parametrize("kind", ["cross_interaction", "cross_scale_interaction"])
@pytest.mark.parametrize("test_takes", [(), ("hug-1", "hug-2"), ("hug-2",), ("waltz-1",)])
def test_swapped_halves_change_places_and_nobody_learns_from_held_out_takes(
    kind: str, test_takes: tuple[str, ...]
) -> None:
    keys = _keys(["hug-1", "hug-2", "judo-1", "waltz-1", "waltz-2", "waltz-3"])

    def sides(name: str, held_out: tuple[str, ...]) -> tuple[set[str], set[str]]:
        split = make_split(name, keys, np.random.default_rng(0), test_takes=test_takes, held_out=held_out)
        assert not split.shares_takes
        learned = {key.take_id for key in (*split.train, *split.validation)}
        return learned, {key.take_id for key in split.test}

    learned, tested = sides(kind, ())
    assert set(test_takes) <= tested
    assert {take.partition("-")[0] for take in learned}.isdisjoint({take.partition("-")[0] for take in tested})
    assert sides(f"{kind}_swapped", ()) == (tested, learned)
    for name in (kind, f"{kind}_swapped"):
        for held_out in ("judo-1", "waltz-2"):
            if (held_out, test_takes) == ("waltz-2", ("waltz-1",)) and name.endswith("swapped"):
                continue  # nothing is left to learn from
            learned, tested = sides(name, (held_out,))
            assert held_out in tested - learned
            assert {take.partition("-")[0] for take in learned}.isdisjoint(take.partition("-")[0] for take in tested)


@pytest.mark.parametrize("name", SPLIT_NAMES)
@pytest.mark.parametrize("num_takes", [2, 3, 7, 9])
def test_no_variant_is_in_two_sets_and_validation_is_never_of_a_tested_take(name: str, num_takes: int) -> None:
    split = make_split(name, _keys([f"take{n}" for n in range(num_takes)]), np.random.default_rng(0))
    sets = [{(key.take_id, key.variant_id) for key in keys} for keys in (split.train, split.validation, split.test)]
    assert all(sets)
    assert sum(map(len, sets)) == len(set.union(*sets))
    if not split.shares_takes:
        assert not {take for take, _ in sets[1]} & {take for take, _ in sets[2]}
        is_of_its_own = not {take for take, _ in sets[0]} & {take for take, _ in sets[1]}
        assert is_of_its_own == (num_takes >= (8 if name.endswith("swapped") else 7))


def test_the_random_split_tests_a_fifth_and_leaves_held_out_takes_out() -> None:
    split = make_split("random", _keys(["a", "b"]), np.random.default_rng(0), test_takes=["b"])
    assert len(split.test) == 4
    assert (len(split.train), len(split.validation)) == (14, 2)
    assert {key.take_id for key in split.train} == {"a"}
    names = {key.variant_id for key in split.train} & {key.variant_id for key in split.test}
    assert not names


def test_the_order_of_variants_does_not_change_a_split() -> None:
    keys = _keys(["a", "b"])
    splits = [make_split("random", some, np.random.default_rng(4)) for some in (keys, keys[::-1])]
    assert [key.variant_id for key in splits[0].test] == [key.variant_id for key in splits[1].test]


def test_what_cannot_be_done_is_said() -> None:
    with pytest.raises(InputError, match="split 'diagonal' is not known"):
        make_split("diagonal", _keys(["a"]), np.random.default_rng(0))
    for takes in (["a"], ["waltz-1", "waltz-2"]):
        with pytest.raises(InputError, match="at least two takes that are not of one interaction"):
            make_split("cross_interaction", _keys(takes), np.random.default_rng(0))
    with pytest.raises(InputError, match="no training variant among 48 variants of 2 takes"):
        make_split("cross_interaction_swapped", _keys(["a", "b"]), np.random.default_rng(0), held_out=["a"])
    with pytest.raises(InputError, match="model 'oracle' is not known"):
        load_model(ModelDescription(model="oracle"), {})
    with pytest.raises(InputError, match="array 'mix' is missing"):
        load_model(ModelDescription(model="ridge_scale"), {})
    with pytest.raises(InputError, match="no variant to train on"):
        _train_ridge([])
    with pytest.raises(InputError, match="the source's is"):
        TrainingItem("v", VariantRequest("sway", TAKE, np.ones((2, 22))), TAKE.positions_m[:3])
    with pytest.raises(InputError, match="not finite"):
        model_errors(TAKE.positions_m * np.nan, TAKE.positions_m)
