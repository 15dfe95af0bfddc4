"""Draft mappings of joints that no layout knows, by names, tree and pose; mark guesses."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.rigs.guess import draft_motion
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.layouts import Draft, draft_mapping, find_layout, resolve_layout
from pasdedeux.skeletons.layouts.recognising import NEEDED
from tests.builders.guesses import guess_motion
from tests.builders.rigs import RIGS, SMALL_BVH, Rig


def renamed(motion: SourceMotion, seed: int) -> tuple[SourceMotion, dict[str, str]]:
    """Return a motion whose joints have names that say nothing, and the old name of each."""
    numbers = np.random.default_rng(seed).permutation(motion.skeleton.num_joints)
    names = tuple(f"q{number}z" for number in numbers)
    skeleton = Skeleton("bvh", names, motion.skeleton.parents)
    return replace(motion, skeleton=skeleton), dict(zip(names, motion.skeleton.joint_names, strict=True))


def differences(draft: Draft, motion: SourceMotion, old_names: dict[str, str]) -> dict[str, str]:
    """Return the parts of a draft that the layout of the motion has other joints for."""
    known = find_layout(motion.skeleton, motion.rest_offsets)
    expected = {part: entry for part, entry in known.parts.items() if isinstance(entry, str)}
    drafted = {part.part: old_names[part.joint] for part in draft.parts if part.joint}
    return {part: joint for part, joint in drafted.items() if joint != expected.get(part, joint)}


@given(st.sampled_from(RIGS), st.integers(0, 10**6))
def test_meaningless_names_do_not_change_the_mapping_of_any_rig(rig: Rig, seed: int) -> None:
    motion = rig.source(seed)
    odd, old_names = renamed(motion, seed)
    draft = draft_motion(odd)
    assert not draft.missing
    assert differences(draft, motion, old_names) == {}
    assert not any(part.is_sure for part in draft.parts)
    known = find_layout(motion.skeleton, motion.rest_offsets)
    limbs = [joint for joint in BODY22.joint_names if joint.startswith(("left", "right"))]
    assert set(limbs) & set(draft.layout("mine").derived) == set(limbs) & set(known.derived)


def with_chain(motion: SourceMotion, parent: str, bones: list[np.ndarray]) -> SourceMotion:
    """Return a motion with further joints, one below the other, that do not turn."""
    skeleton, count = motion.skeleton, motion.skeleton.num_joints
    parents = (skeleton.index(parent), *range(count, count + len(bones) - 1))
    names = tuple(f"x{count + at}" for at in range(len(bones)))
    still = np.tile([0.0, 0.0, 0.0, 1.0], (motion.num_frames, len(bones), 1))
    return replace(
        motion,
        skeleton=Skeleton("bvh", skeleton.joint_names + names, skeleton.parents + parents),
        rest_offsets=np.concatenate([motion.rest_offsets, bones]),
        local_unitquat=np.concatenate([motion.local_unitquat, still], axis=1),
    )


@pytest.mark.parametrize("seed", range(30))
def test_limbs_are_found_in_bodies_of_other_proportions_with_fingers_twists_hair_and_a_sword(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = RIGS[int(rng.integers(len(RIGS)))]
    names, motion = rig.names, rig.source(seed)
    parts = {name: part for part, name in names.items()}
    scales = {part.replace("right_", "left_"): rng.uniform(0.87, 1.13) for part in names}
    factors = np.array([scales[parts[name].replace("right_", "left_")] for name in motion.skeleton.joint_names])
    factors *= 1.0 + rng.normal(0.0, 0.005, len(factors))  # no two arms are of one length
    motion = replace(motion, rest_offsets=motion.rest_offsets * factors[:, None])

    def bones(*metres: tuple[float, float, float]) -> list[np.ndarray]:
        return [rig.matrix @ np.array(bone) / rig.metres_per_unit for bone in metres]

    for side, out in (("left", 1.0), ("right", -1.0)):
        for across in (-0.03, 0.0, 0.03):
            finger = bones((out * 0.09, 0.0, across), (out * 0.03, 0.0, 0.0), (out * 0.02, 0.0, 0.0))
            motion = with_chain(motion, names[f"{side}_wrist"], finger)
        motion = with_chain(motion, names[f"{side}_elbow"], bones((out * 0.12, 0.0, 0.0)))
        motion = with_chain(motion, names[f"{side}_hip"], bones((0.0, -0.2, 0.0)))
    motion = with_chain(motion, names["right_wrist"], bones((-0.1, 0.0, 0.0), (0.0, 0.5, 0.4)))
    motion = with_chain(motion, names.get("head", names.get("neck", "")), bones((0, 0.1, -0.1), (0, -0.15, 0)))
    odd, old_names = renamed(motion, seed)
    drafted = {part.part: old_names[part.joint] for part in draft_motion(odd).parts if part.joint}
    assert {part: drafted.get(part) for part in NEEDED} == {part: names[part] for part in NEEDED}


@pytest.mark.parametrize("rig", [rig for rig in RIGS if rig.pose != "random"], ids=lambda rig: rig.name)
def test_the_rest_pose_is_enough_but_for_the_sides_of_straight_legs_without_toes(rig: Rig) -> None:
    motion = rig.source()
    odd, old_names = renamed(motion, 1)
    draft = draft_mapping(odd.skeleton, odd.rest_offsets)
    wrong = differences(draft, motion, old_names)
    if "left_toe" in rig.names:
        assert wrong == {}
    assert all(part.startswith(("left", "right")) for part in wrong)


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_names_of_known_layouts_make_a_draft_sure(rig: Rig) -> None:
    draft = draft_motion(rig.source())
    assert [part.part for part in draft.parts if not part.is_sure and rig.name != "openni"] == []
    assert {part.part for part in draft.parts} >= set(NEEDED)


def test_a_draft_written_into_a_study_is_the_same_layout_and_says_what_is_a_guess() -> None:
    motion = read_bvh(SMALL_BVH.replace("LeftLeg", "Bend.A").replace("RightLeg", 'Bend "B"'))
    guess = guess_motion(motion)
    assert guess.layout is None
    unsure = {part.part for part in guess.draft.parts if not part.is_sure}
    assert unsure == {"left_knee", "right_knee"}
    text = guess.draft.toml("mine")
    assert 'left_knee = "Bend.A"    # by tree and pose, its side by its name: A GUESS - CHECK IT' in text
    mappings = tomllib.loads(text)["ingest"]["mappings"]
    found = resolve_layout("mine", motion.skeleton, motion.rest_offsets, mappings)
    drafted = guess.draft.layout("mine")
    assert (found.tables, found.points, found.derived) == (drafted.tables, drafted.points, drafted.derived)
    # What it is tells unit, axis and handedness as for a known layout.
    plain = guess_motion(read_bvh(SMALL_BVH))
    assert (guess.unit.metres_per_unit, guess.up) == (plain.unit.metres_per_unit, plain.up)
    assert guess.unit.height_m == pytest.approx(plain.unit.height_m, abs=0.05)
    assert guess.mirror == plain.mirror


def test_knees_and_toes_tell_sides_that_names_do_not() -> None:
    motion = next(rig for rig in RIGS if rig.name == "xsens").source()
    names = [name.replace("Left", "A_").replace("Right", "B_") for name in motion.skeleton.joint_names]
    draft = draft_motion(replace(motion, skeleton=replace(motion.skeleton, joint_names=tuple(names))))
    knee = next(part for part in draft.parts if part.part == "left_knee")
    assert (knee.joint, knee.reason, knee.is_sure) == ("A_Knee", "by its name, its side by knees and toes", True)


def test_what_is_no_body_is_missing_and_not_made_up() -> None:
    names = ("hips", "a", "b", "c")
    draft = draft_mapping(Skeleton("bvh", names, (-1, 0, 1, 0)), np.ones((4, 3)))
    assert set(NEEDED) | {"skull"} == set(draft.missing)
    assert "# left_knee =    # no joint was found: SET IT, it is needed" in draft.toml("mine")
    with pytest.raises(InputError, match=r"no joint was found for skull, left_shoulder.*ingest.mappings.mine.parts"):
        draft.layout("mine")


@given(st.integers(0, 10**6), st.integers(1, 120), st.booleans())
def test_any_tree_is_drafted_or_missing(seed: int, num_joints: int, is_chain: bool) -> None:
    rng = np.random.default_rng(seed)
    parents = (-1, *(at - 1 if is_chain else int(rng.integers(at)) for at in range(1, num_joints)))
    skeleton = Skeleton("bvh", tuple(f"q{at}" for at in range(num_joints)), parents)
    offsets = rng.integers(-1, 2, (num_joints, 3)) * rng.choice([0.0, 1.0])
    draft = draft_mapping(skeleton, offsets)
    assert not draft.is_whole or draft.layout("mine").tables


@pytest.mark.parametrize("prefixes", [("A:", "B:"), ("P1_", "P2_"), None])
@pytest.mark.parametrize("rig", RIGS[::6], ids=lambda rig: rig.name)
def test_two_people_in_one_tree_are_not_mixed(rig: Rig, prefixes: tuple[str, str] | None) -> None:
    motion = rig.source()
    skeleton, count = motion.skeleton, motion.skeleton.num_joints
    named = [f"{prefix}{name}" for prefix in prefixes or () for name in skeleton.joint_names]
    names = ("world", *(named or (f"q{at}z" for at in np.random.default_rng(0).permutation(2 * count))))
    parents = (-1, *(at + first if at >= 0 else 0 for first in (1, 1 + count) for at in skeleton.parents))
    offsets = np.concatenate([np.zeros((1, 3)), motion.rest_offsets, motion.rest_offsets])
    offsets[1 + count] = np.array([0.0, 1.0, 1.0]) / rig.metres_per_unit
    still = np.tile([0.0, 0.0, 0.0, 1.0], (motion.num_frames, 1, 1))
    local = np.concatenate([still, motion.local_unitquat, motion.local_unitquat], axis=1)
    both = SourceMotion(Skeleton("bvh", names, parents), offsets, motion.root_translation, local)
    assert find_layout(both.skeleton, both.rest_offsets) is None
    draft = draft_motion(both)
    assert draft.are_several
    with pytest.raises(InputError, match="several people"):
        draft.layout("mine")
    if prefixes == ("A:", "B:"):
        with pytest.raises(InputError, match="its joints are those of several people; give each person a file"):
            resolve_layout("auto", both.skeleton, both.rest_offsets)


def test_the_end_of_a_hand_is_no_wrist_whatever_the_other_joints_are_called() -> None:
    names = {"Shoulder": "Schluessel", "ForeArm": "Unterarm", "Arm": "Oberarm", "UpLeg": "Oberschenkel"}
    names |= {"Leg": "Unterschenkel", "Foot": "Fuss", "ToeBase": "Zeh", "Hand": "Hand"}
    text = (
        SMALL_BVH.replace("Hips", "Becken").replace("Neck", "Hals").replace("Head", "Kopf").replace("Spine", "Wirbel")
    )
    for side, theirs in product(("Left", "Right"), names):
        text = text.replace(f"JOINT {side}{theirs} ", f"JOINT {names[theirs]}{side[0]} ")
    for side in ("L", "R"):
        hand = re.search(rf"JOINT Hand{side} \{{[^{{}}]*", text)
        assert hand
        text = text.replace(hand[0], f"{hand[0]} End Site {{ OFFSET {17 if side == 'L' else -17} 0 0 }} ")
    draft = draft_motion(read_bvh(text.encode()))
    joints = {part.part: part.joint for part in draft.parts}
    assert (joints["left_wrist"], joints["right_wrist"]) == ("HandL", "HandR")
