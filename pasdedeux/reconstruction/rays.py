"""Rays from the camera to people: keypoints seen by a camera that is turned to a person, and that turn.

Compiled, because live reconstruction calls it for every frame.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import normalise, put_row, put_unitquat, rotate, row_of, swing_between

_MIN_DEPTH = 0.1
"""Smallest depth of a visible ray over the focal length, in axes of the turned camera."""


@compiled()
def straighten_rays(centred_px: Array, mid_hip_px: Array, focal_px: float) -> tuple[Array, Array]:
    """Return keypoints seen by a camera turned to the mid-hip, and the direction (frame, 3) back to the camera.

    Rays that the turned camera cannot see give NaN.

    Args:
        centred_px: Keypoints (frame, joint, 2) about the principal point, y up; NaN where not seen.
        mid_hip_px: Mid-hip (frame, 2); where it is unknown, the camera is not turned.
        focal_px: Focal length.
    """
    straight, towards = np.full(centred_px.shape, np.nan), np.empty((centred_px.shape[0], 3))
    for at in range(centred_px.shape[0]):
        x, y = -mid_hip_px[at, 0], -mid_hip_px[at, 1]
        if not (np.isfinite(x) and np.isfinite(y)):
            x, y = 0.0, 0.0
        back_to = normalise((x, y, focal_px))
        put_row(towards, at, back_to)
        back = swing_between(back_to, (0.0, 0.0, 1.0))
        for joint in range(centred_px.shape[1]):
            if np.isfinite(centred_px[at, joint, 0]) and np.isfinite(centred_px[at, joint, 1]):
                ray = rotate(back, (centred_px[at, joint, 0], centred_px[at, joint, 1], -focal_px))
                if -ray[2] > _MIN_DEPTH * focal_px:
                    straight[at, joint, 0] = ray[0] / -ray[2] * focal_px
                    straight[at, joint, 1] = ray[1] / -ray[2] * focal_px
    return straight, towards


@compiled()
def camera_turns(directions: Array) -> Array:
    """Return the shortest rotations (n, 4) of the camera's axis, +Z, into directions (n, 3)."""
    turns = np.empty((directions.shape[0], 4))
    for at in range(directions.shape[0]):
        put_unitquat(turns, at, swing_between((0.0, 0.0, 1.0), row_of(directions, at)))
    return turns


@compiled()
def turn_with_camera(towards: Array, point: Array) -> Array:
    """Return a point (3,), given in axes of a camera turned into a direction (3,), in axes of the unturned camera."""
    return np.array(rotate(swing_between((0.0, 0.0, 1.0), towards), point))
