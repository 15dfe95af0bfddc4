"""Medoids of annotations: members of a set that stand for all of it, under the interaction dissimilarity d_I."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.interaction.kernels import edge_table, keep_seen_edges, side_sum

Indices = npt.NDArray[np.int64]

_MAX_ROUNDS = 30


def dissimilarity_matrix(points: Array) -> Array:
    """Return d_I (eq. 8 of Yin et al. 2018), metres, between all planar point sets (set, n, 2): (set, set), symmetric.

    Points that are NaN are not seen.  Sets that share no edge are as far apart as any two sets are.
    """
    table = edge_table(points)
    is_seen = np.isfinite(points).all(axis=-1)
    matrix = np.zeros((len(points), len(points)))
    _fill(np.ascontiguousarray(points), is_seen, table.edges, table.weights, table.counts, matrix)
    return np.where(np.isfinite(matrix), matrix, matrix[np.isfinite(matrix)].max(initial=0.0))


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


@compiled()
def _fill(points, is_seen, edges, weights, counts, matrix):  # type: ignore[no-untyped-def]
    num_sets, num_points = points.shape[0], points.shape[1]
    dx, dy = np.empty(num_points), np.empty(num_points)
    is_shared = np.empty(num_points, dtype=np.bool_)
    kept, kept_weights = np.empty_like(edges[0]), np.empty_like(weights[0])
    for a in range(num_sets):
        for b in range(a):
            ax = ay = bx = by = 0.0
            number = 0
            for k in range(num_points):
                is_shared[k] = is_seen[a, k] and is_seen[b, k]
                if is_shared[k]:
                    ax += points[a, k, 0]
                    ay += points[a, k, 1]
                    bx += points[b, k, 0]
                    by += points[b, k, 1]
                    number += 1
            divisor = max(number, 1)
            ax, ay, bx, by = ax / divisor, ay / divisor, bx / divisor, by / divisor
            dot = cross = 0.0
            for k in range(num_points):
                if is_shared[k]:
                    px, py, qx, qy = (
                        points[a, k, 0] - ax,
                        points[a, k, 1] - ay,
                        points[b, k, 0] - bx,
                        points[b, k, 1] - by,
                    )
                    dot += px * qx + py * qy
                    cross += px * qy - py * qx
            length = np.sqrt(dot * dot + cross * cross)
            cosine, sine = 1.0, 0.0
            if length > 1e-300:
                cosine, sine = dot / length, cross / length
            for k in range(num_points):
                x, y = points[a, k, 0], points[a, k, 1]
                dx[k] = cosine * x - sine * y - points[b, k, 0]
                dy[k] = sine * x + cosine * y - points[b, k, 1]
            # The edges of `a` are turned with it, which does not change their length.
            total, num_kept = 0.0, 0
            for own in (a, b):
                count = keep_seen_edges(edges[own], counts[own], weights[own], is_shared, kept, kept_weights)
                total += side_sum(dx, dy, kept, count, kept_weights)
                num_kept += count
            matrix[a, b] = matrix[b, a] = total if num_kept else np.inf
