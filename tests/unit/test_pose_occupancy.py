"""The pose prior and the limits learned from capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.working_poses import derive_working_poses
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.plausibility import (
    ANGLES,
    JointLimits,
    LearnedLimits,
    Occupancy,
)
from pasdedeux.plausibility.joint_limits import angles_and_slack
from pasdedeux.plausibility.learned_limits import ANGLES_OF_BONE, LIMIT_BONES
from pasdedeux.plausibility.occupancy import NUM_CELLS, bone_cells, point_bones, sphere_cells
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import LAYOUTS
from tests.builders.oracles_plausibility import excess, plain_cells, plain_invalid_learned, plain_nearest_learned
from tests.builders.poses import put, standing, wild

TABLE = JointLimits.published()
MIRROR = list(PAIR17.mirror)


def is_valid(limits: JointLimits | LearnedLimits, poses: np.ndarray) -> np.ndarray:
    return limits.num_invalid(poses) == 0


def directions(poses: np.ndarray) -> np.ndarray:
    """Unit directions (*batch, bone=11, 3) of the bones in their frames."""
    own = np.empty((*poses.shape[:-2], 11, 3))
    for at in np.ndindex(own.shape[:-2]):
        point_bones(poses[at], own[at], np.empty((11, 3)), np.empty((11, 3, 3)))
    return own


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
    own = directions(poses)
    np.testing.assert_allclose(directions(poses @ turn.T + 3.0), own, atol=1e-9)
    mirrored = directions((poses * [-1.0, 1.0, 1.0])[:, MIRROR])
    swapped = own[:, [0, 1, 2, 4, 3, 6, 5, 8, 7, 10, 9]]
    swapped[:, :3, 0] *= -1.0
    np.testing.assert_allclose(mirrored, swapped, atol=1e-9)


def test_hanging_limbs_point_where_the_frames_say() -> None:
    own = directions(standing())
    np.testing.assert_allclose(own[0], [0.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(own[7:9], [[0.0, -1.0, 0.0]] * 2, atol=0.1)
    bent = put(put(standing(), "right_knee", [0, -1, 0]), "right_ankle", [0, 0, -1])
    np.testing.assert_allclose(directions(bent)[10], [0.0, 0.0, -1.0], atol=0.05)


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


def test_cells_of_one_pose_at_a_time_are_those_of_the_plain_form_over_arrays() -> None:
    poses = np.concatenate([wild(6, 200), near_standing(2, 100)])
    np.testing.assert_array_equal(bone_cells(poses), plain_cells(poses))
    assert np.isfinite(LEARNED.bone_logs(np.zeros((17, 3)))).all()


def test_learned_limits_allow_what_table_or_capture_allow() -> None:
    split = put(standing(), "left_knee", [1.0, -0.2, 0.0])
    assert not is_valid(TABLE, split)
    limits = LearnedLimits(TABLE, Occupancy.empty().extended(split[None]))
    assert is_valid(limits, split)
    assert is_valid(limits, (split * [-1.0, 1.0, 1.0])[MIRROR])
    poses = wild(7, 500)
    assert is_valid(limits, poses)[is_valid(TABLE, poses)].all()
    np.testing.assert_array_equal(LearnedLimits(TABLE, Occupancy.empty()).num_invalid(poses), TABLE.num_invalid(poses))


def test_the_nearest_valid_pose_of_learned_limits_is_valid_and_keeps_bones() -> None:
    limits = LearnedLimits(TABLE, LEARNED)
    poses = wild(8, 300)
    nearest = limits.nearest_valid(poses)
    assert limits.num_invalid(nearest.positions).max() == 0
    np.testing.assert_allclose(bone_lengths(PAIR17, nearest.positions), bone_lengths(PAIR17, poses), atol=1e-9)
    valid = is_valid(limits, poses)
    assert 10 < valid.sum() < 290
    np.testing.assert_array_equal(nearest.positions[valid], poses[valid])
    assert (nearest.squared_distance_m2[~valid] > 0).all()


def poses_by_subject(data_dir: Path) -> dict[str, np.ndarray]:
    folder = data_dir / "cmu_asfamc"
    poses: dict[str, list[np.ndarray]] = {}
    for file in sorted(folder.glob("0[123]_*.amc")):
        asf = read_asf((folder / f"{file.stem[:2]}.asf").read_bytes())
        motion = read_amc(file.read_bytes(), asf).to_motion(metres_per_unit=asf.metres_per_unit, rate_hz=120.0)
        pair17 = derive_working_poses(motion.resample(12.0), LAYOUTS["cmu_asf"]).pair17_m
        poses.setdefault(file.stem[:2], []).append(pair17)
    return {subject: np.concatenate(parts) for subject, parts in poses.items()}


def with_one_joint_turned(rng: np.random.Generator, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn one bone of each valid pose anyhow; give how far its joint is beyond the published table, radians.

    Second where positions determine the angle (slack under 0.2 rad), third whether or not they do.
    """
    bare = JointLimits(
        lower_rad=np.deg2rad([angle.lower_deg for angle in ANGLES]),
        upper_rad=np.deg2rad([angle.upper_deg for angle in ANGLES]),
        source=TABLE.source,
    )
    turned, determined, any_of = [], [], []
    for bone, (pivot, end, _) in enumerate(LIMIT_BONES):
        moved = poses.copy()
        turn = rotmat_from_unitquat(
            unitquat_from_rotvec(normalise(rng.normal(size=(len(poses), 3))) * rng.uniform(0.3, 2.5, (len(poses), 1)))
        )
        joints = [PAIR17.index(end)]
        for joint in joints:
            joints.extend(PAIR17.children(joint))
        centre = moved[:, [PAIR17.index(pivot)]]
        moved[:, joints] = np.einsum("nij,nkj->nki", turn, moved[:, joints] - centre) + centre
        angles, slack = angles_and_slack(moved)
        own = ANGLES_OF_BONE[bone]
        beyond = np.abs(excess(bare, slice(None), angles, 0.0))[:, own]
        turned.append(moved)
        determined.append(np.where(slack[:, own] < 0.2, beyond, 0.0).max(axis=1))
        any_of.append(beyond.max(axis=1))
    return np.concatenate(turned), np.concatenate(determined), np.concatenate(any_of)


def test_learned_limits_accept_an_unseen_subject_and_refuse_joints_20_degrees_beyond_the_table(data_dir: Path) -> None:
    poses = poses_by_subject(data_dir)
    rng = np.random.default_rng(0)
    accepted, refused, refused_any = [], [], []
    for held_out, own in poses.items():
        others = np.concatenate([parts for subject, parts in poses.items() if subject != held_out])
        limits = LearnedLimits(TABLE, Occupancy.empty().extended(others))
        accepted.append(is_valid(limits, own))
        turned, determined, any_of = with_one_joint_turned(rng, own[is_valid(TABLE, own)])
        is_refused = ~is_valid(limits, turned)
        refused.append(is_refused[determined >= np.deg2rad(20.0)])
        refused_any.append(is_refused[any_of >= np.deg2rad(20.0)])
    share = np.concatenate(accepted)
    assert len(share) > 1000
    assert share.mean() >= 0.995
    assert len(np.concatenate(refused)) > 1000
    assert np.concatenate(refused).mean() >= 0.97
    assert np.concatenate(refused_any).mean() >= 0.95


def test_learned_limits_of_one_pose_at_a_time_are_the_plain_ones_over_arrays() -> None:
    limits = LearnedLimits(TABLE, LEARNED)
    rng = np.random.default_rng(8)
    poses = np.concatenate(
        [wild(6, 40), near_standing(7, 20), standing() + rng.normal(scale=0.06, size=(60, 17, 3)), standing()[None]]
    )
    nearest = limits.nearest_valid(poses)
    invalid = plain_invalid_learned(limits, poses)
    np.testing.assert_array_equal(limits.invalid_angles(poses), invalid)
    np.testing.assert_array_equal(nearest.num_invalid, invalid.sum(axis=1))
    moved = plain_nearest_learned(limits, poses)
    np.testing.assert_allclose(nearest.positions, moved, atol=1e-6)
    np.testing.assert_allclose(nearest.squared_distance_m2, ((moved - poses) ** 2).sum(axis=(1, 2)), atol=1e-9)
    assert 30 < (nearest.num_invalid > 0).sum() < len(poses)
