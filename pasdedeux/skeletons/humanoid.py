"""The body of characters: `body22` standing in a T-pose, with the joint names of common rigs."""

from __future__ import annotations

from collections.abc import Mapping

from pasdedeux.skeletons.layouts import LAYOUTS
from pasdedeux.skeletons.skeleton import Skeleton
from pasdedeux.skeletons.working import BODY22

Point = tuple[float, float, float]

_ANKLE_HEIGHT, _KNEE_HEIGHT, _HIP_HEIGHT, _SHOULDER_HEIGHT = 0.039, 0.285, 0.530, 0.818
_UPPER_ARM, _FOREARM, _HAND = 0.186, 0.146, 0.108
"""Drillis and Contini 1966, as printed in Winter 2009, Biomechanics and Motor Control of Human Movement, figure 4.1."""
_TOE_HEIGHT, _FOOT_FORWARD, _TOES = 0.014, 0.092, 0.030
"""Ball of the foot: its height over the floor, its distance before the ankle, and the length of the toes (the foot
length in that figure is 0.152)."""
_HIP_HALF_WIDTH, _SHOULDER_HALF_WIDTH = 0.054, 0.108
"""Joint centres; the 0.0955 and 0.129 of the same figure are the outer breadths of pelvis and shoulders."""

T_POSE: Mapping[str, Point] = {
    "pelvis": (0.0, _HIP_HEIGHT + 0.015, 0.0),
    "spine1": (0.0, 0.612, 0.002),
    "spine2": (0.0, 0.676, 0.001),
    "spine3": (0.0, 0.742, -0.004),
    "neck": (0.0, 0.835, -0.008),
    "head": (0.0, 0.905, 0.008),
    "left_hip": (_HIP_HALF_WIDTH, _HIP_HEIGHT, 0.0),
    "left_knee": (_HIP_HALF_WIDTH, _KNEE_HEIGHT, 0.0),
    "left_ankle": (_HIP_HALF_WIDTH, _ANKLE_HEIGHT, 0.0),
    "left_toe": (_HIP_HALF_WIDTH, _TOE_HEIGHT, _FOOT_FORWARD),
    "left_collar": (0.018, 0.808, 0.0),
    "left_shoulder": (_SHOULDER_HALF_WIDTH, _SHOULDER_HEIGHT, -0.004),
    "left_elbow": (_SHOULDER_HALF_WIDTH + _UPPER_ARM, _SHOULDER_HEIGHT, -0.004),
    "left_wrist": (_SHOULDER_HALF_WIDTH + _UPPER_ARM + _FOREARM, _SHOULDER_HEIGHT, -0.004),
}
"""Rest position of the joints (left, up, forward), fractions of body height: upright, facing +Z, arms out along X,
palms down; the right side is the mirror of the left."""


def t_pose(joint_name: str) -> Point:
    """Return the rest position of a joint of `body22` (left, up, forward), fractions of body height."""
    if joint_name in T_POSE:
        return T_POSE[joint_name]
    x, y, z = T_POSE[joint_name.replace("right_", "left_")]
    return (-x, y, z)


_FOOT = (_FOOT_FORWARD**2 + (_ANKLE_HEIGHT - _TOE_HEIGHT) ** 2) ** 0.5
_NECK = (0.070**2 + 0.016**2) ** 0.5
END_SITES: Mapping[str, Point] = {
    "head": (0.0, 0.095 / _NECK, 0.0),
    "left_wrist": (_HAND / _FOREARM, 0.0, 0.0),
    "right_wrist": (-_HAND / _FOREARM, 0.0, 0.0),
    "left_toe": (0.0, 0.0, _TOES / _FOOT),
    "right_toe": (0.0, 0.0, _TOES / _FOOT),
}
"""End of the last bone of a chain (top of the head, tips of hands and toes), by the joint of `body22` where it starts:
left, up and forward at rest, in lengths of the bone that ends in the joint."""


_MIXAMO = LAYOUTS["mixamo"].joint_map(BODY22.name)
HUMANOID_NAMES: Mapping[str, str] = {joint: _MIXAMO.carrier(joint) for joint in BODY22.joint_names}
"""Names of the joints of `body22` in written files; Mixamo's characters have them after `mixamorig:`."""


HUMANOID = Skeleton(
    "humanoid",
    (
        *(HUMANOID_NAMES[joint] for joint in BODY22.joint_names),
        *(f"{HUMANOID_NAMES[joint]}_end" for joint in END_SITES),
    ),
    (*BODY22.parents, *BODY22.indices(END_SITES)),
)
"""The joints of `body22` in order under these names, then the end sites (`<joint>_end`)."""
