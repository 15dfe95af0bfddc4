"""Euler angles as motion files write them: rotations about the listed axes of the moving frame, one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.arrays import Array


def identity_unitquat(*batch: int) -> Array:
    """Return identity rotations (*batch, 4)."""
    result = np.zeros((*batch, 4))
    result[..., 3] = 1.0
    return result


def unitquat_from_euler(angles_rad: Array, axes: str) -> Array:
    """Return unit quaternions (*batch, 4) of the product R[axes[0]] R[axes[1]] ... of angles (*batch, len(axes)).

    The first axis listed is the outermost, as in the CHANNELS of a BVH file; no axes give the identity.
    """
    batch = angles_rad.shape[:-1]
    if not axes or 0 in batch:
        return identity_unitquat(*batch)
    from scipy.spatial.transform import Rotation  # here: planning need not wait for it

    return np.asarray(Rotation.from_euler(axes, angles_rad.reshape(-1, len(axes))).as_quat().reshape(*batch, 4))


def euler_from_unitquat(unitquat: Array, axes: str) -> Array:
    """Return angles (*batch, 3) in radians whose product R[axes[0]] R[axes[1]] R[axes[2]] is the rotation (*batch, 4).

    The middle angle lies within a quarter turn.  Where it is a quarter turn the outer two share one axis: the last one
    is then 0.  `axes` is a permutation of XYZ.
    """
    from scipy.spatial.transform import Rotation

    rotation: Any = Rotation.from_quat(unitquat.reshape(-1, 4))  # its stubs allow spelled-out axes only
    return np.asarray(rotation.as_euler(axes, suppress_warnings=True).reshape(*unitquat.shape[:-1], 3))
