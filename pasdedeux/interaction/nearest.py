"""D_I and D_C between many pairs: running minima over draws, and whole tables of distances.

D_I in 3D sums over about 300 edges of two pairs.  An estimate in single precision over all pairs of joints (most have
weight 0), which needs no gathers, decides whether a draw may be nearer than the nearest so far; only then is the exact
sum computed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import BETA_M
from pasdedeux.interaction.kernels import best_turn, edge_table_3d, turned_gap
from pasdedeux.interaction.triangulation import delaunay_edges_fast

_LANES = 8
_REORDERED = {"reassoc", "contract", "nsz"}
_ESTIMATE_SLACK = 1e-4
"""Relative error allowed for the estimate; over 600 terms single precision makes 1e-5 at worst."""


class PairTable(NamedTuple):
    """Pairs prepared for comparison.

    Args:
        points: Centred joints of both people (pair, n, 3), metres.
        edges: Edges of their Delaunay tetrahedra, see `EdgeTable`.
        weights: Their weights (eq. 8).
        counts: The numbers of edges.
        ring: The same weights by distance on a ring: of joints k and k + g + 1 (mod n) at (pair, g, k).
    """

    points: Array
    edges: npt.NDArray[np.int32]
    weights: Array
    counts: npt.NDArray[np.int32]
    ring: npt.NDArray[np.float32]


def pair_table(pairs_m: Array) -> PairTable:
    """Prepare pairs (pair, person=2, joint, 3), metres, for comparison.

    Raises:
        InputError: A coordinate is not finite.
    """
    points = _centred(pairs_m)
    table = edge_table_3d(points)
    num_points = points.shape[1]
    width = -(-num_points // _LANES) * _LANES
    ring = np.zeros((len(points), num_points // 2, width), dtype=np.float32)
    _fill_ring(table.edges, table.weights, table.counts, num_points, ring)
    return PairTable(points, table.edges, table.weights, table.counts, ring)


def _centred(pairs_m: Array) -> Array:
    """Return the joints of both people (pair, n, 3) about their mean."""
    points = np.asarray(pairs_m, dtype=np.float64)
    points = merge_axes(points, 1, -1)
    return np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))


class Coverage:
    """Smallest D_I and D_C of real pairs to draws that arrive in batches: memory does not grow with their number.

    Args:
        real_m: Real pairs (real, person=2, joint, 3), metres; at least one.

    Raises:
        InputError: There is no real pair, or a coordinate is not finite.
    """

    def __init__(self, real_m: Array) -> None:
        if len(real_m) == 0:
            raise InputError("coverage needs at least one real pair")
        self._real = pair_table(real_m)
        self._best = np.full((2, len(real_m)), np.inf)

    def add(self, draws: PairTable) -> None:
        """Take more draws into account."""
        _lower_minima(self._real, draws, self._best)

    @property
    def interaction_m(self) -> Array:
        """Smallest D_I of each real pair to any draw so far, (real,), metres; inf before the first."""
        return self._best[0].copy()

    @property
    def cartesian_m(self) -> Array:
        """Smallest D_C of each real pair to any draw so far, (real,), metres; inf before the first."""
        return self._best[1].copy()


def interaction_distances(first_m: Array | PairTable, second_m: Array | PairTable) -> Array:
    """Return D_I (n, m), metres, between pairs (n, person, joint, 3) and (m, person, joint, 3), metres.

    Pairs that are compared repeatedly can be prepared by `pair_table`.

    Raises:
        InputError: A coordinate is not finite.
    """
    first, second = (pairs if isinstance(pairs, PairTable) else pair_table(pairs) for pairs in (first_m, second_m))
    distances = np.empty((len(first.points), len(second.points)))
    _fill_distances(first, second, distances)
    return distances


def cartesian_distances(first_m: Array, second_m: Array) -> Array:
    """Return D_C (n, m), metres, between pairs (n, person=2, joint, 3) and (m, person=2, joint, 3), metres.

    Raises:
        InputError: A coordinate is not finite.
    """
    first, second = _centred(first_m), _centred(second_m)
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InputError("distances between pairs need finite joints, found one that is not")
    distances = np.empty((len(first), len(second)))
    _fill_cartesian(first, second, distances)
    return distances


def image_distances(first_m: Array, second_m: Array) -> Array:
    """Return d_I (n, m), metres, between images (n, person=2, joint, 2) and (m, person=2, joint, 2), metres.

    As `interaction_dissimilarity`: a joint may be missing (NaN).  NaN where two images share fewer than two joints.
    """
    shape = (-1, first_m.shape[1] * first_m.shape[2], 2)
    first, second = (np.ascontiguousarray(images, dtype=np.float64).reshape(shape) for images in (first_m, second_m))
    distances = np.empty((len(first), len(second)))
    _fill_image_distances(first, *delaunay_edges_fast(first), second, *delaunay_edges_fast(second), distances)
    return distances


@compiled()
def _fill_image_distances(  # type: ignore[no-untyped-def]
    first, first_edges, first_counts, second, edges, counts, distances
):
    dx, dy = np.empty(first.shape[1]), np.empty(first.shape[1])
    is_shared = np.empty(first.shape[1], dtype=np.bool_)
    for row in range(first.shape[0]):
        for column in range(second.shape[0]):
            distances[row, column] = np.nan
            if _plane_gaps(first[row], second[column], is_shared, dx, dy) >= 2:
                total = _shared_side(first[row], first_edges[row], first_counts[row], is_shared, dx, dy)
                total += _shared_side(second[column], edges[column], counts[column], is_shared, dx, dy)
                distances[row, column] = total


@inner_kernel()
def _shared_side(points, edges, count, is_shared, dx, dy):  # type: ignore[no-untyped-def]
    """Return one side of eq. 8 over the edges of which both ends are shared."""
    total, weights = 0.0, 1e-300
    for e in range(count):
        i, j = edges[e, 0], edges[e, 1]
        if is_shared[i] and is_shared[j]:
            length = np.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
            weight = 1.0 / max(BETA_M, length)
            total += weight * np.hypot(dx[j] - dx[i], dy[j] - dy[i])
            weights += weight
    return total / weights


@inner_kernel()
def _plane_gaps(moving, fixed, is_shared, dx, dy):  # type: ignore[no-untyped-def]
    """Write the differences of points turned and shifted onto others, where both are seen; return their number."""
    count = 0
    sums = np.zeros(4)
    for k in range(moving.shape[0]):
        is_shared[k] = np.isfinite(moving[k, 0]) and np.isfinite(fixed[k, 0])
        if is_shared[k]:
            count += 1
            for axis in range(2):
                sums[axis] += moving[k, axis]
                sums[2 + axis] += fixed[k, axis]
    sums /= max(count, 1)
    a = b = 0.0
    for k in range(moving.shape[0]):
        if is_shared[k]:
            x, y = moving[k, 0] - sums[0], moving[k, 1] - sums[1]
            u, v = fixed[k, 0] - sums[2], fixed[k, 1] - sums[3]
            a += x * u + y * v
            b += x * v - y * u
    length = np.hypot(a, b)
    cosine, sine = (a / length, b / length) if length > 1e-300 else (1.0, 0.0)
    for k in range(moving.shape[0]):
        x, y = moving[k, 0] - sums[0], moving[k, 1] - sums[1]
        dx[k] = cosine * x - sine * y - (fixed[k, 0] - sums[2])
        dy[k] = sine * x + cosine * y - (fixed[k, 1] - sums[3])
    return count


@compiled()
def _fill_ring(edges, weights, counts, num_points, ring):  # type: ignore[no-untyped-def]
    for row in range(edges.shape[0]):
        for e in range(counts[row]):
            i, j = edges[row, e, 0], edges[row, e, 1]
            gap = (j - i) % num_points
            if gap > num_points // 2:
                i, gap = j, num_points - gap
            ring[row, gap - 1, i] += weights[row, e]


@compiled()
def _lower_minima(real, others, best):  # type: ignore[no-untyped-def]
    """Lower the running minima (2, real) of D_I and D_C to those of others."""
    num_points = real.points.shape[1]
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    difference = np.empty((num_points, 3))
    size = real.ring.shape[1] + real.ring.shape[2]
    x, y, z = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    for row in range(real.points.shape[0]):
        for column in range(others.points.shape[0]):
            total = _aligned(real.points[row], others.points[column], key, m, q, rotmat, difference) / num_points
            best[1, row] = min(best[1, row], total)
            for k in range(size):
                at = k % num_points
                x[k], y[k], z[k] = difference[at, 0], difference[at, 1], difference[at, 2]
            if _estimate(x, y, z, real.ring[row], others.ring[column]) * (1.0 - _ESTIMATE_SLACK) < best[0, row]:
                total = _side_sum(difference, real, row) + _side_sum(difference, others, column)
                best[0, row] = min(best[0, row], total)


@compiled()
def _fill_distances(first, second, distances):  # type: ignore[no-untyped-def]
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    difference = np.empty((first.points.shape[1], 3))
    for row in range(first.points.shape[0]):
        for column in range(second.points.shape[0]):
            _aligned(first.points[row], second.points[column], key, m, q, rotmat, difference)
            distances[row, column] = _side_sum(difference, first, row) + _side_sum(difference, second, column)


@compiled()
def _fill_cartesian(first, second, distances):  # type: ignore[no-untyped-def]
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    difference = np.empty(first.shape[1:])
    for row in range(first.shape[0]):
        for column in range(second.shape[0]):
            total = _aligned(first[row], second[column], key, m, q, rotmat, difference)
            distances[row, column] = total / first.shape[1]


@inner_kernel()
def _aligned(fixed, moving, key, m, q, rotmat, difference):  # type: ignore[no-untyped-def]
    """Write the difference of one pair (n, 3), turned onto another, to it; return the sum of its lengths."""
    best_turn(moving, fixed, key, m, q, rotmat)
    total = 0.0
    for k in range(moving.shape[0]):
        u, v, w = turned_gap(rotmat, moving, fixed, k)
        difference[k, 0], difference[k, 1], difference[k, 2] = u, v, w
        total += np.sqrt(u * u + v * v + w * w)
    return total


@inner_kernel(fastmath=_REORDERED)
def _estimate(x, y, z, one, other):  # type: ignore[no-untyped-def]
    """Estimate both sides of D_I from the differences of aligned points, repeated beyond the last, and two rings."""
    total = np.float32(0.0)
    width = one.shape[1]
    for gap in range(one.shape[0]):
        first, second = one[gap], other[gap]
        start, stop = gap + 1, gap + 1 + width
        u, v, w = x[start:stop], y[start:stop], z[start:stop]
        for k in range(width):
            p, q, r = u[k] - x[k], v[k] - y[k], w[k] - z[k]
            total += (first[k] + second[k]) * np.sqrt(p * p + q * q + r * r)
    return total


@inner_kernel()
def _side_sum(difference, table, row):  # type: ignore[no-untyped-def]
    """Return the side of D_I over the edges of one pair of a table."""
    edges, weights, total = table.edges[row], table.weights[row], 0.0
    for e in range(table.counts[row]):
        i, j = edges[e, 0], edges[e, 1]
        u = difference[j, 0] - difference[i, 0]
        v = difference[j, 1] - difference[i, 1]
        w = difference[j, 2] - difference[i, 2]
        total += weights[e] * np.sqrt(u * u + v * v + w * w)
    return total
