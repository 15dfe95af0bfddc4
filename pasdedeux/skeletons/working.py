"""The three working skeletons that every source is mapped to."""

from __future__ import annotations

from pasdedeux.skeletons.skeleton import Skeleton


def _skeleton(name: str, tree: dict[str, str]) -> Skeleton:
    joint_names = tuple(tree)
    return Skeleton(
        name=name,
        joint_names=joint_names,
        parents=tuple(joint_names.index(parent) if parent else -1 for parent in tree.values()),
    )


PAIR17 = _skeleton(
    "pair17",
    {
        "pelvis": "",
        "spine": "pelvis",
        "chest": "spine",
        "neck": "chest",
        "head": "neck",
        "left_shoulder": "chest",
        "left_elbow": "left_shoulder",
        "left_wrist": "left_elbow",
        "right_shoulder": "chest",
        "right_elbow": "right_shoulder",
        "right_wrist": "right_elbow",
        "left_hip": "pelvis",
        "left_knee": "left_hip",
        "left_ankle": "left_knee",
        "right_hip": "pelvis",
        "right_knee": "right_hip",
        "right_ankle": "right_knee",
    },
)
"""The skeleton of lifting by sampling: 1 root and 16 joints (Yin et al. 2018, section 3)."""

OP14 = _skeleton(
    "op14",
    {
        "head": "neck",
        "neck": "",
        "right_shoulder": "neck",
        "right_elbow": "right_shoulder",
        "right_wrist": "right_elbow",
        "left_shoulder": "neck",
        "left_elbow": "left_shoulder",
        "left_wrist": "left_elbow",
        "right_hip": "neck",
        "right_knee": "right_hip",
        "right_ankle": "right_knee",
        "left_hip": "neck",
        "left_knee": "left_hip",
        "left_ankle": "left_knee",
    },
)
"""The skeleton of the projection database, in the order of OpenPose COCO-18's first 14 keypoints."""

BODY22 = _skeleton(
    "body22",
    {
        "pelvis": "",
        "spine1": "pelvis",
        "spine2": "spine1",
        "spine3": "spine2",
        "neck": "spine3",
        "head": "neck",
        "left_hip": "pelvis",
        "left_knee": "left_hip",
        "left_ankle": "left_knee",
        "left_toe": "left_ankle",
        "right_hip": "pelvis",
        "right_knee": "right_hip",
        "right_ankle": "right_knee",
        "right_toe": "right_ankle",
        "left_collar": "spine3",
        "left_shoulder": "left_collar",
        "left_elbow": "left_shoulder",
        "left_wrist": "left_elbow",
        "right_collar": "spine3",
        "right_shoulder": "right_collar",
        "right_elbow": "right_shoulder",
        "right_wrist": "right_elbow",
    },
)
"""The skeleton of augmentation and models."""

WORKING_SKELETONS: dict[str, Skeleton] = {skeleton.name: skeleton for skeleton in (PAIR17, OP14, BODY22)}
