"""Joint names of the working skeletons, for the joint axes of stored columns.

The science defines the skeletons. Storage does not import the science, so the names are repeated here, and a test
compares both.
"""

from __future__ import annotations

_LEFT_ARM, _LEFT_LEG = ("left_shoulder", "left_elbow", "left_wrist"), ("left_hip", "left_knee", "left_ankle")
_RIGHT_ARM, _RIGHT_LEG = ("right_shoulder", "right_elbow", "right_wrist"), ("right_hip", "right_knee", "right_ankle")

JOINT_NAMES: dict[str, tuple[str, ...]] = {
    "pair17": ("pelvis", "spine", "chest", "neck", "head", *_LEFT_ARM, *_RIGHT_ARM, *_LEFT_LEG, *_RIGHT_LEG),
    "op14": ("head", "neck", *_RIGHT_ARM, *_LEFT_ARM, *_RIGHT_LEG, *_LEFT_LEG),
    "body22": (
        *("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
        *(*_LEFT_LEG, "left_toe", *_RIGHT_LEG, "right_toe"),
        *("left_collar", *_LEFT_ARM, "right_collar", *_RIGHT_ARM),
    ),
}
