"""Kernels of one frame give what the functions over whole tracks give."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.kinematics.rotations import rotate, swing_between, unitquat_from_rotvec
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.live.frame_kernels import (
    filter_rotations,
    find_bone_rotations,
    least_squares_scale,
    metric_of,
    place_bones,
    rotate_vector,
    straighten_frame,
    transition_costs,
    turn_from_camera_axis,
    turn_poses,
    unify_image,
)
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import straighten_rays
from pasdedeux.reconstruction.smoothing import OneEuro, smooth_one_euro
from pasdedeux.skeletons import OP14
from tests.builders.walkers import random_poses, walk


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_bone_rotations_of_a_pose_and_the_way_back(rng: np.random.Generator) -> None:
    poses = random_poses(rng, 60, spread=1.5)
    poses[1, OP14.index("left_elbow")] = poses[1, OP14.index("left_shoulder")]  # a bone of length zero
    poses[2, :] = 0.0
    expected = bone_rotations(poses)
    found = np.stack([find_bone_rotations(pose) for pose in poses])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    placed = np.stack([place_bones(one, REFERENCE_LENGTHS_M) for one in expected])
    np.testing.assert_allclose(
        placed, place_bone_rotations(expected, REFERENCE_LENGTHS_M, np.zeros((60, 3))), atol=1e-12
    )


def test_rays_are_straightened_as_for_a_track(rng: np.random.Generator) -> None:
    points = rng.normal(0, 900, (8, 14, 2))
    points[rng.uniform(size=(8, 14)) < 0.2] = np.nan
    hips = rng.normal(0, 600, (8, 2))
    straight, towards = straighten_rays(points, hips, 800.0)
    for frame in range(8):
        one, direction = straighten_frame(points[frame], hips[frame], 800.0)
        np.testing.assert_allclose(one, straight[frame], rtol=1e-9)
        np.testing.assert_allclose(direction, towards[frame], rtol=1e-12)
        expected = swing_between(np.array([0.0, 0.0, 1.0]), direction)
        np.testing.assert_allclose(turn_from_camera_axis(direction), expected, atol=1e-12)


def test_a_vector_turns_as_many_do(rng: np.random.Generator) -> None:
    unitquat, vector = unitquat_from_rotvec(rng.normal(0, 1, 3)), rng.normal(0, 1, 3)
    np.testing.assert_allclose(rotate_vector(unitquat, vector), rotate(unitquat, vector), atol=1e-12)


def test_an_image_is_moved_to_the_reference_body_as_for_a_track(rng: np.random.Generator) -> None:
    ratio = rng.uniform(0.7, 1.4, 14)
    for missing in (0.0, 0.3, 0.7):
        points = rng.normal(0, 0.5, (20, 14, 2))
        points[rng.uniform(size=(20, 14)) < missing] = np.nan
        expected = retarget_image(points, ratio)
        found = np.stack([unify_image(one, ratio) for one in points])
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_scale_of_a_frame_is_that_of_the_image_it_was_made_of(rng: np.random.Generator) -> None:
    match = rng.normal(0, 0.4, (14, 2))
    weight = rng.uniform(0.1, 1.0, 14)
    weight[3] = 0.0
    points = match / 0.004 + np.array([30.0, -7.0])
    points[3] = np.nan
    scale, *means = least_squares_scale(points, weight, match)
    assert scale == pytest.approx(0.004)
    np.testing.assert_allclose(means[:2] - np.array(means[2:]) / scale, [30.0, -7.0], atol=1e-9)
    weight[2:] = 0.0
    assert np.isnan(least_squares_scale(points, weight, match)[0])


def test_poses_turn_and_are_compared_as_in_the_database(rng: np.random.Generator) -> None:
    poses = centre_and_face(walk(12)).poses_m.astype(np.float32)
    database = Database(poses, np.zeros(12, dtype=bool))
    rows, yaw = rng.integers(0, 12, 6), rng.uniform(0, 30, 6)
    turned = turn_poses(database.poses_m, rows, yaw * database.yaw_step_rad)
    np.testing.assert_allclose(turned, database.turned(rows, yaw), atol=1e-12)
    query, weight = turned[2, :, :2] + rng.normal(0, 0.1, (14, 2)), rng.uniform(0, 1, 14)
    weight[5], query[5] = 0.0, np.nan
    expected = np.nansum(weight * np.linalg.norm(turned[..., :2] - query, axis=-1), axis=-1) / weight.sum()
    np.testing.assert_allclose(metric_of(query, weight, turned[..., :2].copy()), expected, rtol=1e-12)


def test_the_cheapest_way_to_each_candidate_is_taken(rng: np.random.Generator) -> None:
    pose, ahead, cost = rng.normal(0, 0.1, (5, 14, 3)), rng.normal(0, 0.1, (7, 14, 3)), rng.uniform(0, 0.1, 7)
    total = cost + 0.6 * np.linalg.norm(pose[:, None] - ahead[None], axis=-1).mean(axis=-1)
    best, back = transition_costs(pose, ahead, cost, 0.6)
    np.testing.assert_allclose(best, total.min(axis=1), rtol=1e-12)
    np.testing.assert_array_equal(back, total.argmin(axis=1))


def test_the_filter_of_a_frame_is_that_of_a_motion(rng: np.random.Generator) -> None:
    unitquat = unitquat_from_rotvec(np.cumsum(rng.normal(0, 0.2, (40, 14, 3)), axis=0))
    unitquat *= rng.choice([-1.0, 1.0], (40, 14, 1))
    options = OneEuro(min_cutoff_hz=0.8, beta=0.3)
    expected = smooth_one_euro(unitquat, rate_hz=30.0, parameters=options)
    value, velocity = unitquat[0], np.zeros((14, 3))
    for frame in range(1, 40):
        value, velocity = filter_rotations(value, velocity, unitquat[frame], 30.0, 0.8, 0.3, 1.0)
        np.testing.assert_allclose(np.abs(np.sum(value * expected[frame], axis=-1)), 1.0, atol=1e-12)
