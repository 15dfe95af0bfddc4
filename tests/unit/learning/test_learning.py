from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.augmentation import (
    Augmenter,
    Source,
    UserContact,
    reference_motion,
    uniform_variations,
)
from pasdedeux.augmentation.energy import fit_terms
from pasdedeux.augmentation.source import complete_scales, points_of
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import PAPER_SCALES, bone_variations, group_variations
from pasdedeux.errors import InputError
from pasdedeux.fitting.terms import total_energy
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.learning.baselines import NaiveFkModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.meter import UNITS, ModelMeter, key_contacts, model_errors
from pasdedeux.learning.model import Training, TrainingItem, VariantModel, VariantRequest
from pasdedeux.learning.registry import ModelDescription, describe_model, load_model, model_arrays
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


def _quadratic_items(scales: list[float], seed: int = 0) -> list[TrainingItem]:
    generator = np.random.default_rng(seed)
    linear, square = generator.normal(size=(2, *TAKE.positions_m.shape))
    items = []
    for variation in uniform_variations(scales, ["A"]):
        change = variation.bone_scale[0, 1] - 1.0
        motion = TAKE.positions_m + linear * change + square * change**2
        request = VariantRequest("sway", TAKE, variation.bone_scale)
        items.append(TrainingItem(variation.variant_id, request, motion))
    return items


def _keys(takes: list[str]) -> list[VariantKey]:
    """Return keys of every scale; of `waltz-1` and `waltz-2` both are waltzes."""
    found = uniform_variations((0.65, *PAPER_SCALES, 1.3), ["A", "B"])
    kinds = {take: take.partition("-")[0] if "-" in take else "" for take in takes}
    return [VariantKey(take, one.variant_id, one.bone_scale, kinds[take]) for take in takes for one in found]


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
    (arms,) = group_variations([1.2], ["A"], ["arms"])
    (legs,) = group_variations([1.2], ["A"], ["legs"])
    moved = model.predict(VariantRequest("sway", TAKE, arms.bone_scale)) - TAKE.positions_m
    np.testing.assert_allclose(moved[..., 0], 0.2, atol=1e-3)
    still = model.predict(VariantRequest("sway", TAKE, legs.bone_scale)) - TAKE.positions_m
    np.testing.assert_allclose(still, 0.0, atol=1e-3)


def test_on_an_unseen_take_ridge_learns_what_forward_kinematics_can_tell() -> None:
    items = []
    for variation in uniform_variations([0.8, 0.9, 1.1, 1.2], ["A", "B"]):
        motion = reference_motion(TAKE, variation.bone_scale[None])[0]
        items.append(TrainingItem(variation.variant_id, VariantRequest("sway", TAKE, variation.bone_scale), motion))
    model, _ = _train_ridge(items)
    other = Source(swaying_pair(6, seed=9), 30.0, "other")
    (variation,) = uniform_variations([0.85], ["A"])
    truth = reference_motion(other, variation.bone_scale[None])[0]
    predicted = model.predict(VariantRequest("other", other, variation.bone_scale))
    assert model_errors(predicted, truth)["E_r"] < 0.5
    copied = model_errors(other.positions_m, truth)["E_r"]
    assert copied > 3.0


def _request(take: Source, scale: float, person: str = "A") -> VariantRequest:
    (variation,) = uniform_variations([scale], [person])
    return VariantRequest(take.name, take, variation.bone_scale)


def test_an_unseen_take_that_is_adapted_to_comes_near_the_solver_at_far_scales() -> None:
    other = Source(swaying_pair(6, seed=9), 30.0, "other")
    (truth,) = Augmenter(other).solve(uniform_variations([0.8], ["A"]))
    ridge, _ = _train_ridge(_quadratic_items([0.9, 1.1]))
    settings = RidgeAdaptedModel.settings()
    model = RidgeAdaptedModel.train(Training(lambda: iter([]), settings=settings, start=ridge)).model
    request = _request(other, 0.8)
    adapted, fk = (model_errors(one.predict(request), truth.positions_m)["E_r"] for one in (model, NaiveFkModel()))
    assert adapted < 0.4 * fk
    seen = _request(TAKE, 0.9)
    nearest = seen.with_exact_bones(ridge.predict(seen), is_nearest=True)
    np.testing.assert_array_equal(model.predict(seen), nearest)
    (arms,) = group_variations([0.8], ["A"], ["arms"])
    of_arms = model.predict(VariantRequest(other.name, other, arms.bone_scale))
    np.testing.assert_array_equal(model.predict(VariantRequest(other.name, other, arms.bone_scale)), of_arms)
    again = load_model(describe_model(model), model_arrays(model))
    np.testing.assert_array_equal(again.predict(request), model.predict(request))


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
    variation = uniform_variations([0.8], ["A"])[0]
    (truth,) = Augmenter(TAKE).solve([variation])
    request = VariantRequest("sway", TAKE, variation.bone_scale)
    fk = NaiveFkModel().predict(request)
    meter = ModelMeter(request)
    found = meter.measure(variation.bone_scale, {"naive_fk": fk, "same": truth.positions_m}, truth.positions_m)
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
    heads[:, 0] += 0.01 * (heads[:, 0] - heads[:, 1]) / np.linalg.norm(heads[:, 0] - heads[:, 1], axis=-1)[:, None]
    found = meter.measure(np.ones((2, 22)), {"lifted": lifted}, TAKE.positions_m)
    assert found["lifted"]["contact_error"] == pytest.approx(10.0)
    assert found["lifted"]["JPD"] == pytest.approx(1.0)
    assert found["solver"]["contact_error"] == pytest.approx(0.0, abs=1e-9)


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
    stretched = truth.copy()
    stretched[:, 0, BODY22.index("head")] += (truth[:, 0, BODY22.index("head")] - truth[:, 0, BODY22.index("neck")]) * (
        0.042 / TAKE.lengths_m[0, BODY22.index("head")]
    )
    assert model_errors(stretched, truth, ROOTS)["E_b"] == pytest.approx(1.0)
    apart = truth.copy()
    apart[:, 1] += 1.02 * (truth[:, 1] - truth[:, 0, :1]) - (truth[:, 1] - truth[:, 0, :1])
    assert model_errors(apart, truth, ROOTS)["JPD"] == pytest.approx(
        2.0 * np.linalg.norm(truth[:, 1, 0] - truth[:, 0, 0], axis=-1).mean()
    )


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
        other = make_split(name, _keys(["a", "b"]), np.random.default_rng(0))
        assert not _scales((*other.train, *other.validation, *other.test)) & {0.65, 1.3}


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
        told = {"test_takes": test_takes, "held_out": held_out}
        split = make_split(name, keys, np.random.default_rng(0), **told)
        learned = {key.take_id for key in (*split.train, *split.validation)}
        return learned, {key.take_id for key in split.test}

    learned, tested = sides(kind, ())
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


@pytest.mark.parametrize("name", ["cross_interaction", "cross_scale_interaction"])
def test_splits_across_interactions_share_no_take(name: str) -> None:
    for test_takes in ((), ("a",)):
        split = make_split(name, _keys(["a", "b", "c"]), np.random.default_rng(0), test_takes=test_takes)
        assert not {key.take_id for key in split.train} & {key.take_id for key in split.test}
        assert not split.shares_takes
        assert set(test_takes) <= {key.take_id for key in split.test}


def test_the_random_split_tests_a_fifth_and_leaves_held_out_takes_out() -> None:
    split = make_split("random", _keys(["a", "b"]), np.random.default_rng(0), test_takes=["b"])
    assert len(split.test) == 4
    assert (len(split.train), len(split.validation)) == (14, 2)
    assert {key.take_id for key in split.train} == {"a"}
    names = {key.variant_id for key in split.train} & {key.variant_id for key in split.test}
    assert not names


def test_the_order_of_variants_does_not_change_a_split() -> None:
    keys = _keys(["a", "b"])
    one = make_split("random", keys, np.random.default_rng(4))
    other = make_split("random", keys[::-1], np.random.default_rng(4))
    assert [key.variant_id for key in one.test] == [key.variant_id for key in other.test]


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
