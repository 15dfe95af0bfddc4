"""Test laws of rotations, forward kinematics and alignment."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from pasdedeux.errors import InputError
from pasdedeux.kinematics import (
    Motion,
    align_rigid,
    bone_directions,
    bone_lengths,
    forward_kinematics,
    local_rotations,
    place_bones,
)
from pasdedeux.kinematics import rotations as rot
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton

Array = npt.NDArray[np.float64]
seeds = st.integers(0, 2**32 - 1)
skeletons = st.sampled_from([PAIR17, OP14, BODY22])
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def _random_pose(skeleton: Skeleton, seed: int, frames: int = 3) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    offsets = rng.normal(size=(skeleton.num_joints, 3)) * 0.3
    roots = rng.normal(size=(frames, 3))
    quats = Rotation.random(frames * skeleton.num_joints, rng=rng).as_quat().reshape(frames, -1, 4)
    return offsets, roots, quats


@given(seeds)
def test_rotation_forms_agree_with_scipy(seed: int) -> None:
    reference = Rotation.random(20, rng=seed)
    second = Rotation.random(20, rng=seed ^ 1)
    quat = reference.as_quat()
    vectors = np.random.default_rng(seed).normal(size=(20, 3))
    assert np.allclose(rot.rotmat_from_unitquat(quat), reference.as_matrix())
    assert np.allclose(rot.unitquat_from_rotmat(reference.as_matrix()), reference.as_quat(canonical=True))
    assert np.allclose(rot.rotvec_from_unitquat(quat), reference.as_rotvec())
    assert np.allclose(rot.rotate(quat, vectors), reference.apply(vectors))
    assert np.allclose(np.abs(np.sum(rot.multiply(quat, second.as_quat()) * (reference * second).as_quat(), -1)), 1.0)


@given(st.floats(0.0, np.pi - 1e-6), seeds)
def test_rotation_vectors_round_trip_down_to_tiny_angles(angle: float, seed: int) -> None:
    axis = rot.normalise(np.random.default_rng(seed).normal(size=3))
    for scale in (1.0, 1e-4, 1e-9, 0.0):
        vector = axis * angle * scale
        assert np.allclose(rot.rotvec_from_unitquat(rot.unitquat_from_rotvec(vector)), vector, atol=1e-12)


@given(seeds, st.floats(0.0, 1.0))
def test_slerp_agrees_with_scipy_on_the_short_arc(seed: int, fraction: float) -> None:
    ends = Rotation.random(2, rng=seed)
    quats = ends.as_quat()
    expected = Slerp([0, 1], ends)(fraction)
    ours = Rotation.from_quat(rot.slerp(quats[0], -quats[1], fraction))
    assert (ours.inv() * expected).magnitude() < 1e-6


@given(seeds)
def test_swing_turns_one_direction_into_the_other_by_the_least_angle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 8, 3))
    swing = rot.swing_between(a, b)
    assert np.allclose(rot.normalise(rot.rotate(swing, a)), rot.normalise(b))
    cosine = np.sum(rot.normalise(a) * rot.normalise(b), axis=-1)
    assert np.allclose(rot.angle_between(swing, IDENTITY), np.arccos(np.clip(cosine, -1, 1)), atol=1e-6)


def test_swing_between_opposite_and_empty_directions_is_defined() -> None:
    up = np.array([0.0, 1.0, 0.0])
    assert np.allclose(rot.rotate(rot.swing_between(up, -up), up), -up)
    assert np.allclose(rot.swing_between(np.zeros(3), up), IDENTITY)


def test_yaw_turns_the_viewing_axis_towards_plus_x() -> None:
    assert np.allclose(rot.yaw_rotmat(np.pi / 2) @ [0, 0, 1], [1, 0, 0])


@given(skeletons, seeds)
def test_forward_kinematics_is_equivariant_under_rigid_motion(skeleton: Skeleton, seed: int) -> None:
    offsets, roots, quats = _random_pose(skeleton, seed)
    turn = Rotation.random(rng=seed)
    shift = np.random.default_rng(seed).normal(size=3)
    positions, _ = forward_kinematics(skeleton, offsets, roots, quats)
    turned = quats.copy()
    turned[:, skeleton.root] = rot.multiply(np.broadcast_to(turn.as_quat(), (len(roots), 4)), quats[:, skeleton.root])
    moved, _ = forward_kinematics(skeleton, offsets, turn.apply(roots) + shift, turned)
    assert np.allclose(moved, turn.apply(positions.reshape(-1, 3)).reshape(positions.shape) + shift)


@given(skeletons, seeds)
def test_forward_kinematics_keeps_bone_lengths_and_placing_bones_inverts_taking_their_directions(
    skeleton: Skeleton, seed: int
) -> None:
    offsets, roots, quats = _random_pose(skeleton, seed)
    positions, _ = forward_kinematics(skeleton, offsets, roots, quats)
    expected = np.linalg.norm(offsets, axis=-1)
    expected[skeleton.root] = 0.0
    assert np.allclose(bone_lengths(skeleton, positions), expected)
    placed = place_bones(skeleton, roots, bone_directions(skeleton, positions), expected)
    assert np.allclose(placed, positions)


@given(skeletons, seeds)
@settings(max_examples=40)
def test_rotations_recovered_from_positions_give_the_positions_back(skeleton: Skeleton, seed: int) -> None:
    offsets, roots, quats = _random_pose(skeleton, seed)
    positions, world = forward_kinematics(skeleton, offsets, roots, quats)
    rest, _ = forward_kinematics(skeleton, offsets, np.zeros(3), np.broadcast_to(IDENTITY, quats.shape[1:]))
    local = local_rotations(skeleton, rest, positions, world)
    again, _ = forward_kinematics(skeleton, offsets, roots, local)
    assert np.allclose(again, positions, atol=1e-6)
    assert np.max(rot.angle_between(local, quats)) < 1e-4


@given(seeds)
def test_alignment_recovers_a_rigid_motion_and_never_mirrors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(4, 12, 3))
    turn = Rotation.random(4, rng=rng).as_matrix()
    moved = np.einsum("bij,bnj->bni", turn, points) + rng.normal(size=(4, 1, 3))
    found = align_rigid(points, moved)
    assert np.allclose(found.apply(points), moved)
    mirrored = align_rigid(points, moved * np.array([-1.0, 1.0, 1.0]))
    assert np.allclose(np.linalg.det(mirrored.rotmat), 1.0)


def _motion(frames: int, rate_hz: float) -> Motion:
    offsets, _, _ = _random_pose(PAIR17, 3)
    time = np.arange(frames) / rate_hz
    vectors = (
        np.stack([np.sin(time), np.cos(2 * time), 0.3 * time], axis=-1)[:, None, :] * np.linspace(0, 1, 17)[:, None]
    )
    return Motion(
        skeleton=PAIR17,
        rest_offsets_m=offsets,
        root_translation_m=np.stack([time, np.ones(frames), np.sin(time)], axis=-1),
        local_unitquat=rot.unitquat_from_rotvec(vectors),
        rate_hz=rate_hz,
    )


def test_resampling_to_a_divisor_of_the_rate_takes_every_nth_frame() -> None:
    motion = _motion(61, 60.0)
    half = motion.resample(30.0)
    assert half.num_frames == 31
    assert np.allclose(half.root_translation_m, motion.root_translation_m[::2])
    assert np.allclose(rot.angle_between(half.local_unitquat, motion.local_unitquat[::2]), 0.0, atol=1e-6)


def test_resampling_keeps_the_duration_to_within_one_frame() -> None:
    motion = _motion(241, 120.0)
    for rate in (24.0, 25.0, 30.0, 59.94):
        last_s = (motion.resample(rate).num_frames - 1) / rate
        assert 2.0 - 1.0 / rate < last_s <= 2.0 + 1e-9


def test_a_motion_with_a_value_that_is_not_finite_names_the_frame() -> None:
    motion = _motion(10, 30.0)
    roots = motion.root_translation_m.copy()
    roots[7, 1] = np.nan
    with pytest.raises(InputError, match="frame 7: a value is not finite"):
        Motion(PAIR17, motion.rest_offsets_m, roots, motion.local_unitquat, 30.0)
