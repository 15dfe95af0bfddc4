"""Positions go through formats of rotations without moving."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.positions_as_motion import exact_motion
from pasdedeux.kinematics import Motion, place_bones
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton
from tests.builders.source_samples import figure_motion


def named(motion: Motion, skeleton: Skeleton) -> np.ndarray:
    positions, _ = motion.world()
    return np.asarray(positions[:, [motion.skeleton.index(name) for name in skeleton.joint_names]])


@pytest.mark.parametrize("skeleton", [BODY22, OP14, PAIR17])
def test_a_motion_of_exact_bones_passes_through_its_positions_also_as_a_file(skeleton: Skeleton) -> None:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(1, skeleton.num_joints, 3)) + 0.4 * rng.normal(size=(9, skeleton.num_joints, 3))
    lengths = np.where(np.array(skeleton.parents) < 0, 0.0, rng.uniform(0.1, 0.5, skeleton.num_joints))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    positions = place_bones(skeleton, rng.normal(size=(9, 3)), directions, lengths)
    motion = exact_motion(skeleton, positions, 24.0)
    np.testing.assert_allclose(named(motion, skeleton), positions, atol=1e-12)
    again = read_bvh(write_bvh(motion)).to_motion(metres_per_unit=0.01, rate_hz=24.0)
    np.testing.assert_allclose(named(again, skeleton), positions, atol=1e-6)


def test_a_body_that_is_rigid_where_it_branches_gets_no_further_joint() -> None:
    positions, _ = figure_motion().world()
    motion = exact_motion(BODY22, positions, 30.0)
    assert motion.skeleton.joint_names == BODY22.joint_names
    np.testing.assert_allclose(named(motion, BODY22), positions, atol=1e-4)


def test_only_joints_that_give_get_further_joints() -> None:
    positions, _ = figure_motion().world()
    positions[:, BODY22.indices(["left_hip", "left_knee", "left_ankle", "left_toe"])] += np.linspace(0, 0.02, 12)[
        :, None, None
    ] * np.array([0.0, 1.0, 0.0])
    motion = exact_motion(BODY22, positions, 30.0)
    added = [name for name in motion.skeleton.joint_names if name not in BODY22.joint_names]
    assert added == ["spine1_base", "left_hip_base", "right_hip_base"]


def test_a_position_that_is_not_finite_is_named() -> None:
    positions, _ = figure_motion().world()
    positions[2, BODY22.index("head"), 1] = np.inf
    with pytest.raises(InputError, match="frame 2: the position of 'head' is not finite"):
        exact_motion(BODY22, positions, 30.0)
