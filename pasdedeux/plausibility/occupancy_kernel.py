"""The pose prior of one pose at a time, compiled, for use inside chains; `occupancy` is the plain form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.plausibility.joint_limits_kernel import bone_of, carry, cross, dot, frame_x, scale
from pasdedeux.plausibility.occupancy import NUM_ABOVE, NUM_CELLS, sphere_cells

__all__ = ["weakest_bone"]

Array = npt.NDArray[np.float64]

_CELLS, _ABOVE = sphere_cells(NUM_CELLS), sphere_cells(NUM_ABOVE)
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
def _seen(x, y, z, bone):  # type: ignore[no-untyped-def]
    return (dot(x, bone), dot(y, bone), dot(z, bone))


@njit(cache=True, nogil=True, error_model="numpy")
def _share(log_share, kind, above, own):  # type: ignore[no-untyped-def]
    return log_share[kind, _nearest(_ABOVE, above), _nearest(_CELLS, own)]


@njit(cache=True, nogil=True, error_model="numpy")
def weakest_bone(pose: Array, log_share: Array) -> float:
    """Give `Occupancy.log_prior` of one pose (17, 3), float64, metres, from `Occupancy.log_share`."""
    pelvis_y, chest_y, neck_y = bone_of(pose, 0, 1), bone_of(pose, 1, 2), bone_of(pose, 2, 3)
    pelvis_x = frame_x(pose, 11, 14, pelvis_y)
    chest_x = frame_x(pose, 5, 8, chest_y)
    across = dot(chest_x, neck_y)
    neck_x = (chest_x[0] - across * neck_y[0], chest_x[1] - across * neck_y[1], chest_x[2] - across * neck_y[2])
    length = np.sqrt(dot(neck_x, neck_x))
    neck_x = scale(1.0 / length if length > 1e-12 else 0.0, neck_x)
    pelvis_z, chest_z, neck_z = cross(pelvis_x, pelvis_y), cross(chest_x, chest_y), cross(neck_x, neck_y)
    chest = _seen(pelvis_x, pelvis_y, pelvis_z, chest_y)
    neck = _seen(chest_x, chest_y, chest_z, neck_y)
    least = _share(log_share, 0, _TRUNK, chest)
    least = min(least, _share(log_share, 1, chest, neck))
    least = min(least, _share(log_share, 2, neck, _seen(neck_x, neck_y, neck_z, bone_of(pose, 3, 4))))
    for limb in range(4):
        is_arm = limb < 2
        side = 1.0 if limb % 2 == 0 else -1.0
        first = 5 + 3 * (limb % 2) if is_arm else 11 + 3 * (limb % 2)
        x, y, z = (scale(side, chest_x), chest_y, chest_z) if is_arm else (scale(side, pelvis_x), pelvis_y, pelvis_z)
        rest = x if is_arm else scale(-1.0, y)
        upper, lower = bone_of(pose, first, first + 1), bone_of(pose, first + 1, first + 2)
        above = _seen(x, y, z, upper)
        kind = 3 if is_arm else 5
        least = min(least, _share(log_share, kind, _TRUNK, above))
        own = _seen(carry(rest, upper, x), carry(rest, upper, y), carry(rest, upper, z), lower)
        least = min(least, _share(log_share, kind + 1, above, own))
    return least
