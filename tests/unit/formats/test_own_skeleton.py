"""Scale and pose the skeleton of a source by body22: at scale 1 the source itself comes back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.errors import InputError
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.own_skeleton import OwnSkeleton, body_map, ended, standing, with_end_sites
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import Motion, bone_directions, bone_lengths, place_bones
from pasdedeux.kinematics.rotations import angle_between, multiply, unitquat_from_rotvec
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from pasdedeux.skeletons.layouts import LAYOUTS, find_layout
from tests.builders.own_sources import real_motions, write_walk
from tests.builders.source_samples import figure_motion

EXTREMITIES = BODY22.indices(f"{side}_{joint}" for side in ("left", "right") for joint in ("wrist", "ankle", "toe"))


def rig(seed: int = 0) -> OwnSkeleton:
    """Return the figure with a rig's names, one more joint in the left forearm, a thumb and the crown of the head."""
    figure = figure_motion(seed=seed)
    names = [HUMANOID_NAMES[joint] for joint in BODY22.joint_names]
    parents, offsets = list(BODY22.parents), list(figure.rest_offsets_m)
    elbow, wrist = BODY22.indices(["left_elbow", "left_wrist"])
    twist = len(names)
    parents[wrist], offsets[wrist] = twist, 0.4 * offsets[wrist]
    names += ["LeftForeArmRoll", "LeftHandThumb1", "Head_end"]
    parents += [elbow, wrist, BODY22.index("head")]
    offsets += [1.5 * offsets[wrist], np.array([0.03, -0.01, 0.03]), np.array([0.0, 0.17, 0.0])]
    turns = np.zeros((figure.num_frames, 3, 3))
    turns[:, 0, 0], turns[:, 1] = 0.5, np.random.default_rng(seed).normal(0.0, 0.5, 3)
    motion = Motion(
        Skeleton("rig", tuple(names), tuple(parents)),
        np.array(offsets),
        figure.root_translation_m,
        np.concatenate([figure.local_unitquat, unitquat_from_rotvec(turns)], axis=1),
        30.0,
    )
    return OwnSkeleton(motion, body_map(LAYOUTS["mixamo"], motion.skeleton, motion.rest_offsets_m))


def walk(folder: Path) -> OwnSkeleton:
    amc = write_walk(folder)
    source = read_amc(amc.read_bytes(), read_asf(next(folder.glob("*.asf")).read_bytes()))
    motion = source.to_motion(metres_per_unit=0.0254 / 0.45, rate_hz=120.0)
    return OwnSkeleton(motion, body_map(LAYOUTS["cmu_asf"], motion.skeleton, motion.rest_offsets_m))


def assert_same(found: Motion, expected: Motion, *, metres: float, degrees: float) -> None:
    """Compare the joints that are expected; more may be found behind them."""
    joints = expected.skeleton.num_joints
    assert found.skeleton.joint_names[:joints] == expected.skeleton.joint_names
    (places, turns), (expected_places, expected_turns) = found.world(), expected.world()
    np.testing.assert_allclose(places[:, :joints], expected_places, atol=metres)
    assert np.rad2deg(angle_between(turns[:, :joints], expected_turns).max()) < degrees


def scaled(rigged: OwnSkeleton, bone_scale: np.ndarray) -> np.ndarray:
    """Return the source's bone directions with other lengths: what a body of these proportions makes of it."""
    body = rigged.body.of(rigged.motion)
    lengths = np.median(bone_lengths(BODY22, body), axis=0)
    return place_bones(BODY22, body[:, BODY22.root], bone_directions(BODY22, body), lengths * bone_scale)


def test_at_scale_one_the_source_comes_back_from_its_own_body22(tmp_path: Path) -> None:
    for rigged in (rig(), walk(tmp_path)):
        ones = np.ones(BODY22.num_joints)
        assert_same(rigged.posed(rigged.body.of(rigged.motion), ones), rigged.motion, metres=1e-9, degrees=1e-4)
        # A variant's bones are constant, while the neck of ASF spans two joints that move.
        assert_same(rigged.retargeted(scaled(rigged, ones), ones).motion, rigged.motion, metres=1e-9, degrees=1e-4)


@settings(max_examples=25)
@given(scale=st.floats(0.5, 1.5))
def test_a_uniform_scale_scales_every_offset_and_turns_nothing(scale: float) -> None:
    rigged = rig()
    scales = np.full(BODY22.num_joints, scale)
    worn = rigged.retargeted(scaled(rigged, scales), scales)
    np.testing.assert_allclose(worn.motion.rest_offsets_m[1:], scale * rigged.motion.rest_offsets_m[1:], atol=1e-9)
    assert np.rad2deg(angle_between(worn.motion.world()[1], rigged.motion.world()[1]).max()) < 1e-3


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_bones_have_the_lengths_asked_for_and_hands_and_feet_lie_where_they_are_wanted(seed: int) -> None:
    rigged = rig(seed)
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.75, 1.25, BODY22.num_joints)[np.minimum(np.arange(BODY22.num_joints), BODY22.mirror)]
    wanted = scaled(rigged, scales)
    worn = rigged.retargeted(wanted, scales)
    body = worn.body.of(worn.motion)
    rigid = [joint for joint in range(1, BODY22.num_joints) if BODY22.joint_names[joint] != "head"]
    lengths, expected = (bone_lengths(BODY22, places)[:, rigid] for places in (body, wanted[:1]))
    np.testing.assert_allclose(lengths, np.broadcast_to(expected, lengths.shape), rtol=1e-3)
    assert np.linalg.norm(body - wanted, axis=-1)[:, EXTREMITIES].max() < 5e-3
    thumb, crown = rigged.motion.skeleton.indices(["LeftHandThumb1", "Head_end"])
    np.testing.assert_allclose(
        worn.motion.local_unitquat[:, [thumb, crown]], rigged.motion.local_unitquat[:, [thumb, crown]], atol=1e-9
    )
    after, before = (np.linalg.norm(skeleton.motion.rest_offsets_m[thumb]) for skeleton in (worn, rigged))
    assert after / before == pytest.approx(scales[BODY22.index("left_wrist")], rel=1e-3)


def test_a_standing_rest_pose_leaves_joints_and_global_rotations_where_they_are(tmp_path: Path) -> None:
    for rigged in (rig(), walk(tmp_path)):
        stood = standing(rigged)
        places, turns = rigged.motion.world()
        its_places, its_turns = stood.motion.world()
        np.testing.assert_allclose(its_places, places, atol=1e-9)
        frames = multiply(its_turns[0] * [-1, -1, -1, 1], turns[0])
        np.testing.assert_allclose(
            np.abs((multiply(its_turns, np.broadcast_to(frames, its_turns.shape)) * turns).sum(-1)), 1.0, atol=1e-9
        )
        np.testing.assert_allclose(stood.body.of(stood.motion), rigged.body.of(rigged.motion), atol=1e-9)
        rest = dict(zip(BODY22.joint_names, stood.rest_body22_m, strict=True))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            arm = rest[f"{side}_wrist"] - rest[f"{side}_shoulder"]
            assert sign * arm[0] > 0.3
            np.testing.assert_allclose(arm[1:], 0.0, atol=1e-6)
            leg = rest[f"{side}_ankle"] - rest[f"{side}_hip"]
            np.testing.assert_allclose(leg[[0, 2]], 0.0, atol=1e-6)
            assert leg[1] < -0.5
            assert rest[f"{side}_toe"][2] > rest[f"{side}_ankle"][2] + 0.05
        assert rest["head"][1] > rest["neck"][1] > rest["spine1"][1] > rest["left_knee"][1]


def test_every_joint_that_is_drawn_has_a_length(tmp_path: Path) -> None:
    for rigged in (
        rig(),
        walk(tmp_path),
        OwnSkeleton(figure_motion(), body_map(LAYOUTS["body22"], BODY22, figure_motion().rest_offsets_m)),
    ):
        motion = with_end_sites(rigged).motion
        assert_same(motion, rigged.motion, metres=0.0, degrees=1e-5)
        for joint, name in enumerate(motion.skeleton.joint_names):
            below = list(motion.skeleton.children(joint))
            if below:
                ends = [child for child in below if motion.skeleton.joint_names[child] == f"{name}_end"]
                assert np.linalg.norm(motion.rest_offsets_m[ends or below].mean(axis=0)) > 1e-3, name
            else:
                assert name.endswith("_end")
        again = read_bvh(write_bvh(motion)).to_motion(metres_per_unit=0.01, rate_hz=motion.rate_hz)
        assert set(again.skeleton.joint_names) == set(motion.skeleton.joint_names)


def test_an_end_at_its_parent_continues_the_last_bone_that_has_a_length() -> None:
    plain = figure_motion()
    toe = plain.skeleton.index("left_toe")
    motion = plain.with_joints(["tip"], [toe], [np.zeros(3)])
    ends = ended(motion)
    tip = ends.rest_offsets_m[ends.skeleton.index("tip_end")]
    along = plain.rest_offsets_m[toe]
    np.testing.assert_allclose(tip / np.linalg.norm(tip), along / np.linalg.norm(along), atol=1e-9)


def test_other_frames_than_the_motion_has_are_refused() -> None:
    rigged = rig()
    with pytest.raises(InputError, match="body22 has the shape \\(3, 22, 3\\); the motion has 12 frames"):
        rigged.posed(rigged.body.of(rigged.motion)[:3], np.ones(BODY22.num_joints))


def test_weights_derive_body22_of_real_files_as_their_layouts_do(data_dir: Path) -> None:
    for name, motion in real_motions(data_dir).items():
        layout = find_layout(motion.skeleton, motion.rest_offsets_m)
        part = motion.first_frames(60)
        rigged = OwnSkeleton(part, body_map(layout, part.skeleton, part.rest_offsets_m))
        wanted = derive_working_poses(part, layout).body22_m
        np.testing.assert_allclose(rigged.body.of(part), wanted, atol=1e-9, err_msg=name)
        assert_same(rigged.posed(rigged.body.of(part), np.ones(BODY22.num_joints)), part, metres=1e-8, degrees=1e-4)


def test_straight_legs_stay_straight_when_a_variant_bends_its_back() -> None:
    rigged = rig()
    still = rigged.motion.local_unitquat.copy()
    still[:, rigged.motion.skeleton.indices(["LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg"])] = [0.0, 0.0, 0.0, 1.0]
    rigged = OwnSkeleton(replace(rigged.motion, local_unitquat=still), rigged.body)
    ones = np.ones(BODY22.num_joints)
    wanted = scaled(rigged, ones)
    above = BODY22.indices(name for name in BODY22.joint_names if not name.endswith(("hip", "knee", "ankle", "toe")))
    wanted[::2, above] += [0.0, 0.01, 0.0]  # every other frame the whole trunk is a centimetre further from the hips
    worn = rigged.retargeted(wanted, ones)
    away_m = np.linalg.norm(worn.body.of(worn.motion) - wanted, axis=-1)
    assert away_m[:, EXTREMITIES].max() < 1e-3
    assert away_m[:, BODY22.indices(["left_knee", "right_knee"])].max() < 0.015
