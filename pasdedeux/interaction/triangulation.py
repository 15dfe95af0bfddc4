"""A fast planar Delaunay triangulation for the few dozen joints of a pair, as a numba kernel.

Incremental insertion (Bowyer 1981, Watson 1981) with triangles at infinity in place of an enclosing triangle, so the
hull is exact.  Points are first moved by a fixed jitter of at most 1e-7 m: coincident, collinear and cocircular points
then have one triangulation, always the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled, inner_kernel

Workspace = tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.int32]]

JITTER_M = 1e-7
"""Greatest displacement that breaks ties between degenerate points, metres; far below any annotation's noise."""


def jitter(num_points: int, dimension: int = 2) -> Array:
    """Return the fixed displacements (num_points, dimension), metres, that break ties between degenerate points.

    They depend on the point's index and axis alone: multiples of irrational numbers, wrapped to +-1e-7.
    """
    index = np.arange(1, num_points + 1, dtype=np.float64)[:, None]
    step = np.sqrt(np.array([2.0, 3.0, 5.0])[:dimension])
    return JITTER_M * (2.0 * np.mod(index * step + index**2 * step[::-1] * 0.5, 1.0) - 1.0)


def max_edges(num_points: int) -> int:
    """Return the greatest number of edges of a planar triangulation."""
    return max(3 * num_points - 6, num_points * (num_points - 1) // 2 if num_points < 4 else 0)


@compiled()
def workspace(num_points: int) -> Workspace:
    """Return scratch arrays for `triangulate`: triangles' vertices, their neighbours, and small stacks."""
    num_triangles = 2 * num_points + 8
    return (
        np.empty((num_triangles, 3), dtype=np.int32),
        np.empty((num_triangles, 3), dtype=np.int32),
        np.empty((5, num_triangles), dtype=np.int32),
    )


@compiled(inline="always")
def _orientation(x, y, a, b, px, py):  # type: ignore[no-untyped-def]
    """Twice the signed area of points a, b, p: positive when p lies left of a -> b."""
    return (x[b] - x[a]) * (py - y[a]) - (y[b] - y[a]) * (px - x[a])


@compiled(inline="always")
def _in_conflict(x, y, triangles, t, px, py, infinity):  # type: ignore[no-untyped-def]
    """Whether p lies in the circumcircle of triangle t; for a triangle at infinity, beyond its hull edge."""
    a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    if c == infinity:
        return _orientation(x, y, a, b, px, py) > 0.0
    ax, ay = x[a] - px, y[a] - py
    bx, by = x[b] - px, y[b] - py
    cx, cy = x[c] - px, y[c] - py
    determinant = (
        (ax * ax + ay * ay) * (bx * cy - cx * by)
        - (bx * bx + by * by) * (ax * cy - cx * ay)
        + (cx * cx + cy * cy) * (ax * by - bx * ay)
    )
    return determinant > 0.0


@inner_kernel()
def triangulate(x, y, triangles, neighbours, scratch, edges):  # type: ignore[no-untyped-def]
    """Write the Delaunay edges (i < j) of points `x`, `y` (already jittered) into `edges`; give their number.

    A point for which no conflicting triangle is found (an exact duplicate, or NaN) is skipped.
    Fewer than two points give no edge; two give one.
    """
    num_points = x.shape[0]
    infinity = num_points
    if num_points < 2:
        return 0
    if num_points == 2:
        edges[0, 0], edges[0, 1] = 0, 1
        return 1
    a, b, c = 0, 1, 2
    if _orientation(x, y, a, b, x[c], y[c]) < 0.0:
        b, c = 2, 1
    triangles[0, 0], triangles[0, 1], triangles[0, 2] = a, b, c
    triangles[1, 0], triangles[1, 1], triangles[1, 2] = b, a, infinity
    triangles[2, 0], triangles[2, 1], triangles[2, 2] = c, b, infinity
    triangles[3, 0], triangles[3, 1], triangles[3, 2] = a, c, infinity
    # neighbours[t, i] lies across the edge opposite vertex i
    neighbours[0, 0], neighbours[0, 1], neighbours[0, 2] = 2, 3, 1
    neighbours[1, 0], neighbours[1, 1], neighbours[1, 2] = 3, 2, 0
    neighbours[2, 0], neighbours[2, 1], neighbours[2, 2] = 1, 3, 0
    neighbours[3, 0], neighbours[3, 1], neighbours[3, 2] = 2, 1, 0
    num_triangles = 4
    cavity, stamp, new_at, border_edge, outer_of = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for t in range(stamp.shape[0]):
        stamp[t] = -1
    last = 0
    for p in range(3, num_points):
        px, py = x[p], y[p]
        # walk towards p; a triangle at infinity or one that holds p ends the walk
        t = last
        for _ in range(3 * num_triangles):
            u, v, w = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            if w == infinity:
                break
            if _orientation(x, y, u, v, px, py) < 0.0:
                t = neighbours[t, 2]
            elif _orientation(x, y, v, w, px, py) < 0.0:
                t = neighbours[t, 0]
            elif _orientation(x, y, w, u, px, py) < 0.0:
                t = neighbours[t, 1]
            else:
                break
        conflict = -1
        if _in_conflict(x, y, triangles, t, px, py, infinity):
            conflict = t
        else:
            for other in range(num_triangles):
                if _in_conflict(x, y, triangles, other, px, py, infinity):
                    conflict = other
                    break
        if conflict < 0:
            continue
        # the cavity: all connected triangles in conflict with p; stamp 2p marks them, 2p + 1 those tried and refused
        cavity[0] = conflict
        stamp[conflict] = 2 * p
        size = 1
        num_border = 0
        at = 0
        while at < size:
            t = cavity[at]
            at += 1
            for i in range(3):
                other = neighbours[t, i]
                if stamp[other] != 2 * p and stamp[other] != 2 * p + 1:
                    if _in_conflict(x, y, triangles, other, px, py, infinity):
                        stamp[other] = 2 * p
                        cavity[size] = other
                        size += 1
                    else:
                        stamp[other] = 2 * p + 1
                if stamp[other] == 2 * p + 1:
                    # read the vertices now, because triangles of the cavity are overwritten below
                    border_edge[num_border] = triangles[t, (i + 1) % 3] * (infinity + 1) + triangles[t, (i + 2) % 3]
                    outer_of[num_border] = other
                    num_border += 1
        for border in range(num_border):
            u, v = border_edge[border] // (infinity + 1), border_edge[border] % (infinity + 1)
            outer = outer_of[border]
            if border < size:
                t = cavity[border]
            else:
                t = num_triangles
                num_triangles += 1
            # (u, v, p) turned so that infinity comes last; `at` is where p stands
            if u == infinity:
                triangles[t, 0], triangles[t, 1], triangles[t, 2] = v, p, u
                at = 1
            elif v == infinity:
                triangles[t, 0], triangles[t, 1], triangles[t, 2] = p, u, v
                at = 0
            else:
                triangles[t, 0], triangles[t, 1], triangles[t, 2] = u, v, p
                at = 2
            neighbours[t, at] = outer
            stamp[t] = -1
            new_at[u] = 3 * t + at
            # the outer triangle's side v -> u, opposite its third vertex, now borders t
            if triangles[outer, 0] == v and triangles[outer, 1] == u:
                neighbours[outer, 2] = t
            elif triangles[outer, 1] == v and triangles[outer, 2] == u:
                neighbours[outer, 0] = t
            else:
                neighbours[outer, 1] = t
            last = t
        for border in range(num_border):
            u, v = border_edge[border] // (infinity + 1), border_edge[border] % (infinity + 1)
            t, at = new_at[u] // 3, new_at[u] % 3
            following, following_at = new_at[v] // 3, new_at[v] % 3
            neighbours[t, (at + 1) % 3] = following  # opposite u, across v -> p
            neighbours[following, (following_at + 2) % 3] = t  # opposite its own v, across p -> its u
    num_edges = 0
    for t in range(num_triangles):
        for i in range(3):
            u, v = triangles[t, i], triangles[t, (i + 1) % 3]
            if u < v and v != infinity:
                edges[num_edges, 0], edges[num_edges, 1] = u, v
                num_edges += 1
    return num_edges


@compiled()
def _edges_of_all(points, offsets, triangles, neighbours, scratch, edges, counts):  # type: ignore[no-untyped-def]
    x = np.empty(points.shape[1])
    y = np.empty(points.shape[1])
    seen = np.empty(points.shape[1], dtype=np.int32)
    for row in range(points.shape[0]):
        num_seen = 0
        for k in range(points.shape[1]):
            if np.isfinite(points[row, k, 0]) and np.isfinite(points[row, k, 1]):
                x[num_seen] = points[row, k, 0] + offsets[num_seen, 0]
                y[num_seen] = points[row, k, 1] + offsets[num_seen, 1]
                seen[num_seen] = k
                num_seen += 1
        counts[row] = triangulate(x[:num_seen], y[:num_seen], triangles, neighbours, scratch, edges[row])
        for e in range(counts[row]):
            edges[row, e, 0], edges[row, e, 1] = seen[edges[row, e, 0]], seen[edges[row, e, 1]]


def delaunay_edges_fast(points: Array) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return the Delaunay edges of many point sets (set, n, 2), metres; points that are not finite are skipped.

    Returns:
        Edges (set, max_edges, 2) with i < j in each pair, and the number of valid ones of each set (set,).
    """
    num_sets, num_points = points.shape[0], points.shape[1]
    edges = np.zeros((num_sets, max(max_edges(num_points), 1), 2), dtype=np.int32)
    counts = np.zeros(num_sets, dtype=np.int32)
    _edges_of_all(np.ascontiguousarray(points), jitter(num_points), *workspace(num_points), edges, counts)
    return edges, counts
