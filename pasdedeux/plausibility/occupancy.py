"""Where bones have been seen to point: a pose prior learned from capture, conditioned on the pose.

Per bone a grid over its direction in its parent's frame, and a coarser one over the direction of the bone above it: the
counts of captured poses in both.  Left and right are mirrored into one.  The structure is that of Akhter and Black
(2015), "Pose-conditioned joint angle limits for 3D human pose reconstruction"; counts, grids and frames are our own,
and learned from the poses that are given, so a user's own takes extend them.

The prior is the smoothed share of the cell among the poses whose bone above points alike, at the bone where it is
least.  The sum over the bones tells worse: it mostly says how common a pose is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.joint_limits import as_poses
from pasdedeux.skeletons import PAIR17

__all__ = ["BONES", "NUM_ABOVE", "NUM_CELLS", "Occupancy", "bone_cells", "bone_directions", "sphere_cells"]

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

NUM_CELLS = 500
"""Directions a bone is told apart by: about 9 degrees from one to the next."""
NUM_ABOVE = 60
"""Directions of the bone above it: about 26 degrees from one to the next."""

BONES = ("chest", "neck", "head", "upper_arm", "forearm", "thigh", "shank")
"""Bones with a grid of their own; the four of the limbs are shared by both sides."""
_KIND_OF_BONE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5, 6, 6])
"""Which grid each of the eleven bones of a pose has: chest, neck, head, then the limbs, left before right."""
_CELL_WIDTH_RAD, _ABOVE_WIDTH_RAD = 0.1, 0.35
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
        """Return the occupancy of no pose at all: the prior is flat."""
        return cls(np.zeros((len(BONES), NUM_ABOVE, NUM_CELLS), dtype=np.int64))

    def extended(self, pair17_m: Array) -> Occupancy:
        """Return occupancy with more poses (*batch, joint=17, 3), metres; poses that are not finite are left out."""
        poses = as_poses(pair17_m)
        poses = poses[np.isfinite(poses).all(axis=(1, 2))]
        counts = self.counts.copy()
        np.add.at(counts, (_KIND_OF_BONE, *bone_cells(poses)), 1)
        return Occupancy(counts)

    def bone_logs(self, pair17_m: Array) -> Array:
        """Return `log_share` of each bone of poses (*batch, joint=17, 3), metres, (*batch, bone=11).

        It is 0 everywhere when nothing was learned.
        """
        return np.asarray(self.log_share[_KIND_OF_BONE, *bone_cells(pair17_m)])

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
    own = bone_directions(np.asarray(pair17_m, dtype=np.float64))
    above = np.broadcast_to([0.0, 1.0, 0.0], own.shape).copy()
    above[..., [1, 2], :] = own[..., [0, 1], :]
    above[..., [5, 6, 9, 10], :] = own[..., [3, 4, 7, 8], :]
    return np.asarray(_nearest(NUM_ABOVE).query(above)[1]), np.asarray(_nearest(NUM_CELLS).query(own)[1])


@cache
def _nearest(num_cells: int) -> Any:
    """Return what finds the nearest of so many cells."""
    from scipy.spatial import cKDTree  # here: planning need not wait for it

    return cKDTree(sphere_cells(num_cells))


_MIRROR = np.array([-1.0, 1.0, 1.0])[:, None]
"""What turns the axes of the trunk, as rows, into those of its mirror image."""


def bone_directions(pair17_m: Array) -> Array:
    """Return the unit directions (*batch, bone=11, 3) of poses (*batch, joint=17, 3), right ones mirrored to the left.

    Each is in the frame of what the bone hangs on, one of `joint_limits`: the pelvis' for chest and thighs, the chest's
    for neck and upper arms, the neck's for the head, and for forearm and shank the frame carried without twist from the
    arm held sideways and the thigh hanging.  A bone of length zero has none: (0, 0, 0).
    """

    def bone(start: str, end: str) -> Array:
        return normalise(pair17_m[..., PAIR17.index(end), :] - pair17_m[..., PAIR17.index(start), :])

    def frame(across: Array, up: Array) -> Array:
        x = normalise(across - np.sum(across * up, axis=-1, keepdims=True) * up)
        return np.stack([x, up, np.cross(x, up)], axis=-2)

    trunk, neck, head = bone("spine", "chest"), bone("chest", "neck"), bone("neck", "head")
    pelvis_frame = frame(bone("right_hip", "left_hip"), bone("pelvis", "spine"))
    chest_frame = frame(bone("right_shoulder", "left_shoulder"), trunk)
    neck_frame = frame(chest_frame[..., 0, :], neck)
    found = [(pelvis_frame, trunk), (chest_frame, neck), (neck_frame, head)]
    for root, middle, end, hung_on, rest in (
        ("shoulder", "elbow", "wrist", chest_frame, [1.0, 0.0, 0.0]),
        ("hip", "knee", "ankle", pelvis_frame, [0.0, -1.0, 0.0]),
    ):
        axes = (("left", hung_on), ("right", hung_on * _MIRROR))
        upper = {side: bone(f"{side}_{root}", f"{side}_{middle}") for side, _ in axes}
        found += [(own, upper[side]) for side, own in axes]
        found += [
            (_carried(own, rest @ own, upper[side]), bone(f"{side}_{middle}", f"{side}_{end}")) for side, own in axes
        ]
    return np.stack([np.einsum("...ij,...j->...i", own, direction) for own, direction in found], axis=-2)


def _carried(axes: Array, start: Array, end: Array) -> Array:
    """Carry axes, as rows (*batch, 3, 3), along the shortest turn from unit `start` to unit `end`, both (*batch, 3)."""
    total = start + end
    cosine = np.sum(start * end, axis=-1, keepdims=True)
    factor = np.einsum("...ij,...j->...i", axes, total) / np.maximum(1.0 + cosine, 1e-9)
    twice = 2.0 * np.einsum("...ij,...j->...i", axes, start)
    return np.asarray(axes - factor[..., None] * total[..., None, :] + twice[..., None] * end[..., None, :])
