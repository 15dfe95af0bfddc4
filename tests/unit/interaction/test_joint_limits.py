"""Check joint angles, limits and nearest valid poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility.joint_limits import MAX_INVALID_ANGLES, JointLimits, angles_and_slack
from pasdedeux.plausibility.ranges import ANGLE_INDEX as ANGLE
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import LAYOUTS
from tests.builders.oracles_plausibility import plain_angles, plain_invalid, plain_nearest_valid
from tests.builders.poses import put, standing, wild

LIMITS = JointLimits.published()


def is_valid(limits: JointLimits, poses: np.ndarray) -> np.ndarray:
    return limits.num_invalid(poses) == 0


def degrees(pose: np.ndarray, joint: str, angle: str) -> float:
    return float(np.rad2deg(angles_and_slack(pose)[0][ANGLE[joint, angle]]))


def test_standing_is_valid_and_straight() -> None:
    assert is_valid(LIMITS, standing())
    for joint in ("spine", "chest", "left_knee"):
        assert abs(degrees(standing(), joint, "flexion")) < 6


def test_angles_have_the_stated_signs_on_both_sides() -> None:
    for side, out in (("left", 1.0), ("right", -1.0)):
        raised = put(standing(), f"{side}_knee", [0, -1, 1])
        assert degrees(raised, f"{side}_hip", "flexion") == pytest.approx(45)
        aside = put(standing(), f"{side}_knee", [out, -1, 0])
        assert degrees(aside, f"{side}_hip", "abduction") == pytest.approx(45)
        back = put(standing(), f"{side}_elbow", [0, -1, -1])
        assert degrees(back, f"{side}_shoulder", "extension") == pytest.approx(45)
        across = put(standing(), f"{side}_elbow", [-out, 0, 1])
        assert degrees(across, f"{side}_shoulder", "crossing") == pytest.approx(45)
        cross_up = put(put(standing(), f"{side}_elbow", [out, 0, 0]), f"{side}_wrist", [0, 1, 0])
        assert degrees(cross_up, f"{side}_shoulder", "rotation") == pytest.approx(90)
        assert degrees(cross_up, f"{side}_elbow", "flexion") == pytest.approx(90)
        forearm_forward = put(put(standing(), f"{side}_elbow", [0, -1, 0]), f"{side}_wrist", [0, 0, 1])
        assert degrees(forearm_forward, f"{side}_shoulder", "rotation") == pytest.approx(0, abs=1e-6)
        sitting = put(put(standing(), f"{side}_knee", [0, 0, 1]), f"{side}_ankle", [0, -1, 0])
        assert degrees(sitting, f"{side}_hip", "rotation") == pytest.approx(0, abs=1e-6)
        foot_in = put(put(standing(), f"{side}_knee", [0, 0, 1]), f"{side}_ankle", [-out, -1, 0])
        assert degrees(foot_in, f"{side}_hip", "rotation") == pytest.approx(45)
    assert degrees(put(standing(), "head", [0, 1, 1]), "neck", "flexion") == pytest.approx(45)
    assert degrees(put(standing(), "head", [1, 1, 0]), "neck", "lateral") == pytest.approx(45)


@pytest.mark.parametrize(
    ("joint", "direction", "angle"),
    [
        ("left_ankle", [0.0, -1.0, 1.0], ("left_hip", "rotation")),
        ("right_wrist", [0.0, -1.0, -1.0], ("right_shoulder", "rotation")),
        ("left_elbow", [0.0, 0.0, -1.0], ("left_shoulder", "extension")),
        ("right_elbow", [1.0, 0.0, 0.0], ("right_shoulder", "crossing")),
        ("right_knee", [-1.0, -0.3, 0.0], ("right_hip", "abduction")),
        ("head", [0.0, -1.0, -0.5], ("neck", "flexion")),
        ("left_wrist", [0.0, 1.0, 0.0], ("left_elbow", "flexion")),
    ],
)
def test_impossible_limbs_are_noticed(joint: str, direction: list[float], angle: tuple[str, str]) -> None:
    pose = put(standing(), joint, direction)
    assert LIMITS.invalid_angles(pose)[ANGLE[angle]]
    assert not is_valid(LIMITS, pose)


def test_angles_do_not_change_under_rigid_motion_and_mirroring_swaps_the_sides() -> None:
    poses = wild(0, 200)
    turn = rotmat_from_unitquat(normalise(np.array([0.3, -0.2, 0.7, 0.5])))
    np.testing.assert_allclose(angles_and_slack(poses @ turn.T + [1, 2, 3])[0], angles_and_slack(poses)[0], atol=1e-9)
    mirrored = (poses * [-1, 1, 1])[:, list(PAIR17.mirror)]
    np.testing.assert_array_equal(LIMITS.num_invalid(mirrored), LIMITS.num_invalid(poses))


def test_the_nearest_valid_pose_is_valid_keeps_bones_and_leaves_valid_poses_alone() -> None:
    poses = wild(1, 500)
    nearest = LIMITS.nearest_valid(poses)
    assert LIMITS.num_invalid(nearest.positions).max() == 0
    np.testing.assert_allclose(bone_lengths(PAIR17, nearest.positions), bone_lengths(PAIR17, poses), atol=1e-9)
    np.testing.assert_array_equal(nearest.positions[:, 0], poses[:, 0])
    valid = is_valid(LIMITS, poses)
    assert 10 < valid.sum() < 490
    np.testing.assert_array_equal(nearest.positions[valid], poses[valid])
    assert (nearest.squared_distance_m2[~valid] > 0).all()
    np.testing.assert_array_equal(nearest.num_invalid, LIMITS.num_invalid(poses))


def test_widened_limits_accept_what_was_seen_and_treat_both_sides_alike() -> None:
    split = put(standing(), "left_knee", [1.0, -0.2, 0.0])
    assert not is_valid(LIMITS, split)
    wider = LIMITS.widened(np.stack([split] * 3), name="gymnasts")
    assert is_valid(wider, split)
    assert is_valid(wider, (split * [-1, 1, 1])[list(PAIR17.mirror)])
    assert "gymnasts" in wider.source[ANGLE["right_hip", "abduction"]]
    assert LIMITS.widened(np.zeros((0, 17, 3)), name="nobody") is LIMITS


def test_the_walk_over_one_pose_at_a_time_agrees_with_the_plain_one_over_arrays() -> None:
    poses = wild(2, 400)
    nearest = LIMITS.nearest_valid(poses)
    # atan2 may fall on either side of the half turn
    np.testing.assert_allclose(np.exp(1j * angles_and_slack(poses)[0]), np.exp(1j * plain_angles(poses)[0]), atol=1e-9)
    np.testing.assert_array_equal(LIMITS.invalid_angles(poses), plain_invalid(LIMITS, poses))
    moved = plain_nearest_valid(LIMITS, poses)
    np.testing.assert_allclose(nearest.positions, moved, atol=1e-9)
    np.testing.assert_allclose(nearest.squared_distance_m2, ((moved - poses) ** 2).sum(axis=(1, 2)), atol=1e-12)


@pytest.mark.parametrize("joint", [name for name in PAIR17.joint_names if name != "pelvis"])
def test_an_empty_bone_has_the_angles_and_the_nearest_valid_pose_of_the_plain_form(joint: str) -> None:
    poses = np.stack([standing(), -standing(), *wild(3, 20)])
    index = PAIR17.index(joint)
    poses[:, index] = poses[:, PAIR17.parents[index]]
    np.testing.assert_array_equal(LIMITS.invalid_angles(poses), plain_invalid(LIMITS, poses))
    moved = LIMITS.nearest_valid(poses).positions
    np.testing.assert_allclose(bone_lengths(PAIR17, moved), bone_lengths(PAIR17, poses), atol=1e-9)
    if joint != "spine":  # without it legs have no frame, and a knee may bend to either side
        np.testing.assert_allclose(moved, plain_nearest_valid(LIMITS, poses), atol=1e-9)


def test_collapsed_poses_have_a_nearest_valid_one() -> None:
    for pose in (np.zeros((17, 3)), np.ones((17, 3)), standing() * [0, 1, 0]):
        assert np.isfinite(LIMITS.nearest_valid(pose).positions).all()


def test_captured_single_people_are_in_range(data_dir: Path) -> None:
    folder = data_dir / "cmu_asfamc"
    counts = []
    for file in sorted(folder.glob("0[123]_*.amc")):
        asf = read_asf((folder / f"{file.stem[:2]}.asf").read_bytes())
        source = read_amc(file.read_bytes(), asf).frames(0, 2000)
        motion = source.to_motion(metres_per_unit=asf.metres_per_unit, rate_hz=120.0).resample(24.0)
        counts.append(LIMITS.num_invalid(derive_working_poses(motion, LAYOUTS["cmu_asf"]).pair17_m))
    invalid = np.concatenate(counts)
    assert len(invalid) > 1000
    assert (invalid == 0).mean() >= 0.99
    assert invalid.max() <= MAX_INVALID_ANGLES
