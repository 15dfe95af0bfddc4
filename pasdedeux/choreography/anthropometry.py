"""Bodies of any height: segment lengths and girths as fractions of body height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22

__all__ = ["CAPSULE_RADII", "HEIGHT_LIMITS_M", "Body", "make_body"]

Array = npt.NDArray[np.float64]

HEIGHT_LIMITS_M = (1.4, 2.1)
"""Body heights that the duets are made for, metres."""

_ANKLE_HEIGHT, _KNEE_HEIGHT, _HIP_HEIGHT, _SHOULDER_HEIGHT = 0.039, 0.285, 0.530, 0.818
_UPPER_ARM, _FOREARM = 0.186, 0.146
"""Drillis and Contini 1966, as printed in Winter 2009, Biomechanics and Motor Control of Human Movement, figure 4.1."""
_TOE_HEIGHT, _FOOT_FORWARD = 0.014, 0.092
"""Ball of the foot: its height over the floor, and how far it lies before the ankle (foot length there: 0.152)."""
_HIP_HALF_WIDTH, _SHOULDER_HALF_WIDTH = 0.054, 0.108
"""Joint centres; the 0.0955 and 0.129 of the same figure are the outer breadths of pelvis and shoulders."""

_FRACTIONS: dict[str, tuple[float, float, float]] = {
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
"""Rest position of the joints (left, up, forward), fractions of body height: upright, arms out, palms down."""

CAPSULE_RADII: dict[str, float] = {
    "spine1": 0.062,
    "spine2": 0.062,
    "spine3": 0.064,
    "neck": 0.058,
    "head": 0.042,
    "hip": 0.058,
    "knee": 0.042,
    "ankle": 0.028,
    "toe": 0.018,
    "collar": 0.036,
    "shoulder": 0.032,
    "elbow": 0.026,
    "wrist": 0.020,
}
"""Girth as the radius of the bone that ends in the joint, fraction of body height (half depths and mean radii)."""


@dataclass(frozen=True)
class Body:
    """A person's size on `body22`.

    Args:
        height_m: Standing height.
        rest_offsets_m: Offset of each joint from its parent at rest (22, 3): facing +Z, arms out along X, palms down.
        radii_m: Radius of the bone that ends in each joint (22,); 0 for the root.
    """

    height_m: float
    rest_offsets_m: Array
    radii_m: Array

    def length_m(self, joint_name: str) -> float:
        """Return the length of the bone that ends in a joint."""
        return float(np.linalg.norm(self.rest_offsets_m[BODY22.index(joint_name)]))

    def radius_m(self, joint_name: str) -> float:
        """Return the radius of the bone that ends in a joint."""
        return float(self.radii_m[BODY22.index(joint_name)])

    def standing_m(self, joint_name: str) -> float:
        """Return a joint's height over the floor when the body stands upright at rest."""
        side, _, part = joint_name.partition("_")
        return self.height_m * _FRACTIONS[f"left_{part}" if side == "right" else joint_name][1]

    def trunk_at(self, height_m: float) -> tuple[str, float]:
        """Return the bone of the upper trunk, and the share of it, that is at a height when the body stands upright."""
        low, chest, neck = (self.standing_m(joint) for joint in ("spine2", "spine3", "neck"))
        if height_m > chest:
            return "neck", (height_m - chest) / (neck - chest)
        return "spine3", (height_m - low) / (chest - low)


def make_body(height_m: float) -> Body:
    """Return a body of a height, with the proportions of Drillis and Contini.

    Raises:
        InputError: The height is outside `HEIGHT_LIMITS_M`.
    """
    low, high = HEIGHT_LIMITS_M
    if not low <= height_m <= high:
        raise InputError(f"a body height of {height_m:g} m is outside what the duets are made for: {low} to {high} m")
    positions = np.array([_position(name) for name in BODY22.joint_names]) * height_m
    offsets = np.zeros_like(positions)
    radii = np.zeros(BODY22.num_joints)
    for parent, child in BODY22.bones:
        offsets[child] = positions[child] - positions[parent]
        radii[child] = CAPSULE_RADII[BODY22.joint_names[child].removeprefix("left_").removeprefix("right_")] * height_m
    return Body(height_m=float(height_m), rest_offsets_m=offsets, radii_m=radii)


def _position(joint_name: str) -> tuple[float, float, float]:
    if joint_name in _FRACTIONS:
        return _FRACTIONS[joint_name]
    x, y, z = _FRACTIONS[joint_name.replace("right_", "left_")]
    return (-x, y, z)
