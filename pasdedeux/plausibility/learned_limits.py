"""Joint limits learned from capture and united with the published table: valid is what either of them allows.

Hinge angles count only where positions determine them: the table's ranges of nearly straight limbs are wide
(`joint_limits`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.plausibility.joint_limits import JointLimits, NearestValid, as_poses
from pasdedeux.plausibility.joint_limits_kernel import (
    copy_pose,
    is_out,
    measure_angles,
    move_to_nearest_valid,
    squared_move,
    turn_to,
)
from pasdedeux.plausibility.occupancy import (
    BONES,
    KIND_OF_BONE,
    NUM_CELLS,
    Occupancy,
    bone_cells,
    cells_of,
    point_bones,
    sphere_cells,
)
from pasdedeux.plausibility.ranges import ANGLE_INDEX, NUM_ANGLES
from pasdedeux.skeletons import PAIR17

__all__ = ["ANGLES_OF_BONE", "LIMIT_BONES", "LearnedLimits"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_SIDES = ("left", "right")
LIMIT_BONES: tuple[tuple[str, str, tuple[tuple[str, str], tuple[str, str]]], ...] = (
    ("spine", "chest", (("spine", "flexion"), ("spine", "lateral"))),
    ("chest", "neck", (("chest", "flexion"), ("chest", "lateral"))),
    ("neck", "head", (("neck", "flexion"), ("neck", "lateral"))),
    *((f"{s}_shoulder", f"{s}_elbow", ((f"{s}_shoulder", "extension"), (f"{s}_shoulder", "crossing"))) for s in _SIDES),
    *((f"{s}_elbow", f"{s}_wrist", ((f"{s}_shoulder", "rotation"), (f"{s}_elbow", "flexion"))) for s in _SIDES),
    *((f"{s}_hip", f"{s}_knee", ((f"{s}_hip", "flexion"), (f"{s}_hip", "abduction"))) for s in _SIDES),
    *((f"{s}_knee", f"{s}_ankle", ((f"{s}_hip", "rotation"), (f"{s}_knee", "flexion"))) for s in _SIDES),
)
"""Joint that a bone turns about, joint it ends in, its two angles; in the order of `occupancy.point_bones`."""
ANGLES_OF_BONE = np.array([[ANGLE_INDEX[angle] for angle in angles] for _, _, angles in LIMIT_BONES])
"""Indices in `ANGLES` of the two angles of each bone, (bone=11, 2)."""


@dataclass(frozen=True)
class LearnedLimits:
    """The table's ranges of every angle, and where bones were seen to point.

    Args:
        table: Ranges of the angles, published or widened.
        occupancy: Counts of captured poses.
    """

    table: JointLimits
    occupancy: Occupancy

    def invalid_angles(self, pair17_m: Array) -> npt.NDArray[np.bool_]:
        """Tell which angles (*batch, 29) of poses (*batch, joint=17, 3) neither table nor capture allows."""
        invalid = self.table.invalid_angles(pair17_m)
        seen = self.occupancy.occupied[KIND_OF_BONE, *bone_cells(pair17_m)]
        for bone, angles in enumerate(ANGLES_OF_BONE):
            invalid[..., angles] &= ~seen[..., [bone]]
        return invalid

    def num_invalid(self, pair17_m: Array) -> npt.NDArray[np.int64]:
        """Count the angles out of range of poses (*batch, joint=17, 3), (*batch,)."""
        return np.asarray(self.invalid_angles(pair17_m).sum(axis=-1))

    def nearest_valid(self, pair17_m: Array) -> NearestValid:
        """Return valid poses near poses (*batch, joint=17, 3), bone by bone from the root outward.

        Shoulders, hips and the twist of the trunk move to the table's limit; every other bad bone to the centre of the
        nearest cell that table or capture allows, which is up to half a cell (5 degrees) more than it must move.
        """
        return NearestValid.of(np.shape(pair17_m), *_move_poses(as_poses(pair17_m), *self._tables))

    def move_pose(self, pose: Array, work: Array, valid: Array) -> tuple[int, float]:
        """Move one pose (17, 3) as `nearest_valid` does; see `JointLimits.move_pose`."""
        return _move_to_nearest(pose, *self._tables, work, valid)

    @cached_property
    def _tables(self) -> tuple[Array, Array, Flags, Flags]:
        return self.table.ranges_rad, self.girdles.ranges_rad, self.occupancy.occupied, self.allowed

    @cached_property
    def girdles(self) -> JointLimits:
        """The table with every angle of a bone free."""
        lower, upper = self.table.lower_rad.copy(), self.table.upper_rad.copy()
        lower[ANGLES_OF_BONE], upper[ANGLES_OF_BONE] = -2.0 * np.pi, 2.0 * np.pi
        return JointLimits(lower_rad=lower, upper_rad=upper, source=self.table.source)

    @cached_property
    def allowed(self) -> npt.NDArray[np.bool_]:
        """Whether table or capture allows a cell, given the cell of the bone above, (7, 60, 500)."""
        return np.asarray(self.occupancy.occupied | self._table_cells[:, None])

    @cached_property
    def _table_cells(self) -> npt.NDArray[np.bool_]:
        """Whether the table allows the centre of each cell, (7, 500): a standing figure points its left bones there."""
        poses = np.broadcast_to(_standing(), (NUM_CELLS, PAIR17.num_joints, 3))
        frames = np.empty((len(KIND_OF_BONE), 3, 3))
        point_bones(_standing(), np.empty(frames.shape[:2]), np.empty(frames.shape[:2]), frames)
        allowed = np.zeros((len(BONES), NUM_CELLS), dtype=bool)
        for kind in range(len(BONES)):
            bone = int(np.argmax(kind == KIND_OF_BONE))
            pivot, end = (PAIR17.index(name) for name in LIMIT_BONES[bone][:2])
            pointed = poses.copy()
            pointed[:, _subtree(LIMIT_BONES[bone][1])] += (
                pointed[:, [pivot]] + 0.2 * (sphere_cells(NUM_CELLS) @ frames[bone])[:, None] - pointed[:, [end]]
            )
            allowed[kind] = ~self.table.invalid_angles(pointed)[:, ANGLES_OF_BONE[bone]].any(axis=1)
        return allowed


def _subtree(joint: str) -> list[int]:
    found = [PAIR17.index(joint)]
    for index in found:
        found.extend(PAIR17.children(index))
    return found


def _standing() -> Array:
    """Return an upright figure (17, 3) with arms out and legs hanging: only its frames matter."""
    pose = np.zeros((PAIR17.num_joints, 3))
    place = {
        **{"spine": (0.0, 0.1), "chest": (0.0, 0.2), "neck": (0.0, 0.4), "head": (0.0, 0.6)},
        **{"shoulder": (0.2, 0.3), "elbow": (0.5, 0.3), "wrist": (0.8, 0.3)},
        **{"hip": (0.1, -0.05), "knee": (0.1, -0.5), "ankle": (0.1, -0.9)},
    }
    for name in PAIR17.joint_names[1:]:
        x, y = place[name.removeprefix("left_").removeprefix("right_")]
        pose[PAIR17.index(name)] = (-x if name.startswith("right_") else x, y, 0.0)
    return pose


_CELLS = sphere_cells(NUM_CELLS)
_PIVOT = np.array([PAIR17.index(pivot) for pivot, _, _ in LIMIT_BONES])
_END = np.array([PAIR17.index(end) for _, end, _ in LIMIT_BONES])
_LAST = np.array([10, 4, 4, 7, 10, 7, 10, 13, 16, 13, 16])
"""Last joint that a bone carries along; the first is the one it ends in."""
_CHEST_BONE = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _move_to_nearest(
    pose: Array, limits: Array, girdles: Array, occupied: Flags, allowed: Flags, work: Array, valid: Array
) -> tuple[int, float]:
    """Find the nearest valid pose of one pose, as `LearnedLimits.nearest_valid` does.

    Args:
        pose: Positions (17, 3), float64, metres; not changed.
        limits: Smallest and greatest angles of the table, (2, 29), radians.
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
    for index in range(NUM_ANGLES):
        num_invalid += is_out(index, limits, work)
    if num_invalid == 0:
        copy_pose(pose, valid)
        return 0, 0.0
    own, above, frame = np.empty((11, 3)), np.empty((11, 3)), np.empty((11, 3, 3))
    point_bones(pose, own, above, frame)
    for bone in range(11):
        bad = is_out(ANGLES_OF_BONE[bone, 0], limits, work) + is_out(ANGLES_OF_BONE[bone, 1], limits, work)
        if bad:
            over, cell = cells_of(own[bone], above[bone])
            if occupied[KIND_OF_BONE[bone], over, cell]:
                num_invalid -= bad
    move_to_nearest_valid(pose, girdles, work, valid)
    if num_invalid == 0:
        copy_pose(pose, valid)
        return 0, 0.0
    moved = np.empty((17, 3))
    for bone in range(11):
        measure_angles(valid, work)
        if not (is_out(ANGLES_OF_BONE[bone, 0], limits, work) or is_out(ANGLES_OF_BONE[bone, 1], limits, work)):
            continue
        point_bones(valid, own, above, frame)
        over, cell = cells_of(own[bone], above[bone])
        if occupied[KIND_OF_BONE[bone], over, cell]:
            continue
        best, target = -2.0, 0
        for one in range(NUM_CELLS):
            if allowed[KIND_OF_BONE[bone], over, one]:
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
            copy_pose(valid, moved)
            move_to_nearest_valid(moved, girdles, work, valid)
    return num_invalid, squared_move(pose, valid)


@njit(cache=True, nogil=True, error_model="numpy")
def _move_poses(
    poses: Array, limits: Array, girdles: Array, occupied: Flags, allowed: Flags
) -> tuple[Array, npt.NDArray[np.int64], Array]:
    valid, work = np.empty(poses.shape), np.empty((2, NUM_ANGLES))
    count, squared = np.empty(poses.shape[0], np.int64), np.empty(poses.shape[0])
    for row in range(poses.shape[0]):
        count[row], squared[row] = _move_to_nearest(poses[row], limits, girdles, occupied, allowed, work, valid[row])
    return valid, count, squared
