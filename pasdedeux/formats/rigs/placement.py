"""Position of the people of a take in the world: shifts, turns, and the floor at y = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import multiply, rotate, unitquat_from_rotvec
from pasdedeux.skeletons import BODY22

FOOT_PERCENTILE = 5.0
"""Percentile of the lowest foot height at which feet stand on the floor; lower frames may be noise."""
STANDING_HEIGHTS_M = (-0.02, 0.06)
"""Allowed height of the lowest foot joint: toe joints are 2-5 cm above the sole."""

_FEET = BODY22.indices(["left_toe", "right_toe", "left_ankle", "right_ankle"])


def place_motion(motion: Motion, *, translation_m: Sequence[float], yaw_rad: float) -> Motion:
    """Turn a motion about the world's Y axis by `yaw_rad` and then shift it by `translation_m` (3,)."""
    turn = unitquat_from_rotvec(np.array([0.0, yaw_rad, 0.0]))
    root = motion.skeleton.root
    local = motion.local_unitquat.copy()
    local[:, root] = multiply(np.broadcast_to(turn, local[:, root].shape), local[:, root])
    root_m = place_points(motion.root_translation_m, translation_m=translation_m, yaw_rad=yaw_rad)
    return replace(motion, root_translation_m=root_m, local_unitquat=local)


def place_points(points_m: Array, *, translation_m: Sequence[float], yaw_rad: float) -> Array:
    """Turn points (*batch, 3) about the world's Y axis by `yaw_rad` and then shift them by `translation_m` (3,)."""
    turn = unitquat_from_rotvec(np.array([0.0, yaw_rad, 0.0]))
    turned = rotate(np.broadcast_to(turn, (*points_m.shape[:-1], 4)), points_m)
    return np.asarray(turned + np.asarray(translation_m, dtype=np.float64))


def floor_shift(body22_m: Array) -> float:
    """Return the height to add to a take so that its floor is at y = 0.

    Feet stand at the 5th percentile, over the frames, of the lowest foot joint of all people.  If that is already
    within -2 to 6 cm, the result is 0.

    Args:
        body22_m: Positions of all people of the take together, (frame, person, 22, 3).
    """
    lowest = body22_m[..., _FEET, 1].min(axis=(-1, -2))
    standing = float(np.percentile(lowest, FOOT_PERCENTILE))
    low, high = STANDING_HEIGHTS_M
    return 0.0 if low <= standing <= high else -standing
