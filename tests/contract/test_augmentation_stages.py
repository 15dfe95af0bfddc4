"""The stages augmentation and training on real artifacts in a real store."""

from __future__ import annotations

import hashlib
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flows.study import load_study
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths, forward_kinematics
from pasdedeux.learning.model import VariantRequest
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store
from tasks import augmentation
from tasks.augmentation import AugmentationParameters, batch_of
from tasks.evaluation.augmentation import TOPIC
from tasks.graph import load_graph
from tasks.ingest.parameters import IngestParameters
from tasks.rows.takes import read_take
from tasks.stage import Parameters, Shard, StageInputs
from tasks.summary import stage_verdict
from tasks.training import STAGE as TRAINING
from tasks.training.parameters import TrainingParameters
from tasks.training.run import load_stored, read_arrays
from tests.builders.dying_training import train_until_killed
from tests.builders.ingest_runs import judged
from tests.builders.moving_pairs import standing_person, swaying_people
from tests.builders.storage_rows import put, random_columns, take_rows

FRAMES = 12
Pair = tuple[list[Manifest], list[Manifest]]


def put_take(store: Store, take_id: str, *, num_persons: int = 2, is_held_out: bool = False) -> Manifest:
    people = np.swapaxes(swaying_people(num_persons, FRAMES, seed=len(take_id)), 0, 1).reshape(-1, 22, 3)
    takes = random_columns("takes", num_persons) | {
        "take_id": [take_id] * num_persons,
        "person": np.arange(num_persons),
        "source_sha256": [hashlib.sha256(take_id.encode()).hexdigest()] * num_persons,
        "body22_rest_m": np.stack([standing_person()] * num_persons),
    }
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(people), 22, 1))
    poses, facts = take_rows(
        take_id, num_persons, FRAMES, is_held_out=is_held_out, body22_m=people, body22_world_unitquat=turns
    )
    return put(store, "ingest", take_id, {"takes": takes, "poses": poses}, facts)


def augment(store: Store, takes: list[Manifest], **parameters: Any) -> list[Manifest]:
    inputs = StageInputs({"poses": takes, "takes": takes}, seed=3)
    shards = augmentation.plan(inputs, AugmentationParameters(**parameters))
    return [store.manifest(augmentation.run_shard(shard, store)) for shard in shards]


def test_a_take_without_anybody_who_is_scaled_says_so(store: Store) -> None:
    takes = [put_take(store, "pair"), put_take(store, "alone", num_persons=1)]
    pair, alone = augment(store, takes, scales=(0.8,), persons=("B", "C"))
    verdict = judged(alone)
    assert (verdict.level, verdict.reason) == (Level.WARN, "one person, and nobody of those who are scaled: B, C")
    assert not alone.tables
    assert pair.facts["variants"] == ["B-uniform-0.80"]


def test_how_variants_were_solved_is_part_of_what_they_are_also_where_they_are_the_same(store: Store) -> None:
    """Evaluation and training solve more variants so: of a new store they would get other figures."""
    takes = [put_take(store, "pair")]
    once, again, judged = (
        augment(store, takes, scales=(0.95,), **options)[0]
        for options in ({}, {"groups": ("arms",)}, {"limits": {"jerk_ratio": (50.0, 60.0)}})
    )
    assert once.data_files == again.data_files == judged.data_files
    assert (again.ref == once.ref, judged.ref == once.ref) == (False, True)
    assert batch_of(again).groups == ("arms",)


def test_everybody_of_any_number_gets_a_row_a_frame(store: Store) -> None:
    takes = [put_take(store, "alone", num_persons=1), put_take(store, "trio", num_persons=3)]
    alone, trio = augment(store, takes, scales=(0.8,), persons=("A", "BC", "all"))
    assert alone.facts["variants"] == ["A-uniform-0.80"]
    assert trio.facts["variants"] == ["A-uniform-0.80", "BC-uniform-0.80", "ABC-uniform-0.80"]
    for manifest, people in ((alone, 1), (trio, 3)):
        variants, quality = store.read(manifest.ref, "variants"), store.read(manifest.ref, "variant_quality")
        count = quality.num_rows
        assert variants["person"].tolist() == [*range(people)] * FRAMES * count
        assert variants["frame"].tolist() == np.repeat(np.arange(FRAMES), people).tolist() * count
        assert [len(scales) for scales in quality["uniform_scale"]] == [people] * count
        source = read_take(store, manifest.inputs[0]).source
        motions = variants["body22_m"].reshape(count, FRAMES, people, 22, 3).astype(float)
        for motion, scale in zip(motions, quality["bone_scale"], strict=True):
            wanted = source.lengths_m * scale.reshape(people, 22)
            wanted[:, BODY22.root] = 0.0
            lengths = bone_lengths(BODY22, motion)
            np.testing.assert_allclose(lengths, np.broadcast_to(wanted, lengths.shape), atol=1e-6)
    assert judged(alone).level is Level.PASS


def test_pairs_get_variants_with_figures(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(augmentation, "_PER_SHARD", 3)
    takes = [put_take(store, "pair")]
    made = augment(store, takes, scales=(0.8, 0.95, 1.05, 1.2))
    assert [manifest.facts["takes"] for manifest in made] == [["pair"], ["pair"]]
    assert [len(manifest.facts["variants"]) for manifest in made] == [3, 1]
    variants = store.read(made[0].ref, "variants")
    quality = store.read(made[0].ref, "variant_quality")
    assert variants.num_rows == 3 * FRAMES * 2
    assert list(quality["variant_id"]) == ["A-uniform-0.80", "A-uniform-0.95", "A-uniform-1.05"]
    for column in ("body22_m", "body22_unitquat", "time_s"):
        assert np.isfinite(variants[column]).all()
    np.testing.assert_allclose(np.stack(list(quality["uniform_scale"])), [[0.8, 1.0], [0.95, 1.0], [1.05, 1.0]])
    assert np.all(quality["contact_drift_m"] < quality["contact_drift_fk_m"])
    verdict = judged(made[0])
    assert (verdict.count, verdict.figure, verdict.unit) == (3, "contact drift", "m")
    assert verdict.value == pytest.approx(np.mean(quality["contact_drift_m"]))
    assert verdict.value < verdict.baseline
    whole = stage_verdict(made)
    drifts = [store.read(manifest.ref, "variant_quality")["contact_drift_m"] for manifest in made]
    assert whole is not None
    assert (whole.count, whole.value) == (4, pytest.approx(np.concatenate(drifts).mean())), "however variants are cut"


def test_every_frame_of_every_variant_has_figures_and_a_verdict(store: Store) -> None:
    (made,) = augment(store, [put_take(store, "pair")], scales=(0.8, 1.2))
    frames, quality = store.read(made.ref, "variant_frames"), store.read(made.ref, "variant_quality")
    assert frames.num_rows == 2 * FRAMES
    assert list(frames["frame"]) == [*range(FRAMES)] * 2
    assert set(frames["verdict"]) <= {"pass", "warn", "fail"}
    for row in range(2):
        is_mine = frames["variant_id"] == quality["variant_id"][row]
        assert (frames["verdict"][is_mine] == "warn").sum() == quality["num_warn_frames"][row]
        assert frames["bone_error_m"][is_mine].max() == quality["bone_error_m"][row]


def test_batches_of_earlier_versions_are_read_and_what_is_no_longer_allowed_is_one_sentence(store: Store) -> None:
    (made,) = augment(store, [put_take(store, "pair")], scales=(0.8,))
    stated = {**made.facts["told"], "mesh_smoothing_s": 0.25, "weights": {"stance": 1.0}}
    assert augmentation.batch_of(replace(made, facts={**made.facts, "told": stated})) == augmentation.batch_of(made)
    with pytest.raises(InputError, match=r"variants of take 'pair' were made by an earlier version.*solver.*'bulk'"):
        augmentation.batch_of(replace(made, facts={**made.facts, "told": {**stated, "solver": "descent"}}))


def test_contacts_stated_in_the_study_replace_those_found(store: Store) -> None:
    take = put_take(store, "pair")
    nothing = [
        {"joint_a": a, "joint_b": b, "stop_frame": FRAMES, "weight": 0.0}
        for a in BODY22.joint_names
        for b in BODY22.joint_names
    ]
    (found,) = augment(store, [take], scales=(0.8,))
    (without,) = augment(store, [take], scales=(0.8,), contacts={"pair": nothing})
    counts = [store.read(made.ref, "variant_quality")["num_contact_pairs"][0] for made in (found, without)]
    assert counts[0] > 0
    assert counts[1] == 0
    motions = [store.read(made.ref, "variants")["body22_m"] for made in (found, without)]
    assert np.abs(motions[0] - motions[1]).max() > 0.01
    with pytest.raises(InputError, match="take 'pear' is not there; takes: pair"):
        augment(store, [take], contacts={"pear": nothing[:1]})


def test_the_headline_is_of_the_contacts_that_the_variants_were_made_with(store: Store) -> None:
    take, touch = put_take(store, "pair"), {"joint_a": "left_wrist", "joint_b": "right_wrist", "stop_frame": FRAMES}
    counts = []
    for stated in (
        {},
        {"pair": [{**touch, "weight": 0.0}]},
        {"pair": [touch, {**touch, "joint_a": "head", "weight": 0.0}]},
        {"pair": [{"joint_a": "left_wrist", "object": "floor", "stop_frame": FRAMES}]},
    ):
        inputs = {"poses": [take], "variants": augment(store, [take], scales=(0.8,), contacts=stated)}
        (shard,) = TOPIC.plan(StageInputs(inputs, seed=3), Parameters())
        result = TOPIC.compute(shard, store)
        scores = {(score.metric, score.method): score for score in result.scores}
        counts.append(scores["hand_contact_drift_p95", "interaction_mesh"].count)
        assert [picture.name for picture in TOPIC.pictures(result)] == ["variants-pair.player.json", "drift-pair.svg"]
    assert counts[0] > counts[1] > 0
    assert counts[2] == FRAMES
    assert counts[3] == counts[0]


def test_polished_variants_end_with_descent_and_failures_name_their_frames(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = put_take(store, "pair")
    monkeypatch.setattr("pasdedeux.augmentation.augment.FRAME_LIMITS", {"jerk_ratio": (0.0, 0.0)})
    (made,) = augment(store, [take], scales=(0.8,), solver="polished", limits={"jerk_ratio": (0.0, 0.0)})
    quality = store.read(made.ref, "variant_quality")
    assert list(quality["solver"]) == ["polished"]
    assert list(quality["verdict"]) == ["fail"]
    assert f"{FRAMES} of {FRAMES} frames fail, the first is 0" in quality["reason"][0]
    assert set(store.read(made.ref, "variant_frames")["verdict"]) == {"fail"}


def test_a_broken_off_take_goes_on_where_it_stopped(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(augmentation, "_PER_SHARD", 1)
    take = put_take(store, "pair")
    parameters = AugmentationParameters(scales=(0.8, 0.9, 1.1))
    first, *_ = augmentation.plan(StageInputs({"poses": [take]}, seed=3), parameters)
    augmentation.run_shard(first, store)
    again = augmentation.plan(StageInputs({"poses": [take]}, seed=3), parameters)
    assert [store.find("augmentation", shard.key) is not None for shard in again] == [True, False, False]


def test_the_papers_layout_has_thirty_uniform_and_sixty_other_variants_a_take(store: Store) -> None:
    study, _ = load_study("augmentation_paper", load_graph(), environment={})
    inputs = StageInputs({"poses": [put_take(store, "pair")]}, seed=1)
    shards = augmentation.plan(inputs, study.parameters["augmentation"])
    names = [name for shard in shards for name in shard.parameters.variants]
    beyond = [name for name in names if name.endswith(("-0.65", "-1.30"))]  # for extrapolation alone
    assert len(beyond) == 4
    assert len(set(names)) == len(names) == 94
    assert sum("uniform" in name for name in names) == 34
    assert not any(name.endswith("-1.00") for name in names)


def test_stored_rotations_play_the_variant_on_its_own_skeleton(store: Store) -> None:
    take = put_take(store, "pair")
    (made,) = augment(store, [take], scales=(0.8,))
    variants = store.read(made.ref, "variants")
    scale = store.read(made.ref, "variant_quality")["bone_scale"][0][:22]
    rest = standing_person()
    offsets = (rest - rest[[max(parent, 0) for parent in BODY22.parents]]) * scale[:, None]
    first = variants["body22_m"][variants["person"] == 0].astype(float)
    turns = variants["body22_unitquat"][variants["person"] == 0].astype(float)
    played, _ = forward_kinematics(BODY22, offsets, first[:, 0], turns)
    # The invented skeleton differs from its own rest pose by some millimetres a joint.
    assert np.abs(played - first).max() < 0.08


def plan_training(takes: list[Manifest], variants: list[Manifest], **parameters: Any) -> list[Shard]:
    inputs = StageInputs({"poses": takes, "variants": variants, "variant_quality": variants}, seed=3)
    return TRAINING.plan(inputs, TRAINING.parameters(**parameters))


def train(store: Store, shards: list[Shard]) -> dict[str, Manifest]:
    return {f"{shard.partition} {shard.name}": store.manifest(TRAINING.run_shard(shard, store)) for shard in shards}


@pytest.fixture
def pair(store: Store) -> Pair:
    """Return a take to train on and its variants."""
    takes = [put_take(store, "one")]
    return takes, augment(store, takes)


def test_held_out_takes_and_those_that_are_no_pair_are_never_trained_on(store: Store) -> None:
    takes = [put_take(store, "one"), put_take(store, "second"), put_take(store, "held", is_held_out=True)]
    takes.append(put_take(store, "trio", num_persons=3))
    variants = augment(store, takes)
    shards = plan_training(takes, variants, models=("ridge_scale",), splits=("cross_scale", "cross_interaction"))
    made = train(store, shards)
    scale, interaction = made["cross_scale ridge_scale"], made["cross_interaction ridge_scale"]
    assert scale.facts["takes"] == interaction.facts["takes"] == ["one", "second"]
    assert scale.facts["shares_takes"]
    assert set(scale.facts["test"]) == {"one", "second"}
    assert set(interaction.facts["test"]) == {"held"}
    assert set(interaction.facts["validation"]) <= {"one", "second"}
    assert not interaction.facts["shares_takes"]


def test_a_stored_model_predicts(store: Store, pair: Pair) -> None:
    takes, variants = pair
    made = train(store, plan_training(takes, variants))
    source = read_take(store, takes[0].ref).source
    quality = store.read(variants[0].ref, "variant_quality")
    motions = store.read(variants[0].ref, "variants")["body22_m"].reshape(-1, FRAMES, 2, 22, 3)
    errors = {}
    for name in ("copy", "naive_fk", "ridge_scale"):
        model = load_stored(store, made[f"cross_scale {name}"])
        predicted = model.predict(VariantRequest("one", source, quality["bone_scale"][1].reshape(2, 22)))
        errors[name] = float(np.linalg.norm(predicted - motions[1], axis=-1).mean())
    assert errors["ridge_scale"] < 0.8 * errors["naive_fk"]
    assert errors["ridge_scale"] < 0.8 * errors["copy"]
    log = store.read(made["cross_scale ridge_scale"].ref, "training_log")
    assert "train_error_cm" in list(log["quantity"])


def test_a_model_is_compared_on_validation_beside_the_better_baseline(store: Store, pair: Pair) -> None:
    takes, variants = pair
    made = train(store, plan_training(takes, variants))
    ridge, copied = (judged(made[f"cross_scale {name}"]) for name in ("ridge_scale", "copy"))
    assert (ridge.figure, ridge.unit, ridge.count) == ("joint error of validation variants", "cm", 2)
    assert (ridge.level, ridge.reason) == ("not judged", "only 1 s of motion or stills to compare; 10 are needed")
    assert ridge.baseline_name == "plain forward kinematics", "copy is far off where bones change"
    assert ridge.value < ridge.baseline
    assert (copied.level, copied.figure) == (Level.PASS, ""), "what others are judged by is not judged"
    between = {"A-uniform-0.90", "A-uniform-1.10"}
    assert set(made["cross_scale ridge_scale"].facts["validation"]["one"]) == between
    near = augment(store, takes, scales=(0.8, 0.95, 1.05))
    (alone,) = train(store, plan_training(takes, near, models=("ridge_scale",))).values()
    assert "nothing is said" in judged(alone).reason


def test_adding_a_model_or_a_split_leaves_the_others_keys_alone(store: Store) -> None:
    takes = [put_take(store, "one"), put_take(store, "second")]
    variants = augment(store, takes)
    some = plan_training(takes, variants, models=("copy", "naive_fk"))
    refining = {
        name: {"models": ["mesh_refine"], "mesh_refine": {"num_iterations": count}}
        for name, count in (("near", 1), ("far", 9))
    }
    splits = ("cross_scale", "cross_interaction")
    more = plan_training(takes, variants, models=("copy", "naive_fk"), sweep=refining, splits=splits)
    assert {shard.key for shard in some} < {shard.key for shard in more}
    assert len(more) == 8
    made = train(store, more)
    configs = [made[f"cross_scale {name}"].facts["description"]["config"] for name in refining]
    assert configs == [{"num_iterations": 1}, {"num_iterations": 9}]


def test_variants_that_failed_are_tested_on_and_not_learned_from(store: Store, pair: Pair) -> None:
    takes, variants = pair
    quality = store.read(variants[0].ref, "variant_quality")
    drift = dict(zip(quality["variant_id"], quality["contact_drift_p95_m"], strict=True))
    near = sorted(("A-uniform-0.95", "A-uniform-1.05"), key=lambda name: float(drift[name]))
    between = float(np.mean([drift[name] for name in near]))
    variants = augment(store, takes, limits={"contact_drift_p95_m": (0.0, between)})
    (made,) = train(store, plan_training(takes, variants, models=("ridge_scale",))).values()
    assert made.facts["train"] == {"one": near[:1]}
    failed = [row for row, name in enumerate(quality["variant_id"]) if drift[name] > between]
    assert len(failed) > 1
    assert len(made.facts["test"]["one"]) == 6
    all_fail = augment(store, takes, limits={"contact_drift_p95_m": (0.0, 0.0)})
    with pytest.raises(InputError, match="every variant that it would learn from failed"):
        train(store, plan_training(takes, all_fail, models=("ridge_scale",)))


def test_networks_are_trained_by_segments_to_the_same_bytes_when_killed(store: Store, tmp_path: Path) -> None:
    chosen: dict[str, Any] = {
        "models": ("paper_cvae", "ridge_adapted"),
        "paper_cvae": {"num_steps": 3, "segment_steps": 2},
    }
    killed = Store(tmp_path / "other")
    done: list[list[Manifest]] = []
    for place in (store, killed):
        takes = [put_take(place, "one")]
        shards = plan_training(takes, augment(place, takes), **chosen)
        names = ["paper_cvae-segment0", "paper_cvae-segment1", "ridge_scale", "ridge_adapted"]
        assert [shard.name for shard in shards] == names
        if place is killed:
            assert train_until_killed(shards, place.root, step=3) == -signal.SIGKILL
            assert [shard.name for shard in shards if place.find("training", shard.key)] == names[:1]
        done.append(
            [place.find("training", shard.key) or place.manifest(TRAINING.run_shard(shard, place)) for shard in shards]
        )
    assert [made.ref for made in done[0]] == [made.ref for made in done[1]]
    tables = [(set(made.tables) - {"training_log"}).pop() for made in done[0]]
    assert tables == ["model_states", "models", "models", "models"]
    assert {values.dtype for values in read_arrays(store, done[0][1].ref).values()} >= {np.dtype(np.float32)}
    assert read_arrays(store, done[0][-1].ref)["built_on/mix"].dtype == np.float64
    steps = [set(store.read(made.ref, "training_log")["step"]) - {0} for made in done[0]]
    assert steps == [{2}, {3}, set(), set()]


def test_what_is_planned_does_not_depend_on_whether_torch_is_there_and_its_lack_is_one_sentence(
    store: Store, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = {"refined": {"models": ["mesh_refine"], "mesh_refine": {"start": "paper_cvae"}}}
    here = plan_training(*pair, models=("copy",), sweep=sweep)
    monkeypatch.setattr("pasdedeux.learning.settings.find_spec", lambda name: None)
    without_torch = plan_training(*pair, models=("copy",), sweep=sweep)
    assert [shard.key for shard in without_torch] == [shard.key for shard in here]
    (net,) = (shard for shard in here if shard.name == "paper_cvae-segment0")
    with pytest.raises(InputError, match=r"paper_cvae needs torch, .*\[learning\]', .* --set training.models"):
        TRAINING.run_shard(net, store)


def test_a_split_that_leaves_nothing_is_refused_while_planning(store: Store) -> None:
    takes = [put_take(store, "one")]
    variants = augment(store, takes, scales=(0.95, 1.05))
    with pytest.raises(InputError, match=r"0\.75 to 0\.85 or 1\.15 to 1\.25"):
        plan_training(takes, variants)
    with pytest.raises(InputError, match="at least two takes"):
        plan_training(takes, variants, splits=("cross_interaction",))


def test_models_that_cannot_be_are_refused_whatever_the_takes() -> None:
    wrong = TRAINING.parameters(sweep={"other": {"skeleton": "expi18", "models": ["copy", "ridge_adapted"]}})
    assert TRAINING.check_study is not None
    with pytest.raises(InputError, match="'ridge_adapted_other' is of body22 alone; of expi18 can be"):
        TRAINING.check_study({"training": wrong})


def test_a_sweep_trains_its_models_on_splits_a_skeleton_and_seeds_of_its_own(store: Store) -> None:
    takes = [put_take(store, "one"), put_take(store, "two")]
    variants = augment(store, takes)
    again = {"models": ["actor_like"], "seeds": [0, 2], "splits": ["cross_interaction"], "actor_like": {"num_steps": 1}}
    small = {"models": ["copy", "ridge_scale"], "skeleton": "expi18", "splits": ["cross_interaction"]}
    shards = plan_training(
        takes, variants, models=("ridge_scale",), splits=("cross_scale",), sweep={"again": again, "on18": small}
    )
    names = ("again", "again_seed2", "copy_on18", "ridge_scale_on18")
    assert {(shard.partition, shard.name) for shard in shards} == {
        ("cross_scale", "ridge_scale"),
        *(("cross_interaction", name) for name in names),
    }
    made = train(store, shards)
    facts = {name: made[f"cross_interaction {name}"].facts for name in ("again", "again_seed2", "copy_on18")}
    assert [known["skeleton"] for known in facts.values()] == ["body22", "body22", "expi18"]
    first, second = (read_arrays(store, made[f"cross_interaction {name}"].ref) for name in ("again", "again_seed2"))
    assert not np.array_equal(first["pose.weight"], second["pose.weight"])


def test_only_takes_of_two_people_count_for_the_splits_of_a_study() -> None:
    def check(*duets: str, alone: bool = False, **training: Any) -> None:
        takes = [{"id": "alone", "files": ["walk.bvh"]}] if alone else []
        ingest = {"duets": [{"name": name} for name in duets], "takes": takes}
        assert TRAINING.check_study is not None
        TRAINING.check_study(
            {
                "ingest": IngestParameters.model_validate(ingest),
                "augmentation": augmentation.AugmentationParameters(),
                "training": TRAINING.parameters(**training),
            }
        )

    across = {"splits": ("cross_interaction",)}
    check("trio", alone=True, **across)
    check("waltz", "hug", "trio", **across)
    with pytest.raises(InputError, match="no test variant among 10 variants of 1 take; it needs variants of at least"):
        check("waltz", "trio", alone=True, **across)
    with pytest.raises(InputError, match="'trio' is no take of two people with variants; there are: hug, waltz"):
        check("waltz", "hug", "trio", test_takes=("trio",), **across)


@pytest.mark.parametrize(
    "parameters",
    [
        {"scales": (0.0,)},
        {"scales": (-1.0,)},
        {"grid": {"start": 1.2, "stop": 0.8, "step": 0.1}},
        {"groups": ("wings",)},
        {"persons": ("cat",)},
        {"kinds": ("spiral",)},
        {"limits": {"nonsense": (1, 2)}},
        {"contacts": {"pair": [{"joint_a": "nose", "joint_b": "head", "stop_frame": 3}]}},
        {"contacts": {"pair": [{"joint_a": "head", "joint_b": "head", "start_frame": 3, "stop_frame": 3}]}},
    ],
)
def test_parameters_that_are_not_allowed_are_refused(parameters: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        AugmentationParameters(**parameters)


def test_models_and_sweeps_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValidationError, match="known models"):
        TrainingParameters(models=("oracle",))
    refined = {"models": ["mesh_refine"], "mesh_refine": {"start": "copy"}, "splits": ["random"]}
    with pytest.raises(InputError, match="'refined' starts from 'copy', which is not trained on random"):
        TrainingParameters(sweep={"refined": refined}).named()
    with pytest.raises(InputError, match=r"augmentation\.sweep\.again makes A-uniform-0\.80, which augm"):
        augmentation.variations(AugmentationParameters(scales=(0.8,), sweep={"again": {"solver": "polished"}}), 2)
