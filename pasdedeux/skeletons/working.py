"""The three working skeletons, to which all sources are mapped."""

from __future__ import annotations

from pasdedeux.skeletons.skeleton import ARM, LEG, Skeleton


def _chain(*joints: str) -> dict[str, str]:
    """Return each joint of a chain but the first, with its parent."""
    return dict(zip(joints[1:], joints[:-1], strict=True))


def limb(start: str, side: str, *joints: str) -> dict[str, str]:
    """Return the joints of a limb on one side, each with its parent; that of the first is `start`."""
    return _chain(start, *(f"{side}_{joint}" for joint in joints))


PAIR17 = Skeleton.of_tree(
    "pair17",
    {
        "pelvis": "",
        **_chain("pelvis", "spine", "chest", "neck", "head"),
        **limb("chest", "left", *ARM),
        **limb("chest", "right", *ARM),
        **limb("pelvis", "left", *LEG),
        **limb("pelvis", "right", *LEG),
    },
)
"""The skeleton of lifting by sampling: 1 root and 16 joints (Yin et al. 2018, section 3)."""

COUNTED17 = [at for at, name in enumerate(PAIR17.joint_names) if name not in ("pelvis", "spine", "chest")]
"""Joints of pair17 that count as seen; the others are means of these in detections."""

OP14 = Skeleton.of_tree(
    "op14",
    {
        "head": "neck",
        "neck": "",
        **limb("neck", "right", *ARM),
        **limb("neck", "left", *ARM),
        **limb("neck", "right", *LEG),
        **limb("neck", "left", *LEG),
    },
)
"""The skeleton of the projection database, in the order of OpenPose COCO-18's first 14 keypoints."""

BODY22 = Skeleton.of_tree(
    "body22",
    {
        "pelvis": "",
        **_chain("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
        **limb("pelvis", "left", *LEG, "toe"),
        **limb("pelvis", "right", *LEG, "toe"),
        **limb("spine3", "left", "collar", *ARM),
        **limb("spine3", "right", "collar", *ARM),
    },
)
"""The skeleton of augmentation and models."""

WORKING_SKELETONS: dict[str, Skeleton] = {skeleton.name: skeleton for skeleton in (PAIR17, OP14, BODY22)}
