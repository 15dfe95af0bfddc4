"""Bones as unknowns: a pose is a root and the unit direction of every bone, so lengths stay exact."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import cross, divide, length, normalise, put_row, row_of, subtract
from pasdedeux.skeletons import Skeleton

_TINY = 1e-12


@dataclass(frozen=True)
class BoneState:
    """A motion: roots (frame, person, 3) in metres and unit bone directions (frame, point, 3), roots' unused."""

    roots_m: Array
    directions: Array


@dataclass(frozen=True)
class Topology:
    """The structure of a forest of N points, without lengths; its arrays are read-only.

    Args:
        parents: Parent of each point (N,), -1 for roots.
        order: Points from the roots outwards (N,).
        roots: Points that are roots, one a person (P,).
        starts: Where each point's unknowns start in a frame's step (N + 1,); the last entry is n.
        carries: C (N, N): 1 if the bone (or root) of the row moves the point of the column.
        related: Pairs of points of which one carries the other (m, 2), including each point with itself.
        further: The carried point of each pair (m,).
        unknown_points: Point of each unknown of a frame (n,).
        unknown_columns: Number of each unknown among those of its point (n,), 0 to 2.
    """

    parents: Integers
    order: Integers
    roots: Integers
    starts: Integers
    carries: Array
    related: Integers
    further: Integers
    unknown_points: Integers
    unknown_columns: Integers


@lru_cache(maxsize=64)
def topology_of(skeletons: tuple[Skeleton, ...]) -> Topology:
    """Return the topology of skeletons whose points follow each other; cached."""
    first = np.cumsum([0, *(skeleton.num_joints for skeleton in skeletons)])
    bodies = list(zip(first, skeletons, strict=False))
    parents = np.array(
        [at + up if up >= 0 else -1 for at, skeleton in bodies for up in skeleton.parents], dtype=np.int64
    )
    order = np.array([at + joint for at, skeleton in bodies for joint in skeleton.order], dtype=np.int64)
    carries = np.eye(len(parents))
    for point in order[::-1]:
        if parents[point] >= 0:
            carries[parents[point]] += carries[point]
    starts = np.concatenate([[0], np.cumsum(np.where(parents < 0, 3, 2))])
    related = np.argwhere((carries > 0) | (carries.T > 0))
    unknown_points = np.repeat(np.arange(len(parents)), np.diff(starts))
    topology = Topology(
        parents=parents,
        order=order,
        roots=np.flatnonzero(parents < 0),
        starts=starts,
        carries=carries,
        related=related,
        further=np.where(carries[related[:, 0], related[:, 1]] > 0, related[:, 1], related[:, 0]),
        unknown_points=unknown_points,
        unknown_columns=np.arange(starts[-1]) - starts[:-1][unknown_points],
    )
    for values in vars(topology).values():
        values.flags.writeable = False  # as kernels see those that a module holds
    return topology


@dataclass(frozen=True)
class BoneForest:
    """The skeletons of one or several people as one forest of N points, with their bone lengths.

    The step of a frame has n = 3 P + 2 (N - P) numbers: per person the root's translation, then for each bone two
    tangent coordinates of its direction on the sphere, in the order of the points.

    Args:
        skeletons: One skeleton per person; their points follow each other.
        lengths_m: Length of the bone that ends in each point (N,), metres, 0 or more; roots' are unused.
    """

    skeletons: tuple[Skeleton, ...]
    lengths_m: Array

    @property
    def topology(self) -> Topology:
        """Structure of the points."""
        return topology_of(self.skeletons)

    def state_of(self, positions_m: Array) -> BoneState:
        """Read roots and directions off positions (frame, N, 3); a bone of length zero points up."""
        directions = directions_of(plain(positions_m), self.topology.parents)
        return BoneState(roots_m=np.take(positions_m, self.topology.roots, axis=1), directions=directions)

    def positions(self, state: BoneState) -> Array:
        """Return positions (frame, N, 3), metres."""
        shape = self.topology
        return place_along_bones(
            state.roots_m, state.directions, self.lengths_m, shape.parents, shape.order, shape.roots
        )

    def retract(self, state: BoneState, tangents: Array, step: Array) -> BoneState:
        """Apply a step (frame, n): translate roots, move directions along their tangents, and normalise them."""
        shape = self.topology
        first = shape.starts[shape.roots]
        roots = state.roots_m + np.take(step, first[:, None] + np.arange(3), axis=1)
        return BoneState(roots, turn_bones(state.directions, tangents, step, shape.parents, shape.starts))


@compiled()
def directions_of(positions: Array, parents: Integers) -> Array:
    """Return the unit vector of each bone; up for roots and bones of length zero."""
    directions = np.empty(positions.shape)
    for t in range(positions.shape[0]):
        for point in range(positions.shape[1]):
            before = parents[point] if parents[point] >= 0 else point
            bone = subtract(row_of(positions[t], point), row_of(positions[t], before))
            size = length(bone)
            put_row(directions[t], point, divide(bone, size) if size > _TINY else (0.0, 1.0, 0.0))
    return directions


@compiled()
def place_along_bones(
    roots_m: Array, directions: Array, lengths: Array, parents: Integers, order: Integers, roots: Integers
) -> Array:
    """Return positions; each point is a bone's length from its parent."""
    positions = np.empty(directions.shape)
    for t in range(directions.shape[0]):
        for person in range(roots.shape[0]):
            for axis in range(3):
                positions[t, roots[person], axis] = roots_m[t, person, axis]
        for point in order:
            if parents[point] >= 0:
                for axis in range(3):
                    along = lengths[point] * directions[t, point, axis]
                    positions[t, point, axis] = positions[t, parents[point], axis] + along
    return positions


@compiled()
def tangents_of(directions: Array) -> Array:
    """Return two unit vectors square to each direction; the first is also square to x, or to y if x is too near."""
    tangents = np.empty((*directions.shape, 2))
    for t in range(directions.shape[0]):
        for point in range(directions.shape[1]):
            direction = row_of(directions[t], point)
            x, y, z = direction
            first = normalise((0.0, z, -y) if abs(x) < 0.9 else (-z, 0.0, x))
            second = cross(direction, first)
            for axis in range(3):
                tangents[t, point, axis, 0], tangents[t, point, axis, 1] = first[axis], second[axis]
    return tangents


@compiled()
def turn_bones(directions: Array, tangents: Array, step: Array, parents: Integers, starts: Integers) -> Array:
    """Return the directions of bones after a step along their tangents; those of roots stay."""
    turned = directions.copy()
    for t in range(directions.shape[0]):
        for point in range(directions.shape[1]):
            if parents[point] < 0:
                continue
            u, v = step[t, starts[point]], step[t, starts[point] + 1]
            for axis in range(3):
                moved = directions[t, point, axis] + tangents[t, point, axis, 0] * u + tangents[t, point, axis, 1] * v
                turned[t, point, axis] = moved
            put_row(turned[t], point, normalise(row_of(turned[t], point)))
    return turned
