"""Graphs over the joints of a pair: which joints' differences are interaction coordinates.

Delaunay is the published choice (Yin et al. 2018, section 4.3); the others are those the paper names as worth trying.
All are plain forms over one point set; the fast Delaunay kernel is in `triangulation`.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial import Delaunay, QhullError

from pasdedeux.errors import InputError
from pasdedeux.interaction.triangulation import jitter

__all__ = [
    "Edges",
    "Graph",
    "delaunay_edges",
    "gabriel_edges",
    "graph_edges",
    "minimum_weight_edges",
    "nearest_edges",
]

Array = npt.NDArray[np.float64]
Edges = npt.NDArray[np.int32]

_MOST_POINTS = 1 << 31
DEFAULT_NUM_NEAREST = 5
"""Neighbours of each joint in the k-nearest graph; gives about as many edges as Delaunay for 34 joints."""


class Graph(StrEnum):
    """The graphs that interaction coordinates can be taken over."""

    DELAUNAY = "delaunay"
    NEAREST = "nearest"
    GABRIEL = "gabriel"
    MINIMUM_WEIGHT = "minimum_weight"


def graph_edges(points: Array, graph: Graph = Graph.DELAUNAY, *, num_nearest: int = DEFAULT_NUM_NEAREST) -> Edges:
    """Return the edges (edge, 2), i < j, sorted, of a graph over points (n, 2) or (n, 3), metres."""
    if graph is Graph.DELAUNAY:
        return delaunay_edges(points)
    if graph is Graph.NEAREST:
        return nearest_edges(points, num_nearest=num_nearest)
    if graph is Graph.GABRIEL:
        return gabriel_edges(points)
    return minimum_weight_edges(points)


def delaunay_edges(points: Array) -> Edges:
    """Return the Delaunay edges of points (n, 2), or the edges of the Delaunay tetrahedra of points (n, 3), metres.

    Points are moved by a fixed jitter of at most 1e-7 m first, so coincident, collinear and cocircular points have one
    answer.  Fewer points than a simplex needs are all joined.

    Raises:
        InputError: A coordinate is not finite.
    """
    _check(points)
    num_points, dimension = points.shape
    if num_points <= dimension:
        return _all_edges(num_points)
    try:
        simplices = Delaunay(points + jitter(num_points, dimension)).simplices
    except QhullError:
        # Flat even after the jitter, by Qhull's own tolerance: let Qhull joggle (its QJ option is deterministic).
        simplices = Delaunay(points + jitter(num_points, dimension), qhull_options="QJ Qbb Qc").simplices
    columns = [simplices[:, [i, j]] for i in range(dimension + 1) for j in range(i)]
    return _sorted_edges(np.concatenate(columns))


def nearest_edges(points: Array, *, num_nearest: int = DEFAULT_NUM_NEAREST) -> Edges:
    """Return edges from each of the points (n, d) to its `num_nearest` nearest others; ties go to the lower index."""
    _check(points)
    distance = _distances(points)
    np.fill_diagonal(distance, np.inf)
    count = min(num_nearest, len(points) - 1)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, : max(count, 0)]
    own = np.repeat(np.arange(len(points)), nearest.shape[1])
    return _sorted_edges(np.stack([own, nearest.ravel()], axis=1))


def gabriel_edges(points: Array) -> Edges:
    """Return the pairs of points (n, d) whose diametral sphere holds no other point (Gabriel and Sokal 1969).

    A point on the sphere does not count as inside, so coincident points are joined.
    """
    _check(points)
    squared = _distances(points) ** 2
    # Thales: k is inside the sphere over i, j exactly when the angle at k is obtuse.
    slack = 1e-12 * max(float(squared.max(initial=0.0)), 1e-300)
    is_blocked = (squared[:, None, :] + squared[None, :, :] < squared[:, :, None] - slack).any(axis=-1)
    first, second = np.nonzero(np.triu(~is_blocked, k=1))
    return _sorted_edges(np.stack([first, second], axis=1))


def minimum_weight_edges(points: Array) -> Edges:
    """Return the greedy approximation of the minimum-weight triangulation of points (n, 2), metres.

    The exact one is NP-hard (Mulzer and Rote 2008); greedily adding the shortest edge that crosses no earlier one is
    the usual stand-in.  Edges over 3D points are not defined.

    Raises:
        InputError: The points are not planar coordinates.
    """
    _check(points)
    if points.shape[1] != 2:
        raise InputError(f"a minimum-weight triangulation needs planar points, found {points.shape[1]} dimensions")
    moved = points + jitter(len(points))
    first, second = np.triu_indices(len(points), k=1)
    order = np.argsort(np.linalg.norm(moved[first] - moved[second], axis=1), kind="stable")
    chosen: list[tuple[int, int]] = []
    for index in order:
        i, j = int(first[index]), int(second[index])
        if chosen and _crosses_any(moved, i, j, np.array(chosen)):
            continue
        chosen.append((i, j))
    return _sorted_edges(np.array(chosen, dtype=np.int64).reshape(-1, 2))


def _crosses_any(points: Array, i: int, j: int, edges: npt.NDArray[np.int64]) -> bool:
    a, b = points[i], points[j]
    c, d = points[edges[:, 0]], points[edges[:, 1]]
    is_apart = ~((edges == i) | (edges == j)).any(axis=1)

    def side(start: Array, end: Array, point: Array) -> Array:
        along, across = end - start, point - start
        return np.sign(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])

    crosses = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return bool((crosses & is_apart).any())


def _distances(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points[:, None, :] - points[None, :, :], axis=-1))


def _all_edges(num_points: int) -> Edges:
    return np.stack(np.triu_indices(num_points, k=1), axis=1).astype(np.int32)


def _sorted_edges(pairs: npt.NDArray[np.integer]) -> Edges:
    # An edge as one number sorts alike, and numpy's unique rows cost many times as much.
    ordered = np.sort(pairs.astype(np.int64), axis=1)
    keys = np.unique(ordered[:, 0] * _MOST_POINTS + ordered[:, 1])
    return np.stack(np.divmod(keys, _MOST_POINTS), axis=1).astype(np.int32)


def _check(points: Array) -> None:
    if not np.isfinite(points).all():
        joint = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise InputError(f"point {joint} is not finite: a graph over joints needs all of them")
