"""Two-bone reach: where knee or elbow goes so that ankle or wrist meets its target, with exact bone lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.curves import saturate
from pasdedeux.kinematics.rotations import normalise

STRETCH = 0.988
"""Share of the straight limb up to which a target is met exactly; the limb itself never gets straighter than 0.998."""
_SLACK = 0.010
_FOLD = 0.30
"""Least share of the straight limb between its ends (elbow or knee bent by some 145 degrees)."""


@dataclass(frozen=True)
class TwoBone:
    """A solved limb: middle joint and end (frame, 3), unit directions of both bones and of the bend (frame, 3).

    `bend` is square to the upper bone and points to where the lower bone turns; `hinge` = upper x bend is the axis.
    """

    middle_m: Array
    end_m: Array
    upper: Array
    lower: Array
    bend: Array


def square_to(vector: Array, axis: Array) -> Array:
    """Return the unit part of vectors (frame, 3) that is square to unit axes (frame, 3)."""
    return normalise(vector - np.sum(vector * axis, axis=-1, keepdims=True) * axis)


def reach(root_m: Array, target_m: Array, pole: Array, upper_length_m: float, lower_length_m: float) -> TwoBone:
    """Solve a limb from its root (frame, 3) to a target (frame, 3) with the middle joint towards `pole` (frame, 3).

    Targets beyond the limb are pulled in smoothly along the line to the root.  `pole` need be neither unit nor square
    to that line, but must not lie along it.
    """
    total = upper_length_m + lower_length_m
    vector = target_m - root_m
    distance = np.linalg.norm(vector, axis=-1)
    along = vector / np.maximum(distance, 1e-9)[..., None]
    near = total - saturate(total - distance, total * (1.0 - _FOLD - _SLACK), total * _SLACK)
    span = saturate(near, total * STRETCH, total * _SLACK)
    out = square_to(pole, along)
    forward = (span**2 + upper_length_m**2 - lower_length_m**2) / (2.0 * span)
    side = np.sqrt(np.maximum(upper_length_m**2 - forward**2, 0.0))
    middle = root_m + along * forward[..., None] + out * side[..., None]
    end = root_m + along * span[..., None]
    upper = (middle - root_m) / upper_length_m
    lower = (end - middle) / lower_length_m
    # The bend is taken from the pole, not from the lower bone: it stays defined when the limb is straight.
    bend = along * (side / upper_length_m)[..., None] - out * (forward / upper_length_m)[..., None]
    return TwoBone(middle_m=middle, end_m=end, upper=upper, lower=lower, bend=bend)
