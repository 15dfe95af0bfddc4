"""Recognise rigs of programs in use under any spelling; their derived joints lie where the person's are."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.rigs.own_skeleton import OwnSkeleton, body_map
from pasdedeux.formats.rigs.working_poses import check_layout, derive_working_poses
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.layouts import LAYOUTS, find_layout, fit_layout, resolve_layout
from tests.builders.rigs import RIGS, Rig, truth

XSENS = next(rig for rig in RIGS if rig.name == "xsens")
EXACT_CM = 1e-6
TOLERANCE_CM = {"pelvis": 4.0, "neck": 2.0, "head": 3.5, "toe": 1.0, "collar": 10.0}
"""A joint that a file has is exact.  A pelvis between hips lies 2.5 cm below the joint that rigs have, Daz's hip 3.4 cm
above it; a neck between shoulders and head 1.1 cm away; ears 2.1 cm, where a file has no head, or 3.1, where it is
CMU's; a ball of the
foot 0.2 cm, by the same proportions; collars without a joint lie at a quarter of the shoulder's breadth."""


def errors_cm(rig: Rig, motion: SourceMotion) -> dict[str, float]:
    """Return the greatest distance of each joint of body22 from the person's, centimetres."""
    layout = find_layout(motion.skeleton, motion.rest_offsets)
    placed = motion.to_motion(metres_per_unit=rig.metres_per_unit, rate_hz=30.0)
    check_layout(placed, layout)
    found, places = rig.to_person(derive_working_poses(placed, layout).body22_m), truth(rig)
    return {
        joint: 100.0 * float(np.linalg.norm(found[:, at] - places["ear" if joint == "head" else joint], axis=-1).max())
        for at, joint in enumerate(BODY22.joint_names)
        if not joint.startswith("spine")
    }


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_every_rig_is_recognised_and_its_joints_lie_where_the_persons_are(rig: Rig) -> None:
    motion = rig.source()
    layout = find_layout(motion.skeleton, motion.rest_offsets)
    assert layout.name == rig.layout
    has = rig.names.keys()
    for joint, error in errors_cm(rig, motion).items():
        part = joint.rpartition("_")[2]
        is_exact = joint in has and isinstance(layout.parts[joint], str) and joint not in ("head", "pelvis")
        assert error < (EXACT_CM if is_exact else TOLERANCE_CM[part]), joint
        if part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            assert is_exact, joint
    assert not {"left_toe", "right_toe", "left_collar", "neck"} & has & set(layout.derived)
    if "left_collar" not in has:
        assert {"left_collar", "right_collar"} <= set(layout.derived)


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_the_nose_is_before_the_ears_where_the_rest_pose_tells_it(rig: Rig) -> None:
    motion = rig.source()
    layout = find_layout(motion.skeleton, motion.rest_offsets)
    poses = derive_working_poses(motion.to_motion(metres_per_unit=rig.metres_per_unit, rate_hz=30.0), layout)
    before = rig.to_person(poses.op14_m[0, 0]) - truth(rig)["ear"][0]
    assert (before[2] > 0.03) == (rig.pose != "random")
    assert abs(before[0]) < 0.02
    assert abs(before[1]) < 0.06


SPELLINGS: dict[str, Callable[[str], str]] = {
    "namespace": lambda name: f"somebody:{name}",
    "two namespaces": lambda name: f"scene:rig7:{name}",
    "path": lambda name: f"group|{name}",
    "namespace with a number": lambda name: f"mixamorig12:{name}",
    "prefix": lambda name: f"Character1_{name}",
    "small": str.lower,
    "capitals": str.upper,
    "suffix": lambda name: re.sub("(:1)?$", "_jnt", name, count=1),
    "copy": lambda name: name if name.startswith("spine") else f"{name}.002",  # Rigify numbers its spine so
    "hash": lambda name: f"{name}#",
    "underscores for dots": lambda name: name.replace(".", "_").replace(" ", "_"),
}


def renamed(motion: SourceMotion, names: Sequence[str]) -> SourceMotion:
    """Return a motion with other names of its joints."""
    return replace(motion, skeleton=Skeleton("bvh", tuple(names), motion.skeleton.parents))


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_spelling_changes_neither_layout_nor_joints(rig: Rig) -> None:
    motion = rig.source()
    plain = find_layout(motion.skeleton, motion.rest_offsets)
    for spelling, respelled in SPELLINGS.items():
        changed = renamed(motion, [respelled(name) for name in motion.skeleton.joint_names])
        found = find_layout(changed.skeleton, changed.rest_offsets)
        assert found is not None, spelling
        assert (found.name, found.derived) == (plain.name, plain.derived), spelling
        to_plain = dict(zip(changed.skeleton.joint_names, motion.skeleton.joint_names, strict=True))
        ours, theirs = found.joint_map("body22"), plain.joint_map("body22")
        for joint in BODY22.joint_names:
            weights = {to_plain.get(name, name): weight for name, weight in ours.weights(joint).items()}
            assert weights == theirs.weights(joint), (spelling, joint)
        # A layout that is named is the same one, under whatever spelling.
        assert resolve_layout(plain.name, changed.skeleton, changed.rest_offsets) == found, spelling


def test_what_a_layout_needs_is_said_by_its_own_names() -> None:
    motion = XSENS.source()
    without = renamed(motion, [name.replace("LeftKnee", "thing") for name in motion.skeleton.joint_names])
    assert find_layout(without.skeleton, without.rest_offsets) is None
    with pytest.raises(InputError, match=r"layout 'xsens' needs LeftKnee; joints: Hips, "):
        fit_layout("xsens", without.skeleton, without.rest_offsets)
    with pytest.raises(InputError, match=r"fit none .* the nearest is xsens, which also needs LeftKnee; joints: Hips"):
        resolve_layout("auto", without.skeleton, without.rest_offsets)
    with pytest.raises(InputError, match=r"layout 'odd' is not known; known: body22, .*, mine"):
        resolve_layout("odd", without.skeleton, without.rest_offsets, {"mine": {}})


def test_parts_of_a_mapping_are_enough_and_the_rest_is_derived() -> None:
    motion = XSENS.source()
    names = {part: f"j{at}" for at, part in enumerate(XSENS.names)}
    new_name = dict(zip(XSENS.names.values(), names.values(), strict=True))
    odd = renamed(motion, [new_name[name] for name in motion.skeleton.joint_names])
    parts = {part: names[part] for part in names if not part.startswith("spine") and part != "head"}
    parts["skull"] = names["head"]
    found = resolve_layout("mine", odd.skeleton, odd.rest_offsets, {"mine": {"parts": parts}})
    known = find_layout(motion.skeleton, motion.rest_offsets)
    assert found.derived == known.derived
    placed, plain = (file.to_motion(metres_per_unit=XSENS.metres_per_unit, rate_hz=30.0) for file in (odd, motion))
    expected = vars(derive_working_poses(plain, known))
    for name, positions in vars(derive_working_poses(placed, found)).items():
        np.testing.assert_array_equal(positions, expected[name])
    del parts["left_knee"]
    with pytest.raises(InputError, match="mapping 'mine': its parts lack left_knee"):
        resolve_layout("mine", odd.skeleton, odd.rest_offsets, {"mine": {"parts": parts}})


def test_changes_to_a_known_layout_reach_files_with_a_namespace() -> None:
    motion = RIGS[1].source()
    mappings = {"mixamo": {"pair17": {"head": {"Head": 0.5, "Neck": 0.5}, "spine": "Spine1"}}}
    found = resolve_layout("auto", motion.skeleton, motion.rest_offsets, mappings).joint_map("pair17")
    assert found.weights("head") == {"mixamorig:Head": 0.5, "mixamorig:Neck": 0.5}
    assert found.weights("spine") == {"mixamorig:Spine1": 1.0}


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_every_rig_can_be_posed_and_scaled_by_its_body22(rig: Rig) -> None:
    motion = rig.source().to_motion(metres_per_unit=rig.metres_per_unit, rate_hz=30.0)
    layout = find_layout(motion.skeleton, motion.rest_offsets_m)
    rigged = OwnSkeleton(motion, body_map(layout, motion.skeleton, motion.rest_offsets_m))
    body22_m, ones = rigged.body.of(motion), np.ones(BODY22.num_joints)
    np.testing.assert_allclose(rigged.posed(body22_m, ones).world()[0], motion.world()[0], atol=1e-6)
    larger = rigged.retargeted(1.15 * body22_m, 1.15 * ones)
    np.testing.assert_allclose(larger.body.of(larger.motion), 1.15 * body22_m, atol=1e-3)


def test_there_are_rigs_of_all_layouts_of_other_programs() -> None:
    on_real_files = {"body22", "expi", "yiannakides"}  # in test_layouts.py and test_expi.py
    assert {rig.layout for rig in RIGS} == set(LAYOUTS) - on_real_files
