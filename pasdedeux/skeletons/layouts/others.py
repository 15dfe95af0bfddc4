"""Layouts of other sources: the projection database, body22 itself, and two common naming schemes of characters."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.layout import AddedPoint, Layout, Table
from pasdedeux.skeletons.layouts.table_building import Limbs, working_tables
from pasdedeux.skeletons.working import BODY22

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
        limbs={
            "shoulder": ("LeftArm", "RightArm"),
            "elbow": ("LeftForeArm", "RightForeArm"),
            "wrist": ("LeftHand", "RightHand"),
            "hip": ("LeftUpLeg", "RightUpLeg"),
            "knee": ("LeftLeg", "RightLeg"),
            "ankle": ("LeftFoot", "RightFoot"),
            "toe": ("left_toe", "right_toe"),
        },
        trunk={
            "pelvis": "Root",
            "spine1": {"Root": 0.5, "Spine": 0.5},
            "spine2": "Spine",
            "spine3": "Spine1",
            "neck": "Neck",
            "left_collar": {"Spine1": 0.75, "LeftArm": 0.25},
            "right_collar": {"Spine1": 0.75, "RightArm": 0.25},
        },
        spine={"spine": {"Root": 0.65, "Spine": 0.35}, "chest": {"Spine": 0.95, "Spine1": 0.05}},
        neck_base="Neck",
        head={"head": "Head"},
        nose="nose",
    ),
)


def _own(joint: str) -> tuple[str, str]:
    return (f"left_{joint}", f"right_{joint}")


BODY22_LAYOUT = Layout(
    name="body22",
    meaning="The working skeleton body22 itself: built-in duets and exports of this project",
    signature=frozenset(BODY22.joint_names),
    points=(AddedPoint(name="nose", joint="head", offset=(0.0, -0.1, 0.6), unit_bone="head"),),
    tables=working_tables(
        limbs={joint: _own(joint) for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe")},
        trunk={name: name for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar")},
        spine={"spine": "spine1", "chest": "spine3"},
        neck_base="neck",
        head={"head": "head"},
        nose="nose",
    ),
)

_CHARACTER_LIMBS: Limbs = {
    "shoulder": ("LeftArm", "RightArm"),
    "elbow": ("LeftForeArm", "RightForeArm"),
    "wrist": ("LeftHand", "RightHand"),
    "hip": ("LeftUpLeg", "RightUpLeg"),
    "knee": ("LeftLeg", "RightLeg"),
    "ankle": ("LeftFoot", "RightFoot"),
}
_CHARACTER_TRUNK: Table = {
    "pelvis": "Hips",
    "spine1": "Spine",
    "spine2": "Spine1",
    "spine3": "Spine2",
    "neck": "Neck",
    "left_collar": "LeftShoulder",
    "right_collar": "RightShoulder",
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
        limbs={**_CHARACTER_LIMBS, "toe": ("LeftToeBase", "RightToeBase")},
        trunk=_CHARACTER_TRUNK,
        spine=_CHARACTER_SPINE,
        neck_base="Neck",
        head={"head": {"Neck": -0.6, "Head": 1.6}},
        nose="nose",
    ),
)

LAFAN = Layout(
    name="lafan",
    meaning="Names of the LAFAN1 data set: LeftToe, Spine2; its joint frames do not tell where the face is",
    signature=_CHARACTER_SIGNATURE | {"LeftToe"},
    tables=working_tables(
        limbs={**_CHARACTER_LIMBS, "toe": ("LeftToe", "RightToe")},
        trunk=_CHARACTER_TRUNK,
        spine=_CHARACTER_SPINE,
        neck_base="Neck",
        head={"head": {"Neck": -0.6, "Head": 1.6}},
        nose="Head",
    ),
)
