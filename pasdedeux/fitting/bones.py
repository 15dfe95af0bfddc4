"""Bones as unknowns: a pose is a root and the unit direction of every bone, so lengths are exact by construction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import Skeleton

__all__ = ["BoneForest", "BoneState"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BoneState:
    """A motion: roots (frame, person, 3) in metres and unit bone directions (frame, point, 3), roots' unused."""

    roots_m: Array
    directions: Array


@dataclass(frozen=True)
class BoneForest:
    """The skeletons of one or several people as one forest of N points, with their bone lengths.

    The step of a frame has n = 3 P + 2 (N - P) numbers: per person the root's translation, then for each bone two
    tangent coordinates of its direction on the sphere, in the order of the points.

    Args:
        skeletons: One skeleton per person; their points follow each other.
        lengths_m: Length of the bone that ends in each point (N,), metres, 0 or more; roots' are unused.

    Raises:
        InputError: Lengths that do not fit, are negative or not finite.
    """

    skeletons: tuple[Skeleton, ...]
    lengths_m: Array

    def __post_init__(self) -> None:
        """Check the lengths."""
        if self.lengths_m.shape != (self.num_points,):
            raise InputError(f"bone lengths have shape {self.lengths_m.shape}, expected ({self.num_points},)")
        if not (np.isfinite(self.lengths_m) & (self.lengths_m >= 0)).all():
            raise InputError(f"bone lengths must be finite and 0 or more, found {np.min(self.lengths_m):g}")

    @cached_property
    def num_points(self) -> int:
        """Number of points of all people."""
        return sum(skeleton.num_joints for skeleton in self.skeletons)

    @cached_property
    def parents(self) -> npt.NDArray[np.int64]:
        """Parent of each point (N,), -1 for roots."""
        parents: list[int] = []
        for skeleton in self.skeletons:
            start = len(parents)
            parents.extend(parent + start if parent >= 0 else -1 for parent in skeleton.parents)
        return np.array(parents)

    @cached_property
    def order(self) -> npt.NDArray[np.int64]:
        """Points from the roots outwards."""
        order: list[int] = []
        start = 0
        for skeleton in self.skeletons:
            order.extend(joint + start for joint in skeleton.order)
            start += skeleton.num_joints
        return np.array(order)

    @cached_property
    def roots(self) -> npt.NDArray[np.int64]:
        """Points that are roots, one a person."""
        return np.flatnonzero(self.parents < 0)

    @cached_property
    def starts(self) -> npt.NDArray[np.int64]:
        """Where each point's unknowns start in a frame's step (N + 1,); the last entry is n."""
        return np.concatenate([[0], np.cumsum(np.where(self.parents < 0, 3, 2))])

    @property
    def num_unknowns(self) -> int:
        """Unknowns n of one frame."""
        return int(self.starts[-1])

    @cached_property
    def carries(self) -> Array:
        """C (N, N): 1 where the bone (or root) of the row moves the point of the column."""
        carries = np.eye(self.num_points)
        for point in self.order[::-1]:
            if self.parents[point] >= 0:
                carries[self.parents[point]] += carries[point]
        return carries

    def state_of(self, positions_m: Array) -> BoneState:
        """Read roots and directions off positions (frame, N, 3); a bone of length zero points up."""
        before = np.where(self.parents < 0, np.arange(self.num_points), self.parents)
        directions = normalise(positions_m - positions_m[:, before], fallback=np.array([0.0, 1.0, 0.0]))
        return BoneState(roots_m=np.array(positions_m[:, self.roots]), directions=directions)

    def positions(self, state: BoneState) -> Array:
        """Return positions (frame, N, 3), metres."""
        positions = np.empty(state.directions.shape)
        positions[:, self.roots] = state.roots_m
        for point in self.order:
            parent = self.parents[point]
            if parent >= 0:
                positions[:, point] = positions[:, parent] + self.lengths_m[point] * state.directions[:, point]
        return positions

    def tangents(self, state: BoneState) -> Array:
        """Return two unit vectors square to each direction and to each other (frame, N, 3, 2)."""
        direction = state.directions
        helper = np.where(np.abs(direction[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
        first = normalise(np.cross(direction, helper))
        return np.stack([first, np.cross(direction, first)], axis=-1)

    def retract(self, state: BoneState, tangents: Array, step: Array) -> BoneState:
        """Move by a step (frame, n): roots are translated, directions leave along their tangents, made unit again."""
        roots = np.array(state.roots_m)
        moved = np.array(state.directions)
        for person, point in enumerate(self.roots):
            roots[:, person] += step[:, self.starts[point] : self.starts[point] + 3]
        is_bone = self.parents >= 0
        at = self.starts[:-1][is_bone]
        pair = np.stack([step[:, at], step[:, at + 1]], axis=-1)
        moved[:, is_bone] = normalise(moved[:, is_bone] + np.einsum("tnij,tnj->tni", tangents[:, is_bone], pair))
        return BoneState(roots_m=roots, directions=moved)
