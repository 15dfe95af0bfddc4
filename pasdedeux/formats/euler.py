"""Euler angles as motion files write them: rotations about the listed axes of the moving frame, one after the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import multiply, rotmat_from_unitquat

__all__ = ["euler_from_unitquat", "unitquat_from_euler"]

Array = npt.NDArray[np.float64]


def unitquat_from_euler(angles_rad: Array, axes: str) -> Array:
    """Return unit quaternions (*batch, 4) of the product R[axes[0]] R[axes[1]] ... of angles (*batch, len(axes)).

    The first axis listed is the outermost, as in the CHANNELS of a BVH file; no axes give the identity.
    """
    result = np.zeros((*angles_rad.shape[:-1], 4))
    result[..., 3] = 1.0
    for column, axis in enumerate(axes):
        turn = np.zeros(result.shape)
        half = angles_rad[..., column] / 2.0
        turn[..., "XYZ".index(axis)] = np.sin(half)
        turn[..., 3] = np.cos(half)
        result = turn if column == 0 else multiply(result, turn)
    return result


def euler_from_unitquat(unitquat: Array, axes: str) -> Array:
    """Return angles (*batch, 3) in radians whose product R[axes[0]] R[axes[1]] R[axes[2]] is the rotation (*batch, 4).

    The middle angle lies within a quarter turn.  Where it is a quarter turn the outer two share one axis: the last one
    is then 0.  `axes` is a permutation of XYZ.
    """
    i, j, k = ("XYZ".index(axis) for axis in axes)
    parity = 1.0 if (i, j, k) in {(0, 1, 2), (1, 2, 0), (2, 0, 1)} else -1.0
    m = rotmat_from_unitquat(unitquat)
    sine = np.clip(parity * m[..., i, k], -1.0, 1.0)
    is_locked = np.hypot(m[..., i, i], m[..., i, j]) < 1e-9
    first = np.where(
        is_locked,
        np.arctan2(parity * m[..., k, j], m[..., j, j]),
        np.arctan2(-parity * m[..., j, k], m[..., k, k]),
    )
    middle = np.arctan2(sine, np.hypot(m[..., i, i], m[..., i, j]))
    last = np.where(is_locked, 0.0, np.arctan2(-parity * m[..., i, j], m[..., i, i]))
    return np.stack([first, middle, last], axis=-1)
