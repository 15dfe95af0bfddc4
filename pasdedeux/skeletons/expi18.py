"""`expi18`: 18 joints a person as the ExPI data set has them, and how they follow from `body22`."""

from __future__ import annotations

from pasdedeux.skeletons.mapping import JointMap
from pasdedeux.skeletons.skeleton import ARM, LEG, Skeleton, by_joint
from pasdedeux.skeletons.working import BODY22, limb

_ENDS = by_joint("left", *ARM, *LEG, "toe")
_PARENTS = {
    child: parent
    for side in ("left", "right")
    for joints in (ARM, (*LEG, "toe"))
    for child, parent in limb("back", side, *joints).items()
}

EXPI18 = Skeleton.of_tree(
    "expi18",
    {"back": "", "head": "back", "left_head": "head", "right_head": "head"} | {name: _PARENTS[name] for name in _ENDS},
)
"""Joints of ExPI (Guo et al. 2022): three points of the head, the back, and on each side shoulder, elbow, wrist, hip,
knee, heel and toes; no spine, neck, pelvis or collars.  The tree, which the data set does not define, the order and the
names are ours: a heel is called ankle, as everywhere here."""

EXPI18_OF_BODY22 = JointMap(
    "expi18 of body22",
    EXPI18,
    {
        "back": "spine3",
        "head": {"neck": -0.6, "head": 1.6},
        "left_head": {"head": 1.0, "left_shoulder": 0.2, "right_shoulder": -0.2},
        "right_head": {"head": 1.0, "left_shoulder": -0.2, "right_shoulder": 0.2},
        **{name: name for name in _ENDS},
        **{f"{side}_ankle": {f"{side}_ankle": 1.25, f"{side}_toe": -0.25} for side in ("left", "right")},
    },
)
"""Each joint as a weighted mean of joints of `body22`, which has no face: the sides of the head are along the
shoulders, its front is its top, and heels are behind the ankles."""

MAPPED_SKELETONS: dict[str, JointMap] = {joints.target.name: joints for joints in (EXPI18_OF_BODY22,)}
"""Mappings from `body22` by the name of their target skeleton."""

MODEL_SKELETONS: dict[str, Skeleton] = {skeleton.name: skeleton for skeleton in (BODY22, EXPI18)}
"""Skeletons of models; their numbers of joints differ, so the shape of an array identifies the skeleton."""
