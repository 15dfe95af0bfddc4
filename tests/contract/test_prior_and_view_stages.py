"""The stages `priors` and `views` keep their promises over a real store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.frames import angle_between_directions, true_direction
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.cameras.virtual_video import frame_take, sample_views
from pasdedeux.choreography.duets import duet_torso_basis
from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store, source_credits
from tasks import priors, views
from tasks.priors import read_limits, read_torso_basis
from tasks.stage import Shard, StageInputs
from tests.builders.ingest_runs import judged
from tests.builders.poses import dancers, wild
from tests.builders.storage_rows import MADE_UP, put, random_columns, take_rows


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


def put_annotations(store: Store, name: str, *, num_persons: int = 2) -> tuple[Manifest, dict[str, np.ndarray]]:
    """Return 30 annotated frames from random views, each with a neighbour kept for velocity, and the true views."""
    count, truth, pixels = 30, {}, []
    pairs = dancers(8, count)
    for index, (yaw_rad, pitch_rad) in enumerate(zip(*sample_views(np.random.default_rng(8), count), strict=True)):
        pair = pairs[index]
        camera = frame_take(pair, pair[:, 0], distance_m=4.0, yaw_rad=yaw_rad, pitch_rad=pitch_rad).camera
        truth[f"{name}.view{index:03d}"] = true_direction(pair, camera)
        pixels += 2 * [camera.project(person).px for person in pair[:num_persons]]
    # Rows need not come sorted, and one person of one annotation was hardly seen.
    px = np.array(pixels[::-1])
    px[1, 2:] = np.nan
    total = len(px)
    person = np.tile(np.arange(num_persons)[::-1], 2 * count)
    frame = np.tile(np.repeat([2, 1], num_persons), count)
    columns = random_columns("annotations", total) | {
        "sequence_id": np.repeat(sorted(truth, reverse=True), 2 * num_persons).tolist(),
        "frame": frame,
        "person_id": person,
        "partner_id": (1 - person if num_persons == 2 else [None] * total),
        "is_key": frame == 2,
        "is_held_out": [False] * total,
        "take_id": ["waltz"] * total,
        "pair17_px": px,
        "pair17_confidence": np.isfinite(px).all(axis=-1).astype(float),
        "focal_px": [None] * total,
    }
    facts = {"kind": "sequences", "takes": ["waltz"], "sequence_ids": sorted(truth), "is_held_out": False}
    facts |= {"purpose": "random_views", "num_persons": num_persons}
    return put(store, "ingest", name, {"annotations": columns}, facts), truth


def run(stage: Any, store: Store, manifests: dict[str, list[Manifest]], **parameters: Any) -> list[Manifest]:
    shards: list[Shard] = stage.plan(StageInputs(manifests, seed=1), stage.STAGE.parameters(**parameters))
    return [store.manifest(stage.run_shard(shard, store)) for shard in shards]


def test_priors_learn_from_prior_takes_only_and_read_back(store: Store) -> None:
    takes = [
        put_take(store, "waltz", is_prior=True),
        put_take(store, "hug", is_prior=False),
        put_take(store, "judo", is_prior=True, is_held_out=True),
    ]
    (made,) = run(priors, store, {"poses": takes})
    assert (made.facts["takes"], made.facts["num_poses"]) == (["waltz"], 120)
    assert made.facts["valid_share"] > 0.95
    assert read_torso_basis(store, (made.ref,)).components_m.shape == (4, 6, 3)
    verdict = judged(made)
    assert verdict.level is Level.PASS
    assert verdict.value >= verdict.baseline > 0.0
    limits = read_limits(store, [made.ref])
    assert (limits.lower_rad <= JointLimits.published().lower_rad).all()
    assert list(store.read(made.ref, "joint_limits")["joint"]) == [angle.joint for angle in ANGLES]
    assert source_credits(store, made.ref) == (MADE_UP,)


def test_limits_are_wide_enough_for_what_prior_takes_show(store: Store) -> None:
    poses = wild(3, 400)
    columns, facts = take_rows("wild", 1, len(poses), pair17_m=poses)
    take = put(store, "ingest", "wild", {"poses": columns}, facts | {"is_prior": True})
    (made,) = run(priors, store, {"poses": [take]})
    found, published = read_limits(store, [made.ref]), JointLimits.published()
    widened = published.widened(poses, name="prior takes")
    assert (widened.lower_rad < published.lower_rad).any()
    np.testing.assert_allclose(found.lower_rad, widened.lower_rad, atol=1e-5)
    np.testing.assert_allclose(found.upper_rad, widened.upper_rad, atol=1e-5)


def test_priors_without_prior_takes_are_the_defaults_and_learned_from_nobody(store: Store) -> None:
    (made,) = run(priors, store, {"poses": [put_take(store, "hug", is_prior=False)]})
    assert made.facts["takes"] == []
    assert "no prior take" in made.facts["origin"]
    assert len(read_torso_basis(store, (made.ref,)).components_m) == 4
    assert "no prior take is named" in judged(made).reason
    np.testing.assert_allclose(read_limits(store, [made.ref]).lower_rad, JointLimits.published().lower_rad, atol=1e-6)


@pytest.mark.parametrize(("frames", "is_learned"), [(4, False), (5, True)])
def test_priors_of_few_poses_are_the_defaults_and_that_is_said(store: Store, frames: int, is_learned: bool) -> None:
    (made,) = run(priors, store, {"poses": [put_take(store, "waltz", is_prior=True, frames=frames)]})
    facts, verdict = made.facts, judged(made)
    assert (facts["num_poses"], facts["takes"]) == (2 * frames, ["waltz"])
    if is_learned:
        assert (facts["origin"], verdict.level, verdict.reason) == ("prior takes", Level.PASS, "")
    else:
        assert facts["origin"].endswith(": 8 prior poses are too few")
        assert (verdict.level, verdict.reason) == (Level.WARN, "8 prior poses are too few to learn from; 10 are needed")
        np.testing.assert_array_equal(read_torso_basis(store, (made.ref,)).mean_m, duet_torso_basis().mean_m)


def test_the_default_basis_is_learned_from_the_duets_unless_those_are_what_it_would_lift(store: Store) -> None:
    (elsewhere,) = run(priors, store, {"poses": [put_take(store, "salsa", is_prior=False)]})
    duet = put_take(store, "waltz", is_prior=False, is_built_in=True)
    (on_duets,) = run(priors, store, {"poses": [duet]})
    assert elsewhere.facts["origin"].startswith("built-in duets")
    assert on_duets.facts["origin"].startswith("body proportions")
    learned, proportions = duet_torso_basis().mean_m, proportions_torso_basis().mean_m
    assert np.abs(learned - proportions).max() > 0.01
    # Without the stage `priors` the rule is the same.
    for read, expected in (([elsewhere], learned), ([on_duets], proportions), ([duet], proportions), ([], learned)):
        found = read_torso_basis(store, [manifest.ref for manifest in read])
        np.testing.assert_array_equal(found.mean_m, expected)


def test_views_are_near_the_true_ones_sorted_and_say_what_they_skipped(store: Store) -> None:
    annotations, truth = put_annotations(store, "salon")
    basis = run(priors, store, {"poses": [put_take(store, "hug", is_prior=True)]})
    (made,) = run(views, store, {"annotations": [annotations], "torso_basis": basis})
    table, facts = store.read(made.ref, "views"), made.facts
    assert (facts["takes"], facts["learned_takes"]) == (["hug", "waltz"], ["hug"])
    assert (facts["num_annotations"], facts["num_without_view"]) == (30, 1)
    verdict = judged(made)
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
    np.testing.assert_allclose(np.add.reduceat(table["weight"], best), 1.0)


def test_a_take_is_not_lifted_with_a_basis_that_was_learned_from_it(store: Store) -> None:
    annotations, _ = put_annotations(store, "salon")
    basis = run(priors, store, {"poses": [put_take(store, "waltz", is_prior=True)]})
    (made,) = run(views, store, {"annotations": [annotations], "torso_basis": basis})
    assert (made.facts["learned_takes"], made.facts["torso_basis"]) == ([], "built-in duets")
    assert made.inputs == (annotations.ref,)


def test_sequences_of_one_person_are_skipped_with_the_reason(store: Store) -> None:
    annotations, _ = put_annotations(store, "solo", num_persons=1)
    (made,) = run(views, store, {"annotations": [annotations]})
    assert made.tables["views"].rows == 0
    verdict = judged(made)
    assert (verdict.level, verdict.reason) == (Level.PASS, "no annotated frame shows two people who are partners")
    skipped = made.facts["skipped"]
    assert skipped[0] == "solo.view000: 1 frame skipped, nobody has a partner"
    assert skipped[-1] == "10 more sequences: 10 frames skipped, nobody has a partner"


def test_the_same_inputs_give_the_same_bytes_and_a_parameter_changes_the_key(tmp_path: Path) -> None:
    refs = []
    for name, distance_m in (("first", 4.0), ("same", 4.0), ("farther", 5.0)):
        store = Store(tmp_path / name)
        annotations, _ = put_annotations(store, "salon")
        (made,) = run(views, store, {"annotations": [annotations]}, distance_m=distance_m)
        refs.append(made.ref)
    assert refs[0] == refs[1]
    assert refs[0].content_digest != refs[2].content_digest
    assert refs[0].key != refs[2].key


def test_unknown_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="distance"):
        views.ViewsParameters(distance=3.0)  # type: ignore[call-arg]
    with pytest.raises(InputError, match="10 poses"):
        priors.learn_torso_basis(wild(0, 3))
