"""Bones' directions and the pose prior of one pose at a time, compiled, for use inside chains; `occupancy` is plain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.plausibility.joint_limits_kernel import bone_of, carry, cross, dot, frame_x, scale
from pasdedeux.plausibility.occupancy import KIND_OF_BONE, NUM_ABOVE, NUM_CELLS, sphere_cells

__all__ = ["cells_of", "point_bones", "weakest_bone"]

Array = npt.NDArray[np.float64]

_CELLS, _ABOVE = sphere_cells(NUM_CELLS), sphere_cells(NUM_ABOVE)
_KIND = KIND_OF_BONE
_TRUNK = (0.0, 1.0, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(cells, direction):  # type: ignore[no-untyped-def]
    best, found = -2.0, 0
    for cell in range(cells.shape[0]):
        near = cells[cell, 0] * direction[0] + cells[cell, 1] * direction[1] + cells[cell, 2] * direction[2]
        if near > best:
            best, found = near, cell
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(bone, x, y, z, direction, above, own, over, frame):  # type: ignore[no-untyped-def]
    for axis in range(3):
        frame[bone, 0, axis], frame[bone, 1, axis], frame[bone, 2, axis] = x[axis], y[axis], z[axis]
        over[bone, axis] = above[axis]
    own[bone, 0], own[bone, 1], own[bone, 2] = dot(x, direction), dot(y, direction), dot(z, direction)


@njit(cache=True, nogil=True, error_model="numpy")
def point_bones(pose: Array, own: Array, above: Array, frame: Array) -> None:
    """Write `occupancy.bone_directions` of one pose (17, 3), float64: (11, 3), (11, 3) and (11, 3, 3)."""
    pelvis_y, chest_y, neck_y = bone_of(pose, 0, 1), bone_of(pose, 1, 2), bone_of(pose, 2, 3)
    pelvis_x = frame_x(pose, 11, 14, pelvis_y)
    chest_x = frame_x(pose, 5, 8, chest_y)
    across = dot(chest_x, neck_y)
    neck_x = (chest_x[0] - across * neck_y[0], chest_x[1] - across * neck_y[1], chest_x[2] - across * neck_y[2])
    length = np.sqrt(dot(neck_x, neck_x))
    neck_x = scale(1.0 / length if length > 1e-12 else 0.0, neck_x)
    pelvis_z, chest_z, neck_z = cross(pelvis_x, pelvis_y), cross(chest_x, chest_y), cross(neck_x, neck_y)
    _enter(0, pelvis_x, pelvis_y, pelvis_z, chest_y, _TRUNK, own, above, frame)
    _enter(1, chest_x, chest_y, chest_z, neck_y, (own[0, 0], own[0, 1], own[0, 2]), own, above, frame)
    head = bone_of(pose, 3, 4)
    _enter(2, neck_x, neck_y, neck_z, head, (own[1, 0], own[1, 1], own[1, 2]), own, above, frame)
    for limb in range(4):
        is_arm = limb < 2
        side = 1.0 if limb % 2 == 0 else -1.0
        first = 5 + 3 * (limb % 2) if is_arm else 11 + 3 * (limb % 2)
        x, y, z = (scale(side, chest_x), chest_y, chest_z) if is_arm else (scale(side, pelvis_x), pelvis_y, pelvis_z)
        rest = x if is_arm else scale(-1.0, y)
        upper, lower = bone_of(pose, first, first + 1), bone_of(pose, first + 1, first + 2)
        bone = 3 + limb % 2 if is_arm else 7 + limb % 2
        _enter(bone, x, y, z, upper, _TRUNK, own, above, frame)
        over = (own[bone, 0], own[bone, 1], own[bone, 2])
        x, y, z = carry(rest, upper, x), carry(rest, upper, y), carry(rest, upper, z)
        _enter(bone + 2, x, y, z, lower, over, own, above, frame)


@njit(cache=True, nogil=True, error_model="numpy")
def cells_of(own: Array, above: Array) -> tuple[int, int]:
    """Return the cell of the bone above and that of the bone, of unit directions (3,) each."""
    return _nearest(_ABOVE, above), _nearest(_CELLS, own)


@njit(cache=True, nogil=True, error_model="numpy")
def weakest_bone(pose: Array, log_share: Array) -> float:
    """Return `Occupancy.log_prior` of one pose (17, 3), float64, metres, from `Occupancy.log_share`."""
    own, above, frame = np.empty((11, 3)), np.empty((11, 3)), np.empty((11, 3, 3))
    point_bones(pose, own, above, frame)
    least = 0.0
    for bone in range(11):
        over, cell = cells_of(own[bone], above[bone])
        share = log_share[_KIND[bone], over, cell]
        if bone == 0 or share < least:
            least = share
    return least
