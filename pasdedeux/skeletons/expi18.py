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
"""As ExPI (Guo et al. 2022): three places of the head, the back, and of each side shoulder, elbow, wrist, hip, knee,
heel and toes; no spine, neck, pelvis or collars.  Ours are the tree, which the data set leaves open, the order, its
root first, and names: a heel is an ankle, as everywhere here."""

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
"""Each joint as a mix of those of `body22`.  The head's sides are along the shoulders and turn with these, its front is
its top, and heels lie behind the ankles: `body22` does not know where faces look."""

MAPPED_SKELETONS: dict[str, JointMap] = {joints.target.name: joints for joints in (EXPI18_OF_BODY22,)}
"""What follows from `body22`, by the name of its skeleton."""

MODEL_SKELETONS: dict[str, Skeleton] = {skeleton.name: skeleton for skeleton in (BODY22, EXPI18)}
"""Skeletons that models can be of; no two have as many joints, so arrays tell which they are of."""
