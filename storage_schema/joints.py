"""Joint names of the working skeletons, as the joint axes of stored columns carry them.

The science defines the skeletons; storage does not import the science, so the names stand here a second time and a test
holds the two equal.
"""

from __future__ import annotations

__all__ = ["JOINT_NAMES"]

JOINT_NAMES: dict[str, tuple[str, ...]] = {
    "pair17": (
        "pelvis",
        "spine",
        "chest",
        "neck",
        "head",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_hip",
        "left_knee",
        "left_ankle",
        "right_hip",
        "right_knee",
        "right_ankle",
    ),
    "op14": (
        "head",
        "neck",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
    ),
    "body22": (
        "pelvis",
        "spine1",
        "spine2",
        "spine3",
        "neck",
        "head",
        "left_hip",
        "left_knee",
        "left_ankle",
        "left_toe",
        "right_hip",
        "right_knee",
        "right_ankle",
        "right_toe",
        "left_collar",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_collar",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    ),
}
