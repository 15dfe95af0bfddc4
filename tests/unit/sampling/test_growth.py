"""Frontier growth: exact bones, exact distances, and pairs lifted near the truth from one seed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import random_annotations, random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity, plane_residual
from pasdedeux.kinematics import align_rigid, bone_lengths
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling import growth
from pasdedeux.sampling.annotations import AnnotatedPairs
from pasdedeux.sampling.growth import ViewedImages, grow
from pasdedeux.sampling.growth_kernels import keep_nearest, place_near_image
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread
from tests.builders.poses import with_hidden

ORDER, PARENTS = np.array(PAIR17.order), np.array(PAIR17.parents)
WIDE = JointLimits(np.full(29, -10.0), np.full(29, 10.0), ("anything",) * 29)


def annotated(count: int, *, spread_rad: float = 0.15) -> tuple[np.ndarray, AnnotatedPairs]:
    """Return pairs and one annotation of each, true views."""
    rng = np.random.default_rng(7)
    pairs = random_pairs(rng, count, spread_rad=spread_rad)
    directions = normalise(rng.normal(size=(count, 3)) * [1.0, 0.3, 1.0])
    return pairs, AnnotatedPairs(project_pair(pairs, directions), directions, np.arange(count))


def errors(grown: Any, pairs: np.ndarray) -> np.ndarray:
    return cartesian_dissimilarity(grown.pairs_m.reshape(-1, 34, 3), pairs[grown.entry].reshape(-1, 34, 3))


def test_view_residuals_are_those_of_projected_images() -> None:
    rng = np.random.default_rng(1)
    pairs = random_pairs(rng, 3)
    entries = random_annotations(rng, random_pairs(rng, 40), 40)
    images = entries.points_m.reshape(40, 34, 2)
    images = images - images.mean(axis=1, keepdims=True)
    for pair in pairs:
        seen = project_pair(pair, entries.directions).reshape(40, 34, 2)
        expected = np.sqrt(plane_residual(seen, images) / 34)
        across = np.ascontiguousarray(np.swapaxes(images, 1, 2))
        views = ViewedImages(across, np.ones((40, 34), dtype=bool), entries.directions)
        np.testing.assert_allclose(views.residuals(pair), expected, atol=1e-7)
        # With hidden joints, each image is compared over its visible joints.
        part = with_hidden(np.random.default_rng(9), entries, 0.2)
        views = ViewedImages(np.swapaxes(part.centred_m, 1, 2), part.is_seen.reshape(-1, 34), part.directions)
        shown = part.points_m.reshape(-1, 34, 2)
        count = part.is_seen.sum(axis=(1, 2))
        expected = np.sqrt(plane_residual(seen[part.annotation_index], shown) / count)
        np.testing.assert_allclose(views.residuals(pair), expected, atol=1e-7)


def placed(image: np.ndarray, depth: np.ndarray, lengths: np.ndarray, tightness: float) -> np.ndarray:
    out = np.empty((2, 17, 3))
    place_near_image(image, depth, lengths, ORDER, PARENTS, np.full((2, 17), tightness), out)
    return out


def test_placed_bones_have_exact_lengths_and_return_what_fits_already() -> None:
    rng = np.random.default_rng(2)
    pair = random_pairs(rng, 1)[0]
    lengths = bone_lengths(PAIR17, pair)
    image, depth = np.ascontiguousarray(pair[..., :2]), np.ascontiguousarray(pair[..., 2])
    np.testing.assert_allclose(placed(image, depth, lengths, 0.2), pair, atol=1e-6)
    # This holds also for images and depths that fit nothing, and for bones without depth or length.
    for noise in (0.1, 10.0):
        wild = placed(image + noise * rng.normal(size=image.shape), depth * 0.0, lengths, 0.2)
        np.testing.assert_allclose(bone_lengths(PAIR17, wild), lengths, atol=1e-9)
    flat = placed(image * 0.0, depth * 0.0, lengths * 0.0, 0.2)
    np.testing.assert_allclose(bone_lengths(PAIR17, flat), 0.0, atol=1e-9)


@pytest.mark.parametrize("tightness", [0.04, 0.5, 3.0])
def test_no_other_direction_of_a_bone_fits_better(tightness: float) -> None:
    rng = np.random.default_rng(3)
    pair = random_pairs(rng, 1)[0]
    lengths = bone_lengths(PAIR17, pair)
    image = pair[..., :2] + 0.1 * rng.normal(size=(2, 17, 2))
    depth = pair[..., 2] + 0.1 * rng.normal(size=(2, 17))
    out = placed(image, depth, lengths, tightness)
    directions = normalise(rng.normal(size=(20_000, 3)))

    def cost(bone: np.ndarray, person: int, joint: int) -> np.ndarray:
        parent = PARENTS[joint]
        across = out[person, parent, :2] + bone[..., :2] - image[person, joint]
        along = bone[..., 2] - (depth[person, joint] - depth[person, parent])
        return (across**2).sum(axis=-1) + tightness * along**2

    for person in range(2):
        for joint in range(1, 17):
            placed_bone = out[person, joint] - out[person, PARENTS[joint]]
            rivals = cost(directions * lengths[person, joint], person, joint)
            assert cost(placed_bone, person, joint) <= rivals.min() + 1e-9


def test_the_nearest_are_kept_in_order() -> None:
    rng = np.random.default_rng(4)
    residuals = rng.random((30, 5))
    best, which = np.full((5, 4), np.inf), np.full((5, 4), -1, dtype=np.int64)
    for index, residual in enumerate(residuals):
        keep_nearest(residual, index, best, which)
    np.testing.assert_array_equal(which, np.argsort(residuals, axis=0)[:4].T)
    np.testing.assert_array_equal(best, np.sort(residuals, axis=0)[:4].T)


def test_one_seed_grows_over_all_annotations_with_exact_lineage() -> None:
    pairs, entries = annotated(150)
    grown = grow(pairs[:1], entries, WIDE, num_grown=1000)
    assert sorted(grown.entry) == list(range(150))
    assert grown.num_left == grown.num_refused == 0
    assert (grown.parent < 1 + np.arange(150)).all()
    parents = np.where(grown.parent > 0, grown.generation[np.maximum(grown.parent - 1, 0)], 0)
    np.testing.assert_array_equal(grown.generation, parents + 1)
    np.testing.assert_allclose(
        bone_lengths(PAIR17, grown.pairs_m), np.broadcast_to(bone_lengths(PAIR17, pairs[0]), (150, 2, 17)), atol=1e-6
    )
    alone = cartesian_dissimilarity(np.repeat(pairs[:1], 150, axis=0).reshape(-1, 34, 3), pairs.reshape(-1, 34, 3))
    assert np.median(errors(grown, pairs)) < 0.5 * np.median(alone)


def test_hidden_joints_cost_little_and_bones_stay_exact() -> None:
    pairs, entries = annotated(250)
    part = with_hidden(np.random.default_rng(9), entries, 0.1)
    assert len(part.points_m) > 225
    assert part.is_seen.all(axis=(1, 2)).sum() < 25
    grown, whole = grow(pairs[:1], part, WIDE, num_grown=1000), grow(pairs[:1], entries, WIDE, num_grown=1000)
    assert len(grown.entry) == len(part.points_m)
    lengths = np.broadcast_to(bone_lengths(PAIR17, pairs[0]), (len(grown.entry), 2, 17))
    np.testing.assert_allclose(bone_lengths(PAIR17, grown.pairs_m), lengths, atol=1e-6)
    truth = pairs[part.annotation_index[grown.entry]].reshape(-1, 34, 3)
    error_m = cartesian_dissimilarity(grown.pairs_m.reshape(-1, 34, 3), truth)
    assert np.median(error_m) < 1.15 * np.median(errors(whole, pairs))


def test_a_joint_that_is_never_seen_is_kept_by_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "_NUM_SWEEPS", 0)
    pairs, entries = annotated(40)
    points = entries.points_m.copy()
    wrist, elbow = PAIR17.indices(("left_wrist", "left_elbow"))
    points[:, 1, wrist] = np.nan
    blind = AnnotatedPairs(points, entries.directions, entries.annotation_index)
    grown = grow(pairs[:1], blind, WIDE, num_grown=1)
    moved = align_rigid(pairs[0].reshape(34, 3), grown.pairs_m[0].reshape(34, 3)).apply(pairs[0])
    bones = [pair[1, wrist] - pair[1, elbow] for pair in (moved, grown.pairs_m[0])]
    assert bones[0] @ bones[1] > 0.9 * np.linalg.norm(bones[0]) * np.linalg.norm(bones[1])


def test_agreeing_neighbours_bring_pairs_nearer_to_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs, entries = annotated(300)
    agreed = grow(pairs[:1], entries, WIDE, num_grown=300)
    monkeypatch.setattr(growth, "_NUM_SWEEPS", 0)
    lifted = grow(pairs[:1], entries, WIDE, num_grown=300)
    np.testing.assert_array_equal(lifted.entry, agreed.entry)
    assert errors(agreed, pairs).mean() < errors(lifted, pairs).mean()


def test_growth_does_not_depend_on_where_the_seed_stands_and_repeats_exactly() -> None:
    pairs, entries = annotated(60)
    once = grow(pairs[:1], entries, WIDE, num_grown=40)
    again = grow(pairs[:1], entries, WIDE, num_grown=40)
    np.testing.assert_array_equal(once.pairs_m, again.pairs_m)
    turned = pairs[:1] @ rotmat_from_unitquat(normalise(np.array([0.1, 0.7, -0.2, 0.5]))).T + [1.0, 2.0, 3.0]
    moved = grow(turned, entries, WIDE, num_grown=40)
    np.testing.assert_array_equal(once.entry, moved.entry)
    distance = cartesian_dissimilarity(once.pairs_m.reshape(-1, 34, 3), moved.pairs_m.reshape(-1, 34, 3))
    np.testing.assert_allclose(distance, 0.0, atol=1e-6)


def test_of_more_annotations_than_are_asked_for_those_are_lifted_that_are_evenly_spread() -> None:
    pairs, entries = annotated(60)
    turned = np.concatenate([entries.directions, entries.directions[::-1]])
    both = AnnotatedPairs(
        np.concatenate([entries.points_m, entries.points_m[::-1]]),
        turned,
        np.append(np.arange(60), np.arange(60)[::-1]),
    )
    grown = grow(pairs[:2], both, WIDE, num_grown=12)
    assert sorted(both.annotation_index[grown.entry]) == evenly_spread(60, 12).tolist()
    assert (grown.num_refused, grown.num_left) == (0, 0)
    spread = np.flatnonzero(np.isin(both.annotation_index, evenly_spread(60, 12)))
    same = grow(pairs[:2], both.some(spread), WIDE, num_grown=99)
    np.testing.assert_array_equal(grown.pairs_m, same.pairs_m)


def test_an_annotation_is_lifted_once_whatever_the_number_of_its_views() -> None:
    pairs, entries = annotated(30)
    turned = normalise(entries.directions + 0.2 * np.random.default_rng(0).normal(size=(30, 3)))
    both = AnnotatedPairs(
        np.concatenate([entries.points_m] * 2), np.concatenate([entries.directions, turned]), np.tile(np.arange(30), 2)
    )
    grown = grow(pairs[:1], both, WIDE, num_grown=100)
    assert len(grown.entry) == 30
    assert len(np.unique(both.annotation_index[grown.entry])) == 30


def test_impossible_pairs_are_refused_and_far_annotations_left(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs, entries = annotated(30)
    narrow = JointLimits(np.full(29, 3.0), np.full(29, 3.01), ("nothing",) * 29)
    refused = grow(pairs[:1], entries, narrow, num_grown=100)
    assert (len(refused.entry), refused.num_refused, refused.num_left) == (0, 30, 0)
    lenient = grow(pairs[:1], entries, narrow, num_grown=100, prior=PriorSettings(max_invalid_angles=58))
    assert (len(lenient.entry), lenient.num_refused) == (30, 0)
    assert lenient.is_possible.all()
    monkeypatch.setattr(growth, "FARTHEST_M", 1e-3)
    left = grow(pairs[:1], entries, WIDE, num_grown=100)
    assert left.num_left == 30 - len(left.entry)
    assert left.num_left > 20


def test_seeds_that_cannot_grow_are_refused_with_the_reason() -> None:
    _, entries = annotated(5)
    with pytest.raises(InputError, match="at least one seed"):
        grow(np.zeros((0, 2, 17, 3)), entries, WIDE, num_grown=1)
