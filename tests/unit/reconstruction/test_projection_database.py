"""Proportions, heading, cameras and numbering of a projection database."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_directions, bone_lengths
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.retarget import (
    REFERENCE_LENGTHS_M,
    body_heading,
    centre_and_face,
    mid_hip,
    retarget_proportions,
)
from pasdedeux.projections.sources import op14_from_working, resample_positions
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.skeletons import OP14, PAIR17
from tests.builders.walkers import random_poses, walk


def test_retargeting_keeps_directions_and_mid_hip_and_sets_lengths() -> None:
    poses = random_poses(np.random.default_rng(0), 20) * 1.3 + np.array([1.0, 2.0, 3.0])
    moved = retarget_proportions(poses)
    np.testing.assert_allclose(bone_lengths(OP14, moved), np.broadcast_to(REFERENCE_LENGTHS_M, (20, 14)), atol=1e-12)
    np.testing.assert_allclose(bone_directions(OP14, moved), bone_directions(OP14, poses), atol=1e-12)
    np.testing.assert_allclose(mid_hip(moved), mid_hip(poses), atol=1e-12)


def test_retargeting_refuses_missing_joints_and_empty_bones() -> None:
    pose = random_poses(np.random.default_rng(1), 1)
    broken = pose.copy()
    broken[0, 3, 1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        retarget_proportions(broken)
    pose[0, OP14.index("left_wrist")] = pose[0, OP14.index("left_elbow")]
    with pytest.raises(InputError, match="left_wrist"):
        retarget_proportions(pose)


@pytest.mark.parametrize("yaw", [-2.5, 0.0, 0.7, 3.0])
def test_heading_is_the_yaw_a_person_was_turned_by(yaw: float) -> None:
    pose = walk(1, turn_rad=0.0)[0]
    start = body_heading(pose)
    turned = pose @ yaw_rotmat(yaw).T
    assert np.angle(np.exp(1j * (body_heading(turned) - start - yaw))) == pytest.approx(0.0, abs=1e-9)
    facing = centre_and_face(turned)
    assert body_heading(facing.poses_m) == pytest.approx(0.0, abs=1e-9)
    back = facing.poses_m @ yaw_rotmat(facing.heading_rad).T + facing.root_translation_m
    np.testing.assert_allclose(back, turned, atol=1e-12)


def test_a_person_facing_the_camera_shows_the_left_hand_on_the_right_of_the_image() -> None:
    facing = centre_and_face(walk(3)[1:2]).poses_m
    database = Database(facing.astype(np.float32), np.array([True]))
    image = database.project()[0, 0]
    assert image[OP14.index("left_shoulder"), 0] > 0 > image[OP14.index("right_shoulder"), 0]
    assert image[OP14.index("head"), 1] > 0 > image[OP14.index("left_ankle"), 1]


@pytest.mark.parametrize("camera", [DatabaseCamera(), DatabaseCamera(0.4)])
def test_projections_are_the_camera_over_turned_poses_numbered_by_row_and_yaw(camera: DatabaseCamera) -> None:
    poses = centre_and_face(walk(7)).poses_m.astype(np.float32)
    database = Database(poses, np.zeros(7, dtype=bool), num_yaws=12, camera=camera)
    flat = database.project().reshape(-1, 14, 2)
    for number in (0, 5, 13, 83):
        row, yaw = divmod(number, 12)
        turned = poses[row].astype(np.float64) @ yaw_rotmat(2 * np.pi * yaw / 12).T
        np.testing.assert_allclose(flat[number], camera.project(turned), atol=1e-5)
        np.testing.assert_allclose(database.turned(np.array(row), np.array(yaw)), turned, atol=1e-6)
    np.testing.assert_allclose(mid_hip(flat), 0.0, atol=1e-6)


def test_a_pitched_camera_projects_what_its_rotation_leaves_of_depth() -> None:
    camera = DatabaseCamera(0.5)
    pose = walk(1)[0]
    turned = pose @ camera.camera_from_upright_rotmat.T
    np.testing.assert_allclose(camera.project(pose), turned[:, :2], atol=1e-12)
    # A camera above sees the head, and what is over the mid-hip, come towards it.
    assert (camera.camera_from_upright_rotmat @ np.array([0.0, 1.0, 0.0]))[2] > 0


def test_rows_follow_each_other_within_a_motion_only() -> None:
    poses = centre_and_face(walk(6)).poses_m.astype(np.float32)
    both = Database(poses, np.arange(6) == 4)
    assert both.successors().tolist() == [1, 2, 3, 3, 5, 5]
    assert both.num_projections == 6 * 30


@pytest.mark.parametrize(
    ("most", "kept"), [(6, range(6)), (7, range(6)), (5, range(0, 6, 2)), (2, range(0, 6, 3)), (1, [0])]
)
def test_a_thinned_database_has_evenly_spaced_poses_that_follow_nothing(most: int, kept: Sequence[int]) -> None:
    poses, body = centre_and_face(walk(6)).poses_m.astype(np.float32), np.arange(6 * 22 * 4.0, dtype=np.float32)
    whole = Database(poses, np.arange(6) == 4, num_yaws=1, body22_unitquat=body.reshape(6, 22, 4))
    thin = whole.thinned(most)
    assert (thin is whole) == (len(kept) == 6)
    assert thin.is_sequence_start.tolist() == [row in (0, 4) or thin is not whole for row in kept]
    np.testing.assert_array_equal(thin.poses_m, poses[list(kept)])
    assert thin.body22_unitquat is not None
    np.testing.assert_array_equal(thin.body22_unitquat[:, 0, 0], 88.0 * np.array(kept))


@pytest.mark.parametrize(
    ("poses", "starts", "message"),
    [
        (np.zeros((2, 17, 3)), np.zeros(2), "expected"),
        (np.zeros((0, 14, 3)), np.zeros(0), "at least one"),
        (np.full((2, 14, 3), np.nan), np.zeros(2), "row 0"),
    ],
)
def test_a_database_of_wrong_or_missing_poses_is_refused(poses: np.ndarray, starts: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Database(poses.astype(np.float32), starts.astype(bool))


def test_bone_rotations_give_the_pose_back() -> None:
    poses = random_poses(np.random.default_rng(3), 50, spread=0.8)
    again = place_bone_rotations(bone_rotations(poses), REFERENCE_LENGTHS_M, mid_hip(poses))
    np.testing.assert_allclose(again, poses, atol=1e-9)


def test_resampling_keeps_the_ends_and_the_speed() -> None:
    line = np.arange(61.0)[:, None, None] * np.ones((1, 14, 3))
    half = resample_positions(line, from_hz=60.0, to_hz=24.0)
    np.testing.assert_allclose(half[:, 0, 0], 2.5 * np.arange(25))
    np.testing.assert_array_equal(resample_positions(line, from_hz=60, to_hz=60), line)


def test_a_working_skeleton_gets_a_nose_where_it_faces() -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(0, 0.01, (17, 3))
    place = {
        "left_shoulder": (0.2, 1.4, 0),
        "right_shoulder": (-0.2, 1.4, 0),
        "neck": (0, 1.45, 0),
        "head": (0, 1.65, 0),
    }
    for name, point in place.items():
        positions[PAIR17.index(name)] = point
    nose = op14_from_working(positions, PAIR17)[OP14.index("head")]
    assert nose[2] > 0.1  # the left side is +X, so the face is on +Z
    assert nose[0] == pytest.approx(0.0, abs=1e-9)
