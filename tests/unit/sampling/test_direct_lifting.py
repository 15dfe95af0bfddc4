"""Medoids under d_I, and seeds lifted from 2D alone."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.cameras.frames import project_pair
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs, shows_enough
from pasdedeux.sampling.direct_lifting import apparent_bone_lengths, choose_medoids, lift_pair, lift_seeds
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import dancers

LIMITS, BASIS = JointLimits.published(), proportions_torso_basis()


def annotated(count: int) -> tuple[np.ndarray, AnnotatedPairs]:
    pairs = dancers(3, count)
    rng = np.random.default_rng(1)
    directions = normalise(rng.normal(size=(count, 3)) * [1.0, 0.2, 1.0])
    return pairs, AnnotatedPairs(project_pair(pairs, directions), directions, np.arange(count))


def test_medoids_of_separate_groups_are_one_of_each_and_local_optima() -> None:
    rng = np.random.default_rng(2)
    place = np.concatenate([centre + rng.normal(scale=0.1, size=20) for centre in (0.0, 5.0, 9.0)])
    matrix = np.abs(place[:, None] - place)
    medoids = choose_medoids(matrix, 3)
    assert sorted(medoids // 20) == [0, 1, 2]
    for group, medoid in enumerate(sorted(medoids)):
        members = np.arange(20 * group, 20 * group + 20)
        costs = matrix[np.ix_(members, members)].sum(axis=1)
        assert costs[medoid % 20] == costs.min()
    np.testing.assert_array_equal(np.sort(choose_medoids(matrix[:4, :4], 4)), np.arange(4))
    assert len(np.unique(choose_medoids(np.zeros((5, 5)), 3))) == 3


def test_bone_lengths_are_read_off_many_views() -> None:
    pairs, entries = annotated(300)
    got = apparent_bone_lengths(entries.points_m)
    expected = bone_lengths(PAIR17, pairs[0])
    np.testing.assert_allclose(got[:, 1:], expected[:, 1:], rtol=0.1)
    np.testing.assert_array_equal(got, got[:, list(PAIR17.mirror)])


def test_lifted_seeds_are_close_to_the_pairs_that_were_seen() -> None:
    pairs, entries = annotated(120)
    seeds = lift_seeds(entries, LIMITS, BASIS, num_seeds=8)
    error = cartesian_dissimilarity(seeds.pairs_m.reshape(-1, 34, 3), pairs[seeds.entry].reshape(-1, 34, 3))
    assert len(np.unique(seeds.entry)) == 8
    assert np.median(error) < 0.1
    expected = np.broadcast_to(apparent_bone_lengths(entries.points_m), (8, 2, 17))
    np.testing.assert_allclose(bone_lengths(PAIR17, seeds.pairs_m), expected, atol=1e-9)
    again = lift_seeds(entries, LIMITS, BASIS, num_seeds=8)
    np.testing.assert_array_equal(again.pairs_m, seeds.pairs_m)


def test_hidden_joints_leave_seeds_nearly_as_close() -> None:
    pairs, entries = annotated(150)
    points = entries.points_m.copy()
    points[np.random.default_rng(4).random(points.shape[:3]) < 0.1] = np.nan
    enough = shows_enough(points)
    part = AnnotatedPairs(points[enough], entries.directions[enough], entries.annotation_index[enough])
    lengths = apparent_bone_lengths(part.points_m)
    np.testing.assert_allclose(lengths[:, 1:], apparent_bone_lengths(entries.points_m)[:, 1:], rtol=0.05)
    seeds = lift_seeds(part, LIMITS, BASIS, num_seeds=8)
    truth = pairs[part.annotation_index[seeds.entry]]
    assert np.median(cartesian_dissimilarity(seeds.pairs_m.reshape(-1, 34, 3), truth.reshape(-1, 34, 3))) < 0.15


def test_a_close_up_without_lower_legs_is_lifted_with_their_usual_proportion() -> None:
    pairs, entries = annotated(150)
    points = entries.points_m.copy()
    hidden = list(PAIR17.indices(("left_ankle", "right_ankle")))
    points[:, :, hidden] = np.nan
    assert shows_enough(points).all()
    lengths, whole = apparent_bone_lengths(points), apparent_bone_lengths(entries.points_m)
    np.testing.assert_allclose(lengths[:, hidden], whole[:, hidden], rtol=0.15)
    np.testing.assert_array_equal(np.delete(lengths, hidden, axis=1), np.delete(whole, hidden, axis=1))
    np.testing.assert_allclose(apparent_bone_lengths(2.0 * points), 2.0 * lengths)
    seeds = lift_seeds(AnnotatedPairs(points, entries.directions, entries.annotation_index), LIMITS, BASIS, num_seeds=4)
    seen = [joint for joint in range(17) if joint not in hidden]
    lifted, truth = (some[:, :, seen].reshape(len(some), -1, 3) for some in (seeds.pairs_m, pairs[seeds.entry]))
    error = cartesian_dissimilarity(lifted, truth)
    assert np.median(error) < 0.15
    points[:, 1] = np.nan
    with pytest.raises(InputError, match="no annotation shows a bone of person B"):
        apparent_bone_lengths(points)


def test_lifting_refuses_what_it_cannot_do_with_the_reason() -> None:
    _, entries = annotated(5)
    assert len(lift_seeds(entries, LIMITS, BASIS, num_seeds=6).pairs_m) <= 5
    narrow = JointLimits(np.full(29, 3.0), np.full(29, 3.01), ("nothing",) * 29)
    with pytest.raises(InputError, match="no pair of 5 annotations keeps the joint limits"):
        lift_seeds(entries, narrow, BASIS, num_seeds=1)
    lengths = apparent_bone_lengths(entries.points_m)
    assert lift_pair(np.zeros((2, 17, 2)), entries.directions[0], lengths, LIMITS, BASIS) is None
