"""Test laws of the whole body: it passes through the joints of op14, on rigid bones, from a standing T-pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.humanoid import HumanoidMotion, write_npz
from pasdedeux.formats.npz import read_npz
from pasdedeux.kinematics import Motion, bone_lengths, forward_kinematics
from pasdedeux.kinematics.rotations import conjugate, multiply, rotate, unitquat_from_rotvec
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, retarget_proportions
from pasdedeux.reconstruction.body import (
    REFERENCE_REST_M,
    SHARED,
    Bends,
    bends_of,
    body_through,
    body_with_bones,
    embody,
    hold_hips,
    pose_body,
    rotations_from_t_pose,
)
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.humanoid import HUMANOID, HUMANOID_NAMES
from tests.builders.walkers import random_poses, reconstruction, walk

SEEDS = st.integers(0, 10_000)
IN_BODY22, IN_OP14 = BODY22.indices(SHARED), OP14.indices(SHARED)


def bends(rng: np.random.Generator, count: int, spread: float) -> Bends:
    rotvec = rng.normal(0, spread, (count, BODY22.num_joints, 3))
    return Bends(unitquat_from_rotvec(rotvec), unitquat_from_rotvec(rng.normal(0, spread, (count, 3))))


def placed(body, pelvis, unitquat) -> np.ndarray:
    return forward_kinematics(BODY22, body.offsets_m, pelvis, unitquat)[0]


@given(seed=SEEDS, spread=st.sampled_from([0.0, 0.1, 0.3]))
def test_a_body_passes_through_hips_shoulders_and_limbs_whatever_the_match_says(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    poses = hold_hips(reconstruction(random_poses(rng, 8, spread=0.3))).positions_m
    body = body_through(poses)
    positions = placed(body, *pose_body(body, poses, bends(rng, 8, spread)))
    away = np.linalg.norm(positions[:, IN_BODY22] - poses[:, IN_OP14], axis=-1)
    # Shoulders that random poses put further away than a spine is long are not reached; the wrists are.
    is_reached = away[:, [SHARED.index("left_shoulder"), SHARED.index("right_shoulder")]].max(axis=1) < 1e-9
    assert is_reached.mean() >= 0.5
    assert away[is_reached].max() < 1e-8
    lengths = bone_lengths(BODY22, positions)
    np.testing.assert_allclose(lengths, np.linalg.norm(body.offsets_m, axis=-1)[None] + 0 * lengths, atol=1e-12)


@given(seed=SEEDS)
def test_a_body_turns_and_moves_with_its_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = hold_hips(reconstruction(walk(6, seed=seed))).positions_m
    body, said = body_through(poses), bends(rng, 6, 0.1)
    turn, shift = unitquat_from_rotvec(rng.normal(0, 1, 3)), rng.normal(0, 1, 3)
    pelvis, unitquat = pose_body(body, poses, said)
    moved_pelvis, moved = pose_body(body, rotate(turn, poses) + shift, said)
    np.testing.assert_allclose(moved_pelvis, rotate(turn, pelvis) + shift, atol=1e-7)
    expected = np.array(unitquat)
    expected[:, BODY22.root] = multiply(np.broadcast_to(turn, (6, 4)), unitquat[:, BODY22.root])
    np.testing.assert_allclose(np.abs(np.sum(moved * expected, axis=-1)), 1.0, atol=1e-9)


def test_a_person_in_the_t_pose_is_turned_nowhere() -> None:
    positions = np.zeros((1, 14, 3))
    positions[0, IN_OP14] = REFERENCE_REST_M[IN_BODY22]
    positions[0, OP14.root] = positions[0, OP14.indices(["left_shoulder", "right_shoulder"])].mean(axis=0)
    nose = unitquat_from_rotvec(np.zeros(3))
    positions[0, OP14.index("head")] = positions[0, OP14.root] + rotate(nose, np.array([0.0, 0.85, 0.52678]) * 0.18)
    body = body_through(positions)
    _, unitquat = pose_body(body, positions)
    assert np.rad2deg(2 * np.arccos(np.clip(np.abs(unitquat[..., 3]), 0, 1))).max() < 1.0


def test_held_hips_keep_every_bone_and_move_neither_hands_nor_feet() -> None:
    poses = walk(30)
    poses[:, OP14.index("left_hip")] += 0.02 * np.sin(np.arange(30))[:, None]
    poses = retarget_proportions(poses)
    held = hold_hips(reconstruction(poses)).positions_m
    lengths = bone_lengths(OP14, held)
    np.testing.assert_allclose(lengths, REFERENCE_LENGTHS_M + 0 * lengths, atol=1e-9)
    hips = held[:, OP14.indices(["left_hip", "right_hip"])]
    assert np.ptp(np.linalg.norm(hips[:, 0] - hips[:, 1], axis=-1)) < 1e-9
    assert np.ptp(np.linalg.norm(poses[:, 8] - poses[:, 11], axis=-1)) > 0.005
    still = OP14.indices(["left_wrist", "right_wrist", "neck", "head"])
    np.testing.assert_array_equal(held[:, still], poses[:, still])
    ankles = OP14.indices(["left_ankle", "right_ankle"])
    assert np.linalg.norm(held[:, ankles] - poses[:, ankles], axis=-1).max() < 2e-3


def test_spine_and_head_and_feet_are_those_of_the_match() -> None:
    """A pose that is looked up and found whole comes back whole."""
    rng = np.random.default_rng(2)
    body = body_with_bones(REFERENCE_LENGTHS_M, 0.189)
    upright = hold_hips(reconstruction(walk(40, turn_rad=0.0))).positions_m
    pelvis, unitquat = pose_body(body, upright, bends(rng, 40, 0.06))
    truth = placed(body, pelvis, unitquat)
    centred = centre_and_face(upright)
    turned = np.array(unitquat)
    turn = unitquat_from_rotvec(np.stack([0 * centred.heading_rad, -centred.heading_rad, 0 * centred.heading_rad], -1))
    turned[:, BODY22.root] = multiply(turn, unitquat[:, BODY22.root])
    database = Database(
        centred.poses_m.astype(np.float32), np.zeros(40, dtype=bool), body22_unitquat=turned.astype(np.float32)
    )
    again = placed(body, *pose_body(body, upright, bends_of(database, np.arange(40))))
    assert np.linalg.norm(again - truth, axis=-1).max() < 1e-3
    plain = placed(body, *pose_body(body, upright))
    assert np.linalg.norm(plain - truth, axis=-1).max() > 0.02


@given(seed=SEEDS)
def test_rotations_from_the_t_pose_are_found_again_in_a_source_that_rests_otherwise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    offsets = REFERENCE_REST_M - REFERENCE_REST_M[np.maximum(BODY22.parents, 0)]
    truth = bends(rng, 4, 0.5).unitquat
    positions, world = forward_kinematics(BODY22, offsets, np.zeros((4, 3)), truth)
    # The source rests as it stands in its first frame, and counts its rotations from there.
    since = multiply(world, conjugate(world[:1]))
    found = rotations_from_t_pose(positions, since, positions[0])
    np.testing.assert_allclose(forward_kinematics(BODY22, offsets, positions[:, 0], found)[0], positions, atol=1e-6)


def test_feet_do_not_sink_into_the_floor() -> None:
    poses = hold_hips(reconstruction(walk(30))).positions_m
    body = body_through(poses)
    toes = BODY22.indices(["left_toe", "right_toe"])
    down = unitquat_from_rotvec(np.array([0.8, 0.0, 0.0]))
    said = Bends.none(30)
    said.unitquat[:, BODY22.indices(["left_ankle", "right_ankle"])] = down
    floor = float(poses[:, OP14.indices(["left_ankle", "right_ankle"]), 1].min()) - body.ankle_height_m
    sunk, kept = (
        placed(body, *pose_body(body, poses, said, floor_m=height))[:, toes, 1].min() - floor - body.toe_height_m
        for height in (-np.inf, floor)
    )
    assert sunk < -0.03
    assert kept > -1e-9


def test_bridged_frames_bend_between_their_neighbours() -> None:
    poses = hold_hips(reconstruction(walk(20))).positions_m
    whole = embody(
        Database(centre_and_face(poses).poses_m.astype(np.float32), np.zeros(20, dtype=bool)),
        reconstruction(poses, num_bridged=5),
        poses,
        window=7,
    )
    assert np.isfinite(whole.unitquat).all()
    away = whole.motion(24.0).world()[0][:, IN_BODY22] - poses[:, IN_OP14]
    assert np.abs(away).max() < 1e-8


def test_files_hold_the_motion_with_hips_as_root_and_no_bone_without_length() -> None:
    poses = hold_hips(reconstruction(walk(12) + np.array([0.4, 0.0, -2.0]))).positions_m
    body = body_through(poses)
    motion = Motion(BODY22, body.offsets_m, *pose_body(body, poses), 24.0)
    person = HumanoidMotion(motion, 7, np.arange(12) > 1)
    truth = motion.world()[0]
    arrays = read_npz(write_npz(person), "motion")
    assert arrays["joint_names"].tolist() == list(HUMANOID.joint_names)
    np.testing.assert_allclose(arrays["positions_m"][:, : BODY22.num_joints], truth, atol=1e-12)
    for units, metres in (("cm", 0.01), ("m", 1.0)):
        source = read_bvh(person.bvh(units)).to_motion(metres_per_unit=metres, rate_hz=24.0)
        names = source.skeleton.joint_names
        assert names[source.skeleton.root] == "Hips"
        assert set(names) == set(HUMANOID.joint_names)
        lengths = np.linalg.norm(source.rest_offsets_m, axis=-1)
        assert lengths[[at for at in range(len(names)) if at != source.skeleton.root]].min() > 0.01
        at = [names.index(HUMANOID_NAMES[joint]) for joint in BODY22.joint_names]
        np.testing.assert_allclose(source.world()[0][:, at], truth, atol=1e-6)
        rest = source.rest_positions_m()[at]
        head, toe, wrist = (rest[BODY22.index(name)] for name in ("head", "left_toe", "left_wrist"))
        assert head[1] > 0.5
        assert toe[1] < -0.8
        assert toe[2] > 0.1
        assert wrist[0] == pytest.approx(np.abs(rest[:, 0]).max())
        assert abs(wrist[1] - rest[BODY22.index("left_shoulder"), 1]) < 1e-6
