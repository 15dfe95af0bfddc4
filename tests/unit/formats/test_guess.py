"""Guess what a motion file does not state: axis, unit and handedness, from how its bodies stand, step and bend."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.rigs.guess import common_up_axis, guess_mirrored, guess_unit, guess_up_axis
from pasdedeux.formats.source_motion import UP_AXES, SourceMotion
from pasdedeux.kinematics import forward_kinematics, local_rotations
from pasdedeux.kinematics.rotations import multiply, unitquat_from_rotvec
from pasdedeux.skeletons.layouts.fitting import rest_positions
from tests.builders.guesses import guess_motion
from tests.builders.rigs import RIGS, SMALL_BVH, Rig
from tests.builders.source_samples import bvh_text

MIXAMO = RIGS[0]


def turned_axes(up: str, seed: int = 0) -> str:
    """Return left, up and forward of a person, right-handed, of whom this axis of the file points up."""
    axis, sign = up[-1], "-" if up[0] == "-" else "+"
    left = np.random.default_rng(seed).choice([name for name in "xyz" if name != axis])
    column = np.cross(np.eye(3)["xyz".index(left)], (1.0 if sign == "+" else -1.0) * np.eye(3)["xyz".index(axis)])
    front = int(np.argmax(np.abs(column)))
    return f"+{left} {sign}{axis} {'+' if column[front] > 0 else '-'}{'xyz'[front]}"


def positions(motion: SourceMotion) -> np.ndarray:
    """Return the joints (frame, J, 3) in the file's axes and unit."""
    return forward_kinematics(motion.skeleton, motion.rest_offsets, motion.root_translation, motion.local_unitquat)[0]


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_axis_unit_and_handedness_of_every_rig_are_found(rig: Rig) -> None:
    guess = guess_motion(rig.source())
    assert guess.layout == rig.layout
    assert guess.up.axis == rig.axes.split()[1].lstrip("+")
    assert guess.up.confidence > 0.95
    assert (guess.mirror.is_mirrored, guess.mirror.confidence) == (False, 1.0)
    assert guess.unit.metres_per_unit == pytest.approx(rig.metres_per_unit)
    assert guess.unit.height_m == pytest.approx(1.7, abs=0.08)  # 5 %, whatever the rest pose


@pytest.mark.parametrize("pose", ["T", "A", "random"])
@pytest.mark.parametrize("up", UP_AXES)
def test_every_axis_may_point_up_and_upright_means_up(up: str, pose: Literal["T", "A", "random"]) -> None:
    rig = replace(MIXAMO, axes=turned_axes(up), pose=pose)
    source = rig.source()
    guess = guess_motion(source)
    assert (guess.up.axis, guess.mirror.is_mirrored) == (up, False)
    motion = source.to_motion(metres_per_unit=0.01, rate_hz=30.0, up_axis=up)
    places, names = motion.world()[0], motion.skeleton.joint_names
    assert (places[:, names.index("Head"), 1] > places[:, names.index("LeftFoot"), 1] + 1.2).all()
    left = places[:, names.index("LeftUpLeg")] - places[:, names.index("RightUpLeg")]
    foot = places[:, names.index("LeftToeBase")] - places[:, names.index("LeftFoot")]
    assert (np.cross(left, [0.0, 1.0, 0.0]) * foot).sum(axis=-1).mean() > 0  # turned, never mirrored


@given(seed=st.integers(0, 10**6), up=st.sampled_from(list(UP_AXES)), at=st.integers(0, len(RIGS) - 1))
def test_a_mirrored_file_is_found_and_mended(seed: int, up: str, at: int) -> None:
    rig = replace(RIGS[at], axes=turned_axes(up, seed))
    right = rig.source(seed)
    wrong = right.mirrored(up)
    twice = wrong.mirrored(up)
    for name in ("rest_offsets", "local_unitquat", "root_translation"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(right, name))
    mirror = np.array([1.0, 1.0, -1.0]) if up.endswith("x") else np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(positions(wrong), positions(right) * mirror, atol=1e-9 * np.abs(positions(right)).max())
    found, mended = guess_motion(wrong), guess_motion(twice)
    assert (found.up.axis, found.mirror.is_mirrored) == (up, True)
    assert found.mirror.confidence > 0.6
    assert not mended.mirror.is_mirrored


def test_sides_swapped_by_name_are_a_mirrored_file() -> None:
    source = MIXAMO.source()
    opposite = {"Left": "Right", "Right": "Left"}
    names = [re.sub("Left|Right", lambda side: opposite[side[0]], name) for name in source.skeleton.joint_names]
    swapped = replace(source, skeleton=replace(source.skeleton, joint_names=tuple(names)))
    assert guess_mirrored(swapped).is_mirrored
    assert not guess_mirrored(swapped.mirrored()).is_mirrored


@pytest.mark.parametrize(("lean_rad", "axis"), [(0.7, "z"), (1.4, "-y")])
def test_a_body_that_leans_or_lies_against_its_rest_pose_is_no_sure_one(lean_rad: float, axis: str) -> None:
    source = replace(MIXAMO, axes="+x +z -y").source()
    lying = np.tile(unitquat_from_rotvec(np.array([lean_rad, 0.0, 0.0])), (source.num_frames, 1))
    local = source.local_unitquat.copy()
    local[:, 0] = multiply(lying, local[:, 0])
    guess = guess_up_axis(replace(source, local_unitquat=local))
    assert (guess.axis, guess.confidence) == (axis, 0.5)
    sure = guess_up_axis(replace(MIXAMO, axes="+x +z -y").source())
    assert common_up_axis([guess, sure]) == sure


def test_a_rest_pose_that_is_no_person_raises_no_doubt_of_one_frame_that_stands() -> None:
    """In some files every joint has a frame of its own, so that every bone points along x at rest."""
    source = replace(MIXAMO, pose="random").source().frames(0, 1)
    along = np.linalg.norm(source.rest_offsets, axis=-1)[:, None] * np.array([1.0, 0.0, 0.0])
    local = local_rotations(source.skeleton, rest_positions(source.skeleton, along), positions(source))
    guess = guess_up_axis(replace(source, rest_offsets=along, local_unitquat=local))
    assert guess.axis == "y"
    assert guess.confidence > 0.9


def test_a_handstand_leaves_the_up_axis_in_doubt() -> None:
    """The feet of somebody who stands on the hands are above the head, so the wrong axis may seem to point up."""
    source = read_bvh(SMALL_BVH)
    names = source.skeleton.joint_names
    still = SourceMotion.at_rest(source.skeleton, source.rest_offsets)
    frames = 20
    local = np.tile(still.local_unitquat, (frames, 1, 1))
    swing = unitquat_from_rotvec(np.linspace(0.0, 1.0, frames)[:, None] * [-1.0, 0.0, 0.0])
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        local[:, names.index(f"{side}Arm")] = unitquat_from_rotvec(np.array([0.0, 0.0, sign * np.pi / 2]))
        local[:, names.index(f"{side}UpLeg")] = swing
    on_hands = replace(still, local_unitquat=local, root_translation=np.zeros((frames, 3)))
    assert guess_up_axis(on_hands).confidence < 0.6
    local[:, names.index("LeftArm")] = still.local_unitquat[:, 0]
    assert guess_up_axis(replace(on_hands, local_unitquat=local)).confidence > 0.9


def test_feet_tell_the_sides_of_a_person_who_stands_still() -> None:
    guess = guess_motion(read_bvh(SMALL_BVH))
    assert guess.unit.metres_per_unit == 0.01
    assert guess.unit.height_m == pytest.approx(1.69, abs=0.05)
    assert not guess.mirror.is_mirrored
    assert guess_mirrored(read_bvh(SMALL_BVH).mirrored()).is_mirrored


@pytest.mark.slow
def test_real_files_are_upright_and_no_mirrors(data_dir: Path) -> None:
    for name, axis in {"cmu_salsa_bvh/60_01.bvh": "y", "contact_pairs/stack_push_up001_S2.bvh": "z"}.items():
        guess = guess_motion(read_bvh((data_dir / name).read_bytes()))
        assert (guess.up.axis, guess.mirror.is_mirrored) == (axis, False)


@pytest.mark.parametrize(
    ("stated_m", "unit_m"), [(0.0254, 0.01), (1.0, 0.01), (0.001, 0.01), (0.01, 0.01), (0.0115, 0.0115)]
)
def test_a_stated_unit_that_makes_a_giant_or_a_doll_is_not_sure(stated_m: float, unit_m: float) -> None:
    source = replace(read_bvh(bvh_text()), metres_per_unit=stated_m)
    guess = guess_unit(source)
    assert guess.metres_per_unit == unit_m
    assert 1.35 < guess.height_m < 2.1
    assert (guess.confidence == 1.0) == (stated_m == unit_m)
    assert ("the unit that the file states makes the body" in guess.reason) == (stated_m != unit_m)
