"""Sources of a database: takes and draws as op14 poses at the database's rate."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.kinematics.motion import frames_at_rate
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import OP14, Skeleton

_NOSE_FORWARD, _NOSE_UP = 0.6, -0.1
"""Place of the nose from the head (ear height), in lengths from neck to head, as in the layout of body22."""


def op14_from_working(positions: Array, skeleton: Skeleton) -> Array:
    """Return op14 positions (*batch, 14, 3) of pair17 or body22 positions (*batch, J, 3), metres.

    The neck of op14 is the middle of the shoulders and its head is the nose, as detectors give them.  Neither skeleton
    has a nose, so it is placed in front of the head, in the direction that the shoulders face.
    """

    def of(name: str) -> Array:
        return positions[..., skeleton.index(name), :]

    middle = 0.5 * (of("left_shoulder") + of("right_shoulder"))
    neck_to_head = of("head") - of("neck")
    up = normalise(neck_to_head, fallback=np.array([0.0, 1.0, 0.0]))
    forward = normalise(np.cross(of("left_shoulder") - of("right_shoulder"), up))
    length = np.linalg.norm(neck_to_head, axis=-1, keepdims=True)
    nose = of("head") + length * (_NOSE_FORWARD * forward + _NOSE_UP * up)
    made_joints = {"neck": middle, "head": nose}
    return np.stack([made_joints[name] if name in made_joints else of(name) for name in OP14.joint_names], axis=-2)


def resample_positions(positions: Array, *, from_hz: float, to_hz: float, start_s: float = 0.0) -> Array:
    """Return positions (frame, *batch, 3) at another rate from a time on, interpolated linearly between frames.

    Bones shrink a little between frames that turn; retargeting proportions afterwards corrects that.
    """
    if (from_hz == to_hz and not start_s) or len(positions) < 2:
        return np.array(positions, dtype=np.float64)
    before, after, share = frames_at_rate(len(positions), from_hz=from_hz, to_hz=to_hz, start_s=start_s)
    share = share.reshape(-1, *([1] * (positions.ndim - 1)))
    return np.asarray(positions[before] + share * (positions[after] - positions[before]), dtype=np.float64)
