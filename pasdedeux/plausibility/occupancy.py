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

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import PAIR17

__all__ = [
    "BONES",
    "KIND_OF_BONE",
    "NUM_ABOVE",
    "NUM_CELLS",
    "BoneDirections",
    "Occupancy",
    "bone_cells",
    "bone_directions",
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
_CHUNK = 2000


def sphere_cells(count: int) -> Array:
    """Return `count` unit vectors (count, 3) spread evenly over the sphere: the Fibonacci lattice."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    around = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(around), height, radius * np.sin(around)], axis=-1)


@dataclass(frozen=True)
class BoneDirections:
    """Directions of the eleven bones of poses, right ones mirrored to the left.

    Args:
        own: Unit directions in the frame of what the bone hangs on, (*batch, bone=11, 3).
        above: Unit directions of the bone above in its own frame, (*batch, bone=11, 3); (0, 1, 0) where the bone hangs
            on the trunk.
        frame: Axes of the frames in world axes, as rows, mirrored for the right, (*batch, bone=11, 3, 3).
    """

    own: Array
    above: Array
    frame: Array


def bone_directions(pair17_m: Array) -> BoneDirections:
    """Return the directions of the bones of poses (*batch, joint=17, 3), metres.

    Frames are those of `joint_limits`: the pelvis' for chest and thighs, the chest's for neck and upper arms, the
    neck's for the head, and for forearm and shank the frame carried without twist from the arm held sideways and the
    thigh hanging.
    """
    points = np.asarray(pair17_m, dtype=np.float64)

    def bone(start: str, end: str) -> Array:
        return normalise(points[..., PAIR17.index(end), :] - points[..., PAIR17.index(start), :])

    def square(vector: Array, to: Array) -> Array:
        return normalise(vector - np.sum(vector * to, axis=-1, keepdims=True) * to)

    pelvis_y, chest_y, neck_y = bone("pelvis", "spine"), bone("spine", "chest"), bone("chest", "neck")
    pelvis_x = square(bone("right_hip", "left_hip"), pelvis_y)
    chest_x = square(bone("right_shoulder", "left_shoulder"), chest_y)
    neck_x = square(chest_x, neck_y)
    pelvis, chest, neck = (
        np.stack([x, y, np.cross(x, y)], axis=-2)
        for x, y in ((pelvis_x, pelvis_y), (chest_x, chest_y), (neck_x, neck_y))
    )
    frames, ends = [pelvis, chest, neck], [chest_y, neck_y, bone("neck", "head")]
    mirror = np.array([[[1.0], [1.0], [1.0]], [[-1.0], [1.0], [1.0]]])
    sides = ("left", "right")
    for root, middle, end, trunk, rest in (
        ("shoulder", "elbow", "wrist", chest, np.array([1.0, 0.0, 0.0])),
        ("hip", "knee", "ankle", pelvis, np.array([0.0, -1.0, 0.0])),
    ):
        upper = [bone(f"{side}_{root}", f"{side}_{middle}") for side in sides]
        frames += [trunk * mirror[row] for row in range(2)]
        ends += upper
        for row, side in enumerate(sides):
            axes = trunk * mirror[row]
            frames.append(_carried(axes, np.einsum("i,...ij->...j", rest, axes), upper[row]))
            ends.append(bone(f"{side}_{middle}", f"{side}_{end}"))
    frame, direction = np.stack(frames, axis=-3), np.stack(ends, axis=-2)
    own = np.einsum("...bij,...bj->...bi", frame, direction)
    above = np.broadcast_to(np.array([0.0, 1.0, 0.0]), own.shape).copy()
    above[..., [1, 2], :] = own[..., [0, 1], :]
    above[..., [5, 6, 9, 10], :] = own[..., [3, 4, 7, 8], :]
    return BoneDirections(own=own, above=above, frame=frame)


def _carried(axes: Array, start: Array, end: Array) -> Array:
    """Carry axes, as rows (*batch, 3, 3), along the shortest turn from unit `start` to unit `end`, both (*batch, 3)."""
    total = start + end
    factor = np.einsum("...ij,...j->...i", axes, total) / np.maximum(
        1.0 + np.sum(start * end, axis=-1, keepdims=True), 1e-9
    )
    twice = 2.0 * np.einsum("...ij,...j->...i", axes, start)
    return np.asarray(axes - factor[..., None] * total[..., None, :] + twice[..., None] * end[..., None, :])


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
        poses = np.asarray(pair17_m, dtype=np.float64).reshape(-1, PAIR17.num_joints, 3)
        poses = poses[np.isfinite(poses).all(axis=(1, 2))]
        counts = self.counts.copy()
        for start in range(0, len(poses), _CHUNK):
            above, cell = bone_cells(bone_directions(poses[start : start + _CHUNK]))
            np.add.at(counts, (np.broadcast_to(KIND_OF_BONE, cell.shape), above, cell), 1)
        return Occupancy(counts)

    def log_prior(self, pair17_m: Array) -> Array:
        """Return log of the prior of poses (*batch, joint=17, 3), (*batch,): the least over the bones of `log_share`.

        It is 0 everywhere when nothing was learned.
        """
        return np.asarray(self.bone_logs(pair17_m).min(axis=-1))

    def bone_logs(self, pair17_m: Array) -> Array:
        """Return `log_share` of each bone of poses (*batch, joint=17, 3), metres, (*batch, bone=11)."""
        above, cell = bone_cells(bone_directions(pair17_m))
        return np.asarray(self.log_share[KIND_OF_BONE, above, cell])

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
        near_cell = _kernel(sphere_cells(NUM_CELLS), _CELL_WIDTH_RAD)
        near_above = _kernel(sphere_cells(NUM_ABOVE), _ABOVE_WIDTH_RAD, is_share=False)
        blurred = np.einsum("pq,bqc,cd->bpd", near_above, self.counts.astype(np.float64), near_cell, optimize=True)
        every = self.counts.sum(axis=1) @ near_cell
        total = every.sum(axis=-1, keepdims=True)
        even = np.full_like(every, 1.0 / NUM_CELLS)
        every = np.where(total > 0.0, every / np.maximum(total, 1.0), even)[:, None]
        share = (blurred + _MARGINAL_POSES * every) / (blurred.sum(axis=-1, keepdims=True) + _MARGINAL_POSES)
        return np.asarray(np.log((1.0 - _UNIFORM_SHARE) * share * NUM_CELLS + _UNIFORM_SHARE))


def _kernel(cells: Array, width_rad: float, *, is_share: bool = True) -> Array:
    weight = np.exp((cells @ cells.T - 1.0) / width_rad**2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True) if is_share else weight)


def bone_cells(directions: BoneDirections) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the cells of the bones above and of the bones, both (*batch, bone=11)."""
    above = np.argmax(directions.above @ sphere_cells(NUM_ABOVE).T, axis=-1)
    return above, np.argmax(directions.own @ sphere_cells(NUM_CELLS).T, axis=-1)
