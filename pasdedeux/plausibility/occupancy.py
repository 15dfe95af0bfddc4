"""Where bones have been seen to point: joint limits and a pose prior learned from capture, conditioned on the pose.

Per bone a grid over its direction in its parent's frame, and a coarser one over the direction of the bone above it: the
counts of captured poses in both.  Left and right are mirrored into one.  The structure is that of Akhter and Black
(2015), "Pose-conditioned joint angle limits for 3D human pose reconstruction"; counts, grids and frames are our own,
and learned from the poses that are given, so a user's own takes extend them.

Two things are read from it.  *Limits* (`learned_limits`): a bone is in range when the published table says so, or when
its cell, or one near by, was seen.  *A prior*: the smoothed share of the cell among the poses whose bone above points
alike, at the bone where it is least.  The sum over the bones tells worse: it mostly says how common a pose is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotation_kernels import carry, cross, dot, inner_kernel, mix, normalise, scale
from pasdedeux.plausibility.joint_limits import as_poses
from pasdedeux.plausibility.joint_limits_kernel import bone_of, frame_x

__all__ = [
    "BONES",
    "KIND_OF_BONE",
    "NUM_ABOVE",
    "NUM_CELLS",
    "Occupancy",
    "bone_cells",
    "cells_of",
    "point_bones",
    "sphere_cells",
]

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

NUM_CELLS = 500
"""Directions a bone is told apart by: about 9 degrees from one to the next."""
NUM_ABOVE = 60
"""Directions of the bone above it: about 26 degrees from one to the next."""

BONES = ("chest", "neck", "head", "upper_arm", "forearm", "thigh", "shank")
"""Bones with a grid of their own; the four of the limbs are shared by both sides."""
KIND_OF_BONE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5, 6, 6])
"""Which grid each of the eleven bones of a pose has: chest, neck, head, then the limbs, left before right."""
_CELL_WIDTH_RAD, _ABOVE_WIDTH_RAD = 0.1, 0.35
_DILATION_RAD, _ABOVE_DILATION_RAD = np.deg2rad(12.0), np.deg2rad(28.0)
_MARGINAL_POSES, _UNIFORM_SHARE = 20.0, 0.02


def sphere_cells(count: int) -> Array:
    """Return `count` unit vectors (count, 3) spread evenly over the sphere: the Fibonacci lattice."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    around = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(around), height, radius * np.sin(around)], axis=-1)


@dataclass(frozen=True)
class Occupancy:
    """Counts of captured poses by bone, direction of the bone above it, and direction.

    Args:
        counts: Poses, (bone=7, above=60, cell=500); both sides of a person count.

    Raises:
        InputError: The shape is wrong or a count is negative.
    """

    counts: Counts

    def __post_init__(self) -> None:
        """Check shape and sign."""
        shape = (len(BONES), NUM_ABOVE, NUM_CELLS)
        if self.counts.shape != shape or (self.counts < 0).any():
            raise InputError(f"an occupancy needs {shape} counts that are not negative, found {self.counts.shape}")

    @classmethod
    def empty(cls) -> Occupancy:
        """Return the occupancy of no pose at all: limits are the table's, and the prior is flat."""
        return cls(np.zeros((len(BONES), NUM_ABOVE, NUM_CELLS), dtype=np.int64))

    def extended(self, pair17_m: Array) -> Occupancy:
        """Return occupancy with more poses (*batch, joint=17, 3), metres; poses that are not finite are left out."""
        poses = as_poses(pair17_m)
        poses = poses[np.isfinite(poses).all(axis=(1, 2))]
        counts = self.counts.copy()
        np.add.at(counts, (KIND_OF_BONE, *bone_cells(poses)), 1)
        return Occupancy(counts)

    def bone_logs(self, pair17_m: Array) -> Array:
        """Return `log_share` of each bone of poses (*batch, joint=17, 3), metres, (*batch, bone=11).

        It is 0 everywhere when nothing was learned.
        """
        return np.asarray(self.log_share[KIND_OF_BONE, *bone_cells(pair17_m)])

    @cached_property
    def occupied(self) -> npt.NDArray[np.bool_]:
        """Whether a pose had the bone within 12 degrees of a cell, the bone above within 28, (7, 60, 500)."""
        cells, above = sphere_cells(NUM_CELLS), sphere_cells(NUM_ABOVE)
        near_cell = (cells @ cells.T >= np.cos(_DILATION_RAD)).astype(np.float32)
        near_above = (above @ above.T >= np.cos(_ABOVE_DILATION_RAD)).astype(np.float32)
        seen = (self.counts > 0).astype(np.float32)
        return np.asarray(np.einsum("pq,bqd->bpd", near_above, seen @ near_cell) > 0.5)

    @cached_property
    def log_share(self) -> Array:
        """Log of the smoothed share of each cell given the bone above, times the number of cells, (7, 60, 500).

        Counts are blurred over both grids; where few poses support a direction above, the shares of all directions
        above stand in (20 poses' worth), and every cell keeps 2 % of an even share.
        """
        near_cell = _blur(sphere_cells(NUM_CELLS), _CELL_WIDTH_RAD)
        near_above = _blur(sphere_cells(NUM_ABOVE), _ABOVE_WIDTH_RAD, is_share=False)
        blurred = np.einsum("pq,bqc,cd->bpd", near_above, self.counts.astype(np.float64), near_cell, optimize=True)
        every = self.counts.sum(axis=1) @ near_cell
        total = every.sum(axis=-1, keepdims=True)
        even = np.full_like(every, 1.0 / NUM_CELLS)
        every = np.where(total > 0.0, every / np.maximum(total, 1.0), even)[:, None]
        share = (blurred + _MARGINAL_POSES * every) / (blurred.sum(axis=-1, keepdims=True) + _MARGINAL_POSES)
        return np.asarray(np.log((1.0 - _UNIFORM_SHARE) * share * NUM_CELLS + _UNIFORM_SHARE))


def _blur(cells: Array, width_rad: float, *, is_share: bool = True) -> Array:
    weight = np.exp((cells @ cells.T - 1.0) / width_rad**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True) if is_share else weight)


def bone_cells(pair17_m: Array) -> tuple[Counts, Counts]:
    """Return the cells of the bones above, and of the bones, of poses (*batch, joint=17, 3), both (*batch, bone=11)."""
    cells = _find_cells(as_poses(pair17_m)).reshape(*np.shape(pair17_m)[:-2], len(KIND_OF_BONE), 2)
    return cells[..., 0], cells[..., 1]


_CELLS, _ABOVE = sphere_cells(NUM_CELLS), sphere_cells(NUM_ABOVE)
_TRUNK = (0.0, 1.0, 0.0)


@inner_kernel
def _nearest(cells, direction):  # type: ignore[no-untyped-def]
    best, found = -2.0, 0
    for cell in range(cells.shape[0]):
        near = cells[cell, 0] * direction[0] + cells[cell, 1] * direction[1] + cells[cell, 2] * direction[2]
        if near > best:
            best, found = near, cell
    return found


@inner_kernel
def _enter(bone, x, y, z, direction, above, own, over, frame):  # type: ignore[no-untyped-def]
    for axis in range(3):
        frame[bone, 0, axis], frame[bone, 1, axis], frame[bone, 2, axis] = x[axis], y[axis], z[axis]
        over[bone, axis] = above[axis]
    own[bone, 0], own[bone, 1], own[bone, 2] = dot(x, direction), dot(y, direction), dot(z, direction)


@njit(cache=True, nogil=True, error_model="numpy")
def point_bones(pose: Array, own: Array, above: Array, frame: Array) -> None:
    """Write the directions of the eleven bones of a pose (17, 3), right ones mirrored to the left.

    Frames are those of `joint_limits`: the pelvis' for chest and thighs, the chest's for neck and upper arms, the
    neck's for the head, and for forearm and shank the frame carried without twist from the arm held sideways and the
    thigh hanging.

    Args:
        pose: Positions (17, 3), float64, metres.
        own: Unit directions in the frame of what the bone hangs on, (11, 3).
        above: Those of the bone above in its own frame, (11, 3); (0, 1, 0) where the bone hangs on the trunk.
        frame: Axes of the frames in world axes, as rows, mirrored for the right, (11, 3, 3).
    """
    pelvis_y, chest_y, neck_y = bone_of(pose, 0, 1), bone_of(pose, 1, 2), bone_of(pose, 2, 3)
    pelvis_x = frame_x(pose, 11, 14, pelvis_y)
    chest_x = frame_x(pose, 5, 8, chest_y)
    neck_x = normalise(mix(1.0, chest_x, -dot(chest_x, neck_y), neck_y))
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
def _find_cells(poses: Array) -> Counts:
    found = np.empty((poses.shape[0], 11, 2), np.int64)
    own, above, frame = np.empty((11, 3)), np.empty((11, 3)), np.empty((11, 3, 3))
    for row in range(poses.shape[0]):
        point_bones(poses[row], own, above, frame)
        for bone in range(11):
            found[row, bone, 0], found[row, bone, 1] = cells_of(own[bone], above[bone])
    return found
