"""The stages `priors` and `views` keep their promises over a real store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.frames import angle_between_directions, true_direction
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.cameras.virtual_video import frame_take, sample_views
from pasdedeux.choreography.duets import duet_torso_basis
from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Manifest, Store, source_credits
from tasks import priors, views
from tasks.priors import read_limits, read_torso_basis
from tasks.stage import Shard, StageInputs
from tests.builders.ingest_runs import judged
from tests.builders.poses import dancers, wild
from tests.builders.storage_rows import MADE_UP, put, take_rows


def put_take(
    store: Store,
    take_id: str,
    *,
    is_prior: bool,
    is_held_out: bool = False,
    frames: int = 60,
    is_built_in: bool = False,
) -> Manifest:
    joints = dancers(sum(map(ord, take_id)), frames).swapaxes(0, 1).reshape(-1, 17, 3)
    columns, facts = take_rows(take_id, 2, frames, is_held_out=is_held_out, pair17_m=joints)
    return put(store, "ingest", take_id, {"poses": columns}, facts | {"is_prior": is_prior, "is_built_in": is_built_in})


def put_annotations(store: Store, name: str, *, persons: int = 2) -> tuple[Manifest, dict[str, np.ndarray]]:
    """Return 30 annotated frames from random views, each with a neighbour kept for velocity, and the true views."""
    count, rows, truth = 30, [], {}
    pairs = dancers(8, count)
    yaws, pitches = sample_views(np.random.default_rng(8), count)
    for index in range(count):
        view = frame_take(
            pairs[index], pairs[index][:, 0], distance_m=4.0, yaw_rad=yaws[index], pitch_rad=pitches[index]
        )
        sequence_id = f"{name}.view{index:03d}"
        truth[sequence_id] = true_direction(pairs[index], view.camera)
        rows += [
            (sequence_id, frame, person, frame == 2, _px(view.camera, pairs[index, person]))
            for frame in (1, 2)
            for person in range(persons)
        ]
    # Rows need not come sorted, and one person of one annotation was hardly seen.
    rows = rows[::-1]
    px = np.array([row[4] for row in rows])
    px[1, 2:] = np.nan
    total = len(rows)
    columns = {
        "sequence_id": [row[0] for row in rows],
        "frame": [row[1] for row in rows],
        "person_id": [row[2] for row in rows],
        "partner_id": [None if row[0].startswith("solo") else 1 - row[2] for row in rows],
        "source_person_id": [row[2] for row in rows],
        "time_s": np.zeros(total),
        "is_key": [row[3] for row in rows],
        "is_virtual": [True] * total,
        "is_held_out": [False] * total,
        "take_id": ["waltz"] * total,
        "take_frame": [0] * total,
        "layout": ["pair17"] * total,
        "keypoints_px": [np.zeros(2)] * total,
        "keypoint_confidence": [np.zeros(1)] * total,
        "pair17_px": px,
        "pair17_confidence": np.isfinite(px).all(axis=-1).astype(float),
        "op14_px": np.zeros((total, 14, 2)),
        "op14_confidence": np.zeros((total, 14)),
    }
    facts = {
        "kind": "sequences",
        "takes": ["waltz"],
        "sequence_ids": sorted(truth),
        "is_held_out": False,
        "purpose": "random_views",
        "num_persons": persons,
    }
    return put(store, "ingest", name, {"annotations": columns}, facts), truth


def _px(camera: PinholeCamera, pose: np.ndarray) -> np.ndarray:
    return camera.project(pose).px


def run(stage: Any, store: Store, manifests: dict[str, list[Manifest]], **parameters: Any) -> list[ArtifactRef]:
    shards: list[Shard] = stage.plan(StageInputs(manifests, seed=1), stage.STAGE.parameters(**parameters))
    return [stage.run_shard(shard, store) for shard in shards]


def test_priors_learn_from_prior_takes_only_and_read_back(tmp_path: Path) -> None:
    store = Store(tmp_path)
    takes = [
        put_take(store, "waltz", is_prior=True),
        put_take(store, "hug", is_prior=False),
        put_take(store, "judo", is_prior=True, is_held_out=True),
    ]
    (ref,) = run(priors, store, {"poses": takes})
    facts = store.manifest(ref).facts
    assert facts["takes"] == ["waltz"]
    assert facts["num_poses"] == 120
    assert facts["valid_share"] > 0.95
    basis = read_torso_basis(store, (ref,))
    assert basis.components_m.shape == (4, 6, 3)
    verdict = judged(store.manifest(ref))
    assert verdict.level is Level.PASS
    assert verdict.value >= verdict.baseline > 0.0
    limits = read_limits(store, [ref])
    assert (limits.lower_rad <= JointLimits.published().lower_rad).all()
    table = store.read(ref, "joint_limits")
    assert list(table["joint"]) == [angle.joint for angle in ANGLES]
    assert source_credits(store, ref) == (MADE_UP,)


def test_limits_are_wide_enough_for_what_prior_takes_show(tmp_path: Path) -> None:
    store, poses = Store(tmp_path), wild(3, 400)
    columns, facts = take_rows("wild", 1, len(poses), pair17_m=poses)
    take = put(store, "ingest", "wild", {"poses": columns}, facts | {"is_prior": True})
    (ref,) = run(priors, store, {"poses": [take]})
    found, published = read_limits(store, [ref]), JointLimits.published()
    widened = published.widened(poses, name="prior takes")
    assert (widened.lower_rad < published.lower_rad).any()
    np.testing.assert_allclose(found.lower_rad, widened.lower_rad, atol=1e-5)
    np.testing.assert_allclose(found.upper_rad, widened.upper_rad, atol=1e-5)


def test_priors_without_prior_takes_are_the_defaults_and_learned_from_nobody(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (ref,) = run(priors, store, {"poses": [put_take(store, "hug", is_prior=False)]})
    facts = store.manifest(ref).facts
    assert facts["takes"] == []
    assert "no prior take" in facts["origin"]
    assert len(read_torso_basis(store, (ref,)).components_m) == 4
    verdict = judged(store.manifest(ref))
    assert "no prior take is named" in verdict.reason
    np.testing.assert_allclose(read_limits(store, [ref]).lower_rad, JointLimits.published().lower_rad, atol=1e-6)


@pytest.mark.parametrize(("frames", "is_learned"), [(4, False), (5, True)])
def test_priors_of_few_poses_are_the_defaults_and_that_is_said(tmp_path: Path, frames: int, is_learned: bool) -> None:
    store = Store(tmp_path)
    (ref,) = run(priors, store, {"poses": [put_take(store, "waltz", is_prior=True, frames=frames)]})
    facts, verdict = store.manifest(ref).facts, judged(store.manifest(ref))
    assert (facts["num_poses"], facts["takes"]) == (2 * frames, ["waltz"])
    if is_learned:
        assert (facts["origin"], verdict.level, verdict.reason) == ("prior takes", Level.PASS, "")
    else:
        assert facts["origin"].endswith(": 8 prior poses are too few")
        assert (verdict.level, verdict.reason) == (Level.WARN, "8 prior poses are too few to learn from; 10 are needed")
        np.testing.assert_array_equal(read_torso_basis(store, (ref,)).mean_m, duet_torso_basis().mean_m)


def test_the_default_basis_is_learned_from_the_duets_unless_those_are_what_it_would_lift(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (elsewhere,) = run(priors, store, {"poses": [put_take(store, "salsa", is_prior=False)]})
    duet = put_take(store, "waltz", is_prior=False, is_built_in=True)
    (on_duets,) = run(priors, store, {"poses": [duet]})
    assert store.manifest(elsewhere).facts["origin"].startswith("built-in duets")
    assert store.manifest(on_duets).facts["origin"].startswith("body proportions")
    learned, proportions = duet_torso_basis(), proportions_torso_basis()
    np.testing.assert_array_equal(read_torso_basis(store, [elsewhere]).mean_m, learned.mean_m)
    np.testing.assert_array_equal(read_torso_basis(store, [on_duets]).mean_m, proportions.mean_m)
    assert np.abs(learned.mean_m - proportions.mean_m).max() > 0.01
    # Without the stage `priors` the rule is the same.
    np.testing.assert_array_equal(read_torso_basis(store, [duet.ref]).mean_m, proportions.mean_m)
    np.testing.assert_array_equal(read_torso_basis(store, []).mean_m, learned.mean_m)


def test_views_are_near_the_true_ones_sorted_and_say_what_they_skipped(tmp_path: Path) -> None:
    store = Store(tmp_path)
    annotations, truth = put_annotations(store, "salon")
    basis = [store.manifest(ref) for ref in run(priors, store, {"poses": [put_take(store, "hug", is_prior=True)]})]
    (ref,) = run(views, store, {"annotations": [annotations], "torso_basis": basis})
    table, facts = store.read(ref, "views"), store.manifest(ref).facts
    assert facts["takes"] == ["hug", "waltz"]
    assert facts["learned_takes"] == ["hug"]
    assert facts["num_annotations"] == 30
    assert facts["num_without_view"] == 1
    verdict = judged(store.manifest(ref))
    assert verdict.level is Level.PASS
    assert 0.9 < verdict.value <= 1.0
    assert facts["skipped"] == [
        "salon.view029: 1 frame skipped, fewer than 4 torso joints of one of the two people were seen"
    ]
    keys = list(zip(table["sequence_id"], table["frame"], table["hypothesis"], strict=True))
    assert keys == sorted(keys)
    assert set(table["frame"]) == {2}
    best = np.flatnonzero(table["hypothesis"] == 0)
    assert len(best) == 29
    errors = [angle_between_directions(table["direction"][row], truth[table["sequence_id"][row]]) for row in best]
    assert np.rad2deg(np.median(errors)) < 10
    weight = np.add.reduceat(table["weight"], best)
    np.testing.assert_allclose(weight, 1.0)


def test_a_take_is_not_lifted_with_a_basis_that_was_learned_from_it(tmp_path: Path) -> None:
    store = Store(tmp_path)
    annotations, _ = put_annotations(store, "salon")
    own = [store.manifest(ref) for ref in run(priors, store, {"poses": [put_take(store, "waltz", is_prior=True)]})]
    (ref,) = run(views, store, {"annotations": [annotations], "torso_basis": own})
    manifest = store.manifest(ref)
    assert manifest.facts["learned_takes"] == []
    assert manifest.facts["torso_basis"] == "built-in duets"
    assert [one.key for one in manifest.inputs] == [annotations.ref.key]


def test_sequences_of_one_person_are_skipped_with_the_reason(tmp_path: Path) -> None:
    store = Store(tmp_path)
    annotations, _ = put_annotations(store, "solo", persons=1)
    (ref,) = run(views, store, {"annotations": [annotations]})
    assert store.manifest(ref).tables["views"].rows == 0
    verdict = judged(store.manifest(ref))
    assert (verdict.level, verdict.reason) == (Level.PASS, "no annotated frame shows two people who are partners")
    skipped = store.manifest(ref).facts["skipped"]
    assert skipped[0] == "solo.view000: 1 frame skipped, nobody has a partner"
    assert skipped[-1] == "10 more sequences: 10 frames skipped, nobody has a partner"


def test_the_same_inputs_give_the_same_bytes_and_a_parameter_changes_the_key(tmp_path: Path) -> None:
    digests, keys = [], []
    for name, distance in (("one", 4.0), ("two", 4.0), ("three", 5.0)):
        store = Store(tmp_path / name)
        annotations, _ = put_annotations(store, "salon")
        (ref,) = run(views, store, {"annotations": [annotations]}, distance_m=distance)
        digests.append(ref.content_digest)
        keys.append(ref.key)
    assert digests[0] == digests[1] != digests[2]
    assert keys[0] == keys[1] != keys[2]


def test_unknown_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="distance"):
        views.ViewsParameters(distance=3.0)  # type: ignore[call-arg]
    with pytest.raises(InputError, match="10 poses"):
        priors.learn_torso_basis(wild(0, 3))
