"""The kernel of forward kinematics."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import cross, multiply, put_row, put_unitquat, row_of, scale, unitquat_of


@compiled()
def carry_out(
    bones: Integers, root: int, offsets_m: Array, roots_m: Array, local_unitquat: Array
) -> tuple[Array, Array]:
    """Return world positions (row, J, 3), metres, and rotations (row, J, 4).

    Sums have the order of `rotations.rotate`, so that the bits are those of numpy.

    Args:
        bones: Parent and child of each bone, from the root outwards, (bone, 2).
        root: The joint without a parent.
        offsets_m: Offset of each joint in its parent's frame, of each row (row, J, 3) or of all (1, J, 3), metres.
        roots_m: Position of the root, (row, 3), metres.
        local_unitquat: Rotation of each joint against its parent, (row, J, 4).
    """
    positions, world = np.empty((*local_unitquat.shape[:2], 3)), np.empty(local_unitquat.shape)
    for row in range(len(local_unitquat)):
        offsets = offsets_m[row if len(offsets_m) > 1 else 0]
        put_row(positions[row], root, row_of(roots_m, row))
        put_unitquat(world[row], root, unitquat_of(local_unitquat[row], root))
        for parent, child in bones:
            turn, offset = unitquat_of(world[row], parent), row_of(offsets, child)
            put_unitquat(world[row], child, multiply(turn, unitquat_of(local_unitquat[row], child)))
            twice = scale(2.0, cross(turn, offset))
            across = cross(turn, twice)
            for axis in range(3):
                carried = offset[axis] + turn[3] * twice[axis] + across[axis]
                positions[row, child, axis] = positions[row, parent, axis] + carried
    return positions, world
