"""The interaction mesh: Delaunay tetrahedra over all people's joints, and its Laplacian (Ho, Komura and Tai 2010)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.augmentation.source import Source, points_of
from pasdedeux.interaction.contacts import averaged
from pasdedeux.interaction.graph import simplex_neighbours
from pasdedeux.skeletons import BODY22

_SMALLEST_SQUARED_DISTANCE_M2 = 1e-4
"""Edges shorter than 1 cm weigh no more than one of 1 cm."""
_JOGGLE_M = 1e-6
"""Size of the fixed displacement that lifts coplanar or duplicate joints off each other."""


@dataclass(frozen=True)
class InteractionMesh:
    """Row-normalised edge weights of every source frame.

    Args:
        weights: W (frame, n, n); row i holds the weights of joint i's neighbours, they sum to 1.
    """

    weights: Array

    @cached_property
    def laplacian(self) -> Array:
        """L = I - W (frame, n, n)."""
        return np.asarray(np.eye(self.weights.shape[-1]) - self.weights)

    @cached_property
    def cross_laplacian(self) -> Array:
        """The part of L over edges between people (frame, n, n); its rows sum to 0."""
        person = np.arange(self.weights.shape[-1]) // BODY22.num_joints
        cross = np.where(person[:, None] == person, 0.0, self.weights)
        return np.asarray(np.eye(len(person)) * cross.sum(axis=-1)[:, None, :] - cross)


def tetrahedron_neighbours(points: Array) -> Flags:
    """Return which of the points (n, 3) share a Delaunay tetrahedron (n, n).

    Points that lie in a plane have no tetrahedra, and of points that coincide all but one are dropped; such sets are
    meshed again after a fixed pseudo-random displacement of a micrometre.
    """
    from scipy.spatial import Delaunay, QhullError  # here: planning need not wait for it

    try:
        mesh = Delaunay(points)
        if len(mesh.coplanar) == 0:
            return simplex_neighbours(mesh.simplices, len(points))
    except QhullError:
        pass
    joggle = np.random.default_rng(len(points)).uniform(-_JOGGLE_M, _JOGGLE_M, points.shape)
    spread = points - points.mean(axis=0) + joggle
    return simplex_neighbours(Delaunay(spread, qhull_options="QJ Pp").simplices, len(points))


def build_mesh(source: Source, *, smoothing_s: float = 0.0) -> InteractionMesh:
    """Mesh every frame of the source.

    Weights are 1/d^2 with d^2 >= 1e-4 m^2, normalised per joint.  The bones are always edges, so no joint is isolated.
    With `smoothing_s` the weights are averaged over time by a Gaussian of that standard deviation: Delaunay edges come
    and go from frame to frame, and an edge that appears at full weight makes the motion jump.  The published method
    takes each frame alone (`smoothing_s` 0).
    """
    points = points_of(source.positions_m)
    is_bone = np.zeros((source.num_points, source.num_points), dtype=bool)
    for parent, child in BODY22.bones:
        for offset in range(0, source.num_points, BODY22.num_joints):
            is_bone[parent + offset, child + offset] = is_bone[child + offset, parent + offset] = True
    squared = ((points[:, :, None] - points[:, None]) ** 2).sum(axis=-1)
    weights = 1.0 / np.maximum(squared, _SMALLEST_SQUARED_DISTANCE_M2)
    for frame in range(len(points)):
        weights[frame] *= tetrahedron_neighbours(points[frame]) | is_bone
    weights /= weights.sum(axis=-1, keepdims=True)
    if smoothing_s > 0:
        weights = averaged(weights, smoothing_s * source.rate_hz)
    return InteractionMesh(weights)
