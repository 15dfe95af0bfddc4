"""The pose prior learned from capture."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility import Occupancy
from pasdedeux.plausibility.occupancy import NUM_CELLS, bone_cells, bone_directions, sphere_cells
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import put, standing, wild

MIRROR = list(PAIR17.mirror)


def min_share(poses: np.ndarray) -> np.ndarray:
    return LEARNED.bone_logs(poses).min(axis=-1)


def near_standing(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return standing() + rng.normal(scale=0.02, size=(count, 17, 3))


LEARNED = Occupancy.empty().extended(near_standing(0, 400))


def test_cells_are_spread_evenly() -> None:
    cells = sphere_cells(NUM_CELLS)
    np.testing.assert_allclose(np.linalg.norm(cells, axis=1), 1.0, atol=1e-12)
    points = normalise(np.random.default_rng(0).normal(size=(20_000, 3)))
    share = np.bincount((points @ cells.T).argmax(axis=1), minlength=NUM_CELLS) / len(points)
    # 40 points a cell are expected: five standard deviations of a count.
    assert (np.abs(share * NUM_CELLS - 1.0) < 5.0 / np.sqrt(40.0)).all()
    assert np.rad2deg(np.arccos((points @ cells.T).max(axis=1))).max() < 9.0


def test_rigid_motion_changes_no_direction_and_mirroring_swaps_the_sides() -> None:
    poses = wild(3, 100)
    turn = rotmat_from_unitquat(normalise(np.array([0.1, 0.5, -0.4, 0.7])))
    own = bone_directions(poses)
    np.testing.assert_allclose(bone_directions(poses @ turn.T + 3.0), own, atol=1e-9)
    mirrored = bone_directions((poses * [-1.0, 1.0, 1.0])[:, MIRROR])
    swapped = own[:, [0, 1, 2, 4, 3, 6, 5, 8, 7, 10, 9]]
    swapped[:, :3, 0] *= -1.0
    np.testing.assert_allclose(mirrored, swapped, atol=1e-9)


def test_hanging_limbs_point_where_the_frames_say() -> None:
    own = bone_directions(standing())
    np.testing.assert_allclose(own[0], [0.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(own[7:9], [[0.0, -1.0, 0.0]] * 2, atol=0.1)
    bent = put(put(standing(), "right_knee", [0, -1, 0]), "right_ankle", [0, 0, -1])
    np.testing.assert_allclose(bone_directions(bent)[10], [0.0, 0.0, -1.0], atol=0.05)


def test_the_prior_prefers_what_was_seen_and_knows_nothing_without_capture() -> None:
    assert (Occupancy.empty().bone_logs(wild(4, 50)) == 0.0).all()
    seen, unseen = min_share(near_standing(1, 200)), min_share(wild(5, 200))
    assert np.quantile(seen, 0.05) > np.median(unseen)
    knee_forward = put(standing(), "left_ankle", [0.0, -0.5, 1.0])
    assert min_share(knee_forward) < seen.min()


def test_shares_given_the_bone_above_sum_to_one() -> None:
    np.testing.assert_allclose(np.exp(LEARNED.log_share).mean(axis=-1), 1.0, atol=1e-9)


def test_capture_comes_in_parts_and_broken_poses_are_left_out() -> None:
    poses = near_standing(0, 400)
    parts = Occupancy.empty().extended(poses[:123]).extended(poses[123:])
    np.testing.assert_array_equal(parts.counts, LEARNED.counts)
    np.testing.assert_array_equal(LEARNED.extended(poses[:3] * np.nan).counts, LEARNED.counts)
    assert LEARNED.counts.sum() == 400 * 11
    with pytest.raises(InputError, match="occupancy"):
        Occupancy(np.zeros((2, 3), dtype=np.int64))


def test_bones_of_length_zero_have_no_direction_and_a_share() -> None:
    assert (bone_directions(np.zeros((17, 3))) == 0.0).all()
    assert np.isfinite(LEARNED.bone_logs(np.zeros((17, 3)))).all()


def test_the_cell_of_a_bone_is_the_nearest_on_the_sphere() -> None:
    poses = wild(6, 200)
    _, cell = bone_cells(poses)
    np.testing.assert_array_equal(cell, np.argmax(bone_directions(poses) @ sphere_cells(NUM_CELLS).T, axis=-1))
