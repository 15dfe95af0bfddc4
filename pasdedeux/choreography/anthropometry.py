"""Bodies of any height: segment lengths and girths as fractions of body height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import t_pose

_CLOTH_M = 0.004
"""Thickness of cloth between two touching bodies."""
HEIGHT_LIMITS_M = (1.4, 2.1)
"""Body heights that the duets are made for, metres."""

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
class Physique:
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
        return self.height_m * t_pose(joint_name)[1]

    def rest_distance_m(self, other: Physique, *bones: str) -> float:
        """Return the distance of this body's wrist from the middle of another's bone on which its hand rests.

        Cloth lies between them. If several bones are given, the thickest counts.
        """
        return max(map(other.radius_m, bones)) + self.radius_m("left_wrist") + _CLOTH_M

    def trunk_at(self, height_m: float) -> tuple[str, float]:
        """Return the bone of the upper trunk, and the share of it, that is at a height when the body stands upright."""
        low, chest, neck = (self.standing_m(joint) for joint in ("spine2", "spine3", "neck"))
        if height_m > chest:
            return "neck", (height_m - chest) / (neck - chest)
        return "spine3", (height_m - low) / (chest - low)


def make_body(height_m: float) -> Physique:
    """Return a body of a height, with the proportions of Drillis and Contini."""
    low, high = HEIGHT_LIMITS_M
    if not low <= height_m <= high:
        raise InputError(f"a body height of {height_m:g} m is outside what the duets are made for: {low} to {high} m")
    positions = np.array([t_pose(name) for name in BODY22.joint_names]) * height_m
    offsets = np.zeros_like(positions)
    radii = np.zeros(BODY22.num_joints)
    for parent, child in BODY22.bones:
        offsets[child] = positions[child] - positions[parent]
        radii[child] = CAPSULE_RADII[BODY22.joint_names[child].removeprefix("left_").removeprefix("right_")] * height_m
    return Physique(height_m=float(height_m), rest_offsets_m=offsets, radii_m=radii)
