"""Euler angles as motion files write them: rotations about the listed axes of the moving frame, one after the other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.kinematics.rotations import identity_unitquat


def unitquat_from_euler(angles_rad: Array, axes: str) -> Array:
    """Return unit quaternions (*batch, 4) of the product R[axes[0]] R[axes[1]] ... of angles (*batch, len(axes)).

    The first axis listed is the outermost, as in the CHANNELS of a BVH file; no axes give the identity.
    """
    batch = angles_rad.shape[:-1]
    if not axes or 0 in batch:
        return identity_unitquat(*batch)
    from scipy.spatial.transform import Rotation  # here: planning need not wait for it

    return np.asarray(Rotation.from_euler(axes, angles_rad.reshape(-1, len(axes))).as_quat().reshape(*batch, 4))


def turn_joints(angles_rad: Array, channels: Sequence[str], *, is_first_outermost: bool = True) -> Array:
    """Return local rotations (frame, J, 4) of rows of channels, joint after joint.

    Args:
        angles_rad: Rows (frame, sum of channels) of radians; what is not an angle is not used.
        channels: For each joint a letter a column: X, Y, Z are angles about these axes, others are none.
        is_first_outermost: Whether the first angle of a joint turns about the axes of its parent, as in BVH; else the
            last does, as in AMC.
    """
    step = 1 if is_first_outermost else -1
    turned = identity_unitquat(len(angles_rad), len(channels))
    column, alike = 0, defaultdict[str, list[tuple[int, list[int]]]](list)
    for joint, letters in enumerate(channels):
        turns = [at for at, letter in enumerate(letters) if letter in "XYZ"][::step]
        alike["".join(letters[at] for at in turns)].append((joint, [column + at for at in turns]))
        column += len(letters)
    for axes, joints in alike.items():  # those that turn about the same axes at once
        columns = [own for _, own in joints]
        turned[:, [joint for joint, _ in joints]] = unitquat_from_euler(angles_rad[:, columns], axes)
    return turned


def euler_from_unitquat(unitquat: Array, axes: str) -> Array:
    """Return angles (*batch, 3) in radians whose product R[axes[0]] R[axes[1]] R[axes[2]] is the rotation (*batch, 4).

    The middle angle lies within a quarter turn.  Where it is a quarter turn the outer two share one axis: the last one
    is then 0.  `axes` is a permutation of XYZ.
    """
    from scipy.spatial.transform import Rotation

    rotation: Any = Rotation.from_quat(unitquat.reshape(-1, 4))  # its stubs allow spelled-out axes only
    return np.asarray(rotation.as_euler(axes, suppress_warnings=True).reshape(*unitquat.shape[:-1], 3))
