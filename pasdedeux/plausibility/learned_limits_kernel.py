"""Learned joint limits for one pose at a time, compiled, for use inside chains; `learned_limits` is the plain form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.plausibility.joint_limits import NUM_ANGLES, TINY
from pasdedeux.plausibility.joint_limits_kernel import measure_angles, move_to_nearest_valid, turn_to
from pasdedeux.plausibility.learned_limits import ANGLES_OF_BONE, LIMIT_BONES
from pasdedeux.plausibility.occupancy import KIND_OF_BONE, NUM_CELLS, sphere_cells
from pasdedeux.plausibility.occupancy_kernel import cells_of, point_bones
from pasdedeux.skeletons import PAIR17

__all__ = ["move_to_nearest_learned"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_CELLS = sphere_cells(NUM_CELLS)
_KIND, _ANGLES = KIND_OF_BONE, ANGLES_OF_BONE
_PIVOT = np.array([PAIR17.index(pivot) for pivot, _, _ in LIMIT_BONES])
_END = np.array([PAIR17.index(end) for _, end, _ in LIMIT_BONES])
_LAST = np.array([10, 4, 4, 7, 10, 7, 10, 13, 16, 13, 16])
"""Last joint that a bone carries along; the first is the one it ends in."""
_CHEST_BONE = 0
_NUM_ANGLES, _TINY = NUM_ANGLES, TINY


@njit(cache=True, nogil=True, error_model="numpy")
def _is_out(index, limits, work):  # type: ignore[no-untyped-def]
    low, high = limits[0, index] - work[1, index], limits[1, index] + work[1, index]
    is_inside = low - _TINY <= work[0, index] <= high + _TINY
    return not is_inside and high - low < 2.0 * np.pi


@njit(cache=True, nogil=True, error_model="numpy")
def move_to_nearest_learned(
    pose: Array, limits: Array, girdles: Array, occupied: Flags, allowed: Flags, work: Array, valid: Array
) -> tuple[int, float]:
    """Find the nearest valid pose of one pose, as `LearnedLimits.nearest_valid` does.

    Args:
        pose: Positions (17, 3), float64, metres; not changed.
        limits: Least and greatest angles of the table, (2, 29), radians.
        girdles: The same with every angle of a bone free: `LearnedLimits.girdles`.
        occupied: `Occupancy.occupied`, (7, 60, 500).
        allowed: `LearnedLimits.allowed`, (7, 60, 500).
        work: Scratch (2, 29), overwritten.
        valid: The valid pose is written here, (17, 3).

    Returns:
        Number of invalid angles of `pose`, and the sum over the joints of the squared distance moved (square metres).
    """
    measure_angles(pose, work)
    num_invalid = 0
    for index in range(_NUM_ANGLES):
        num_invalid += _is_out(index, limits, work)
    if num_invalid == 0:
        for joint in range(17):
            for axis in range(3):
                valid[joint, axis] = pose[joint, axis]
        return 0, 0.0
    own, above, frame = np.empty((11, 3)), np.empty((11, 3)), np.empty((11, 3, 3))
    point_bones(pose, own, above, frame)
    for bone in range(11):
        bad = _is_out(_ANGLES[bone, 0], limits, work) + _is_out(_ANGLES[bone, 1], limits, work)
        if bad:
            over, cell = cells_of(own[bone], above[bone])
            if occupied[_KIND[bone], over, cell]:
                num_invalid -= bad
    move_to_nearest_valid(pose, girdles, work, valid)
    if num_invalid == 0:
        for joint in range(17):
            for axis in range(3):
                valid[joint, axis] = pose[joint, axis]
        return 0, 0.0
    moved = np.empty((17, 3))
    for bone in range(11):
        measure_angles(valid, work)
        if not (_is_out(_ANGLES[bone, 0], limits, work) or _is_out(_ANGLES[bone, 1], limits, work)):
            continue
        point_bones(valid, own, above, frame)
        over, cell = cells_of(own[bone], above[bone])
        if occupied[_KIND[bone], over, cell]:
            continue
        best, target = -2.0, 0
        for one in range(NUM_CELLS):
            if allowed[_KIND[bone], over, one]:
                near = own[bone, 0] * _CELLS[one, 0] + own[bone, 1] * _CELLS[one, 1] + own[bone, 2] * _CELLS[one, 2]
                if near > best:
                    best, target = near, one
        start, end = np.zeros(3), np.zeros(3)
        for row in range(3):
            for axis in range(3):
                start[axis] += own[bone, row] * frame[bone, row, axis]
                end[axis] += _CELLS[target, row] * frame[bone, row, axis]
        turn_to(valid, _END[bone], _LAST[bone], _PIVOT[bone], (start[0], start[1], start[2]), (end[0], end[1], end[2]))
        if bone == _CHEST_BONE:
            # The twist of the trunk is measured along it, so it has changed.
            for joint in range(17):
                for axis in range(3):
                    moved[joint, axis] = valid[joint, axis]
            move_to_nearest_valid(moved, girdles, work, valid)
    total = 0.0
    for joint in range(17):
        for axis in range(3):
            total += (valid[joint, axis] - pose[joint, axis]) ** 2
    return num_invalid, total
