"""Euler angles of motion files: successive rotations about axes of the moving frame."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.kinematics.rotation_kernels import multiply, put_unitquat
from pasdedeux.kinematics.rotations import identity_unitquat


def unitquat_from_euler(angles_rad: Array, axes: str) -> Array:
    """Return unit quaternions (*batch, 4) of the product R[axes[0]] R[axes[1]] ... of angles (*batch, len(axes)).

    The first axis is the outermost, as in the CHANNELS of a BVH file; no axes give the identity.  To the last
    bit the result is that of scipy's `Rotation.from_euler`, in an eighth of the time.
    """
    batch = angles_rad.shape[:-1]
    if not axes or 0 in batch:
        return identity_unitquat(*batch)
    rows = np.ascontiguousarray(angles_rad, dtype=np.float64).reshape(-1, len(axes))
    return np.asarray(_compose(rows, np.array(["XYZ".index(axis) for axis in axes])).reshape(*batch, 4))


@compiled()
def _compose(angles_rad: Array, axes: Integers) -> Array:
    """Return unit quaternions (row, 4) of rows of angles about axes (X is 0)."""
    turned = np.empty((len(angles_rad), 4))
    for row in range(len(angles_rad)):
        q = _about(angles_rad[row, 0], axes[0])
        for at in range(1, len(axes)):
            q = multiply(q, _about(angles_rad[row, at], axes[at]))
        put_unitquat(turned, row, q)
    return turned


@inner_kernel()
def _about(angle_rad: float, axis: int) -> tuple[float, float, float, float]:
    sine, cosine = math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad)
    return (sine if axis == 0 else 0.0, sine if axis == 1 else 0.0, sine if axis == 2 else 0.0, cosine)


def turn_joints(angles_rad: Array, channels: Sequence[str], *, is_first_outermost: bool = True) -> Array:
    """Return local rotations (frame, J, 4) of rows of channels, joint after joint.

    Args:
        angles_rad: Values (frame, sum of channels), angles in radians; other channels are ignored.
        channels: For each joint a letter per column: X, Y, Z for angles about these axes, others for other channels.
        is_first_outermost: Whether the first angle of a joint is about an axis of its parent, as in BVH; else the last
            is, as in AMC.
    """
    step = 1 if is_first_outermost else -1
    turned = identity_unitquat(len(angles_rad), len(channels))
    column, alike = 0, defaultdict[str, list[tuple[int, list[int]]]](list)
    for joint, letters in enumerate(channels):
        turns = [at for at, letter in enumerate(letters) if letter in "XYZ"][::step]
        alike["".join(letters[at] for at in turns)].append((joint, [column + at for at in turns]))
        column += len(letters)
    for axes, joints in alike.items():  # joints with the same axes together
        columns = [channels_of for _, channels_of in joints]
        turned[:, [joint for joint, _ in joints]] = unitquat_from_euler(angles_rad[:, columns], axes)
    return turned


def euler_from_unitquat(unitquat: Array, axes: str) -> Array:
    """Return angles (*batch, 3) in radians whose product R[axes[0]] R[axes[1]] R[axes[2]] is the rotation (*batch, 4).

    The middle angle is within a quarter turn.  If it is a quarter turn, the outer two axes coincide and the last angle
    is 0.  `axes` is a permutation of XYZ.
    """
    from scipy.spatial.transform import Rotation

    rotation: Any = Rotation.from_quat(unitquat.reshape(-1, 4))  # its stubs allow spelled-out axes only
    return np.asarray(rotation.as_euler(axes, suppress_warnings=True).reshape(*unitquat.shape[:-1], 3))
