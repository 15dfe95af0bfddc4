"""Medoids of annotations: members of a set that stand for all of it, under the interaction dissimilarity d_I."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import BETA_M
from pasdedeux.interaction.kernels import edge_table, side_sum

__all__ = ["choose_medoids", "dissimilarity_matrix"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_MAX_ROUNDS = 30


def dissimilarity_matrix(points: Array, *, beta_m: float = BETA_M) -> Array:
    """Return d_I (eq. 8 of Yin et al. 2018), metres, between all planar point sets (set, n, 2): (set, set), symmetric.

    Raises:
        InputError: A coordinate is not finite.
    """
    table = edge_table(points, beta_m=beta_m)
    centred = np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))
    matrix = np.zeros((len(points), len(points)))
    _fill(centred, table.edges, table.weights, table.counts, matrix)
    return matrix


def choose_medoids(matrix: Array, count: int) -> Indices:
    """Return `count` members (count,) that stand for a set with these dissimilarities (set, set).

    Farthest-first from the member nearest to all others, then Voronoi iteration: everyone joins the nearest medoid, and
    each group takes the member nearest to the rest of it, until nothing changes.  No randomness; ties go to the lower
    index.

    Raises:
        InputError: `count` is not between 1 and the size of the set.
    """
    if not 1 <= count <= len(matrix):
        raise InputError(f"between 1 and {len(matrix)} medoids can be chosen, {count} were asked for")
    chosen = [int(np.argmin(matrix.sum(axis=1)))]
    while len(chosen) < count:
        distance = matrix[chosen].min(axis=0)
        distance[chosen] = -1.0
        chosen.append(int(np.argmax(distance)))
    medoids = np.array(chosen, dtype=np.int64)
    for _ in range(_MAX_ROUNDS):
        group = np.argmin(matrix[medoids], axis=0)
        group[medoids] = np.arange(count)
        moved = medoids.copy()
        for index in range(count):
            members = np.flatnonzero(group == index)
            moved[index] = members[np.argmin(matrix[np.ix_(members, members)].sum(axis=1))]
        if (moved == medoids).all():
            break
        medoids = moved
    return medoids


@numba.njit(cache=True, nogil=True)
def _fill(points, edges, weights, counts, matrix):  # type: ignore[no-untyped-def]
    num_sets, num_points = points.shape[0], points.shape[1]
    dx, dy = np.empty(num_points), np.empty(num_points)
    for a in range(num_sets):
        for b in range(a):
            dot = cross = 0.0
            for k in range(num_points):
                dot += points[a, k, 0] * points[b, k, 0] + points[a, k, 1] * points[b, k, 1]
                cross += points[a, k, 0] * points[b, k, 1] - points[a, k, 1] * points[b, k, 0]
            length = np.sqrt(dot * dot + cross * cross)
            cosine, sine = 1.0, 0.0
            if length > 1e-300:
                cosine, sine = dot / length, cross / length
            for k in range(num_points):
                x, y = points[a, k, 0], points[a, k, 1]
                dx[k] = cosine * x - sine * y - points[b, k, 0]
                dy[k] = sine * x + cosine * y - points[b, k, 1]
            total = side_sum(dx, dy, edges[b], counts[b], weights[b])
            # The edges of `a` are turned with it, which does not change their length.
            total += side_sum(dx, dy, edges[a], counts[a], weights[a])
            matrix[a, b] = total
            matrix[b, a] = total
