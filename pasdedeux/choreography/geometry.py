"""Vectors and rotations by a person's facing, and the two-bone solution of arms and legs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.curves import saturate
from pasdedeux.kinematics.rotations import multiply, normalise, unitquat_from_rotvec

Part = Array | float

SIDES = {"left": 1.0, "right": -1.0}
"""The sides, and the sign of each along the left."""
OTHER_SIDE = {"left": "right", "right": "left"}

STRETCH = 0.988
"""Share of the straight limb up to which a target is met exactly; the limb itself never gets straighter than 0.998."""
_SLACK = 0.010
_FOLD = 0.30
"""Smallest share of the straight limb between its ends (elbow or knee bent by some 145 degrees)."""


def columns(*parts: Part) -> Array:
    """Return parts (*batch), arrays or constants, side by side (*batch, part)."""
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def facing(yaw_rad: Part, left_m: Part, up_m: Part, forward_m: Part) -> Array:
    """Return the world vector (*batch, 3) of left, up and forward parts of a person who faces `yaw_rad`."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return columns(left_m * c + forward_m * s, up_m, -left_m * s + forward_m * c)


def on_floor(yaw_rad: Part, left_m: Part, forward_m: Part) -> Array:
    """Return X and Z of `facing` (*batch, 2)."""
    return facing(yaw_rad, left_m, 0.0, forward_m)[..., [0, 2]]


def on_circle(radius_m: Part, angle_rad: Array) -> Array:
    """Return X and Z (*batch, 2) of a point on a circle, counter-clockwise seen from above, from +X."""
    return columns(radius_m * np.cos(angle_rad), -radius_m * np.sin(angle_rad))


def turn(yaw_rad: Part, pitch_rad: Part = 0.0, roll_rad: Part = 0.0) -> Array:
    """Return the rotation (frame, 4): roll to the right, then pitch forward, then yaw to the left."""
    about_y = unitquat_from_rotvec(columns(0.0, yaw_rad, 0.0))
    about_x = unitquat_from_rotvec(columns(pitch_rad, 0.0, 0.0))
    return multiply(about_y, multiply(about_x, unitquat_from_rotvec(columns(0.0, 0.0, roll_rad))))


def square_to(axis: Array, vector: Array) -> Array:
    """Return the unit direction (frame, 3) of the part of a vector that is square to a unit axis (frame, 3)."""
    return normalise(vector - np.sum(vector * axis, axis=-1, keepdims=True) * axis)


@dataclass(frozen=True)
class TwoBone:
    """A solved limb: middle joint and end (frame, 3), unit directions of both bones and of the bend (frame, 3).

    `bend` is square to the upper bone and points to where the lower bone turns.
    """

    middle_m: Array
    end_m: Array
    upper: Array
    lower: Array
    bend: Array


def reach(root_m: Array, target_m: Array, pole: Array, upper_length_m: float, lower_length_m: float) -> TwoBone:
    """Solve a limb from its root (frame, 3) to a target (frame, 3) with the middle joint towards `pole` (frame, 3).

    Bone lengths are exact.  Targets beyond the limb are pulled in smoothly along the line to the root.  `pole` need be
    neither unit nor square to that line, but must not lie along it.
    """
    total = upper_length_m + lower_length_m
    vector = target_m - root_m
    distance = np.linalg.norm(vector, axis=-1)
    along = vector / np.maximum(distance, 1e-9)[..., None]
    near = total - saturate(total - distance, total * (1.0 - _FOLD - _SLACK), total * _SLACK)
    span = saturate(near, total * STRETCH, total * _SLACK)
    out = square_to(along, pole)
    forward = (span**2 + upper_length_m**2 - lower_length_m**2) / (2.0 * span)
    side = np.sqrt(np.maximum(upper_length_m**2 - forward**2, 0.0))
    middle = root_m + along * forward[..., None] + out * side[..., None]
    end = root_m + along * span[..., None]
    upper = (middle - root_m) / upper_length_m
    lower = (end - middle) / lower_length_m
    # The bend comes from the pole, not from the lower bone, so it is defined for a straight limb, too.
    bend = along * (side / upper_length_m)[..., None] - out * (forward / upper_length_m)[..., None]
    return TwoBone(middle_m=middle, end_m=end, upper=upper, lower=lower, bend=bend)
