"""Layouts of other sources: the projection database, body22 itself, and two common naming schemes of characters."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.layout import LIMB_JOINTS, AddedPoint, Layout, Table, working_tables
from pasdedeux.skeletons.working import BODY22

_CHARACTER_LIMBS = ("LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot")

YIANNAKIDES = Layout(
    name="yiannakides",
    meaning="Template of the projection database of Yiannakides et al. 2019: 17 joints, no feet and no collars",
    signature=frozenset(
        {"Root", "Spine", "Spine1", "Neck", "Head", "LeftArm", "LeftForeArm", "LeftUpLeg", "LeftLeg", "LeftFoot"}
    ),
    # In the joint frames of this template the person looks along +Y (right foot: -Y) and up is +X (right foot: -X).
    points=(
        AddedPoint(name="nose", joint="Head", offset=(0.0, 0.6, 0.0), unit_bone="Head"),
        AddedPoint(name="left_toe", joint="LeftFoot", offset=(-0.1, 0.45, 0.0), unit_bone="LeftFoot"),
        AddedPoint(name="right_toe", joint="RightFoot", offset=(0.1, -0.45, 0.0), unit_bone="RightFoot"),
    ),
    tables=working_tables(
        limbs=(*_CHARACTER_LIMBS, "left_toe"),
        trunk={
            "pelvis": "Root",
            "spine1": {"Root": 0.5, "Spine": 0.5},
            "spine2": "Spine",
            "spine3": "Spine1",
            "neck": "Neck",
        },
        collar={"Spine1": 0.75, "LeftArm": 0.25},
        spine={"spine": {"Root": 0.65, "Spine": 0.35}, "chest": {"Spine": 0.95, "Spine1": 0.05}},
        head="Head",
        nose="nose",
    ),
)


BODY22_LAYOUT = Layout(
    name="body22",
    meaning="The working skeleton body22 itself: built-in duets and exports of this project",
    signature=frozenset(BODY22.joint_names),
    points=(AddedPoint(name="nose", joint="head", offset=(0.0, -0.1, 0.6), unit_bone="head"),),
    tables=working_tables(
        limbs=tuple(f"left_{joint}" for joint in LIMB_JOINTS),
        trunk={name: name for name in ("pelvis", "spine1", "spine2", "spine3", "neck")},
        collar="left_collar",
        spine={"spine": "spine1", "chest": "spine3"},
        head="head",
        nose="nose",
    ),
)

_CHARACTER_TRUNK: Table = {
    "pelvis": "Hips",
    "spine1": "Spine",
    "spine2": "Spine1",
    "spine3": "Spine2",
    "neck": "Neck",
}
_CHARACTER_SPINE: Table = {"spine": "Spine", "chest": {"Spine1": 0.5, "Spine2": 0.5}}
_CHARACTER_SIGNATURE = frozenset(
    {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftUpLeg"}
)

MIXAMO = Layout(
    name="mixamo",
    meaning="Names of Mixamo characters, with or without a namespace: LeftToeBase, Spine2",
    signature=_CHARACTER_SIGNATURE | {"LeftToeBase"},
    points=(AddedPoint(name="nose", joint="Head", offset=(0.0, 0.4, 1.0), unit_bone="Head"),),
    tables=working_tables(
        limbs=(*_CHARACTER_LIMBS, "LeftToeBase"),
        trunk=_CHARACTER_TRUNK,
        collar="LeftShoulder",
        spine=_CHARACTER_SPINE,
        head={"Neck": -0.6, "Head": 1.6},
        nose="nose",
    ),
)

LAFAN = Layout(
    name="lafan",
    meaning="Names of the LAFAN1 data set: LeftToe, Spine2; its joint frames do not tell where the face is",
    signature=_CHARACTER_SIGNATURE | {"LeftToe"},
    tables=working_tables(
        limbs=(*_CHARACTER_LIMBS, "LeftToe"),
        trunk=_CHARACTER_TRUNK,
        collar="LeftShoulder",
        spine=_CHARACTER_SPINE,
        head={"Neck": -0.6, "Head": 1.6},
        nose="Head",
    ),
)
