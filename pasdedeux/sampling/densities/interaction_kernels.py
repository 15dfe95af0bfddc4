"""Compiled inner loops of the likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.interaction.kernels import fill_edge_weights, keep_seen_edges, side_sum
from pasdedeux.interaction.triangulation import triangulate, workspace
from pasdedeux.sampling.densities.interaction_estimates import estimate_dissimilarities

ESTIMATE_TOLERANCE_M = 1e-3
"""Rounding error of an estimate of d_I, metres: it is the root of a small difference of large numbers."""

_ROUGH_TOLERANCE_M = 2e-5
"""Allowed error of the rough comparison in float32, metres; for people within a few metres it is 1e-6."""


MIN_RATIO, MIN_OWN_RATIO = 0.6, 0.52
"""d_I is taken to be at least so many times its estimate, and the side of eq. 8 over the pair's own edges so many times
half of it: candidates for which that is too much are skipped.  Over 7,691 evaluations (random pairs among 8,000
annotations; salsa frames and pairs round them, among 600 and 8,000) not one result differed in a bit from that of
comparing all; with 0.65 and 0.58 two did."""


class BankTables(NamedTuple):
    """A bank of m views and the annotations that some view meets, as the kernels take them.

    Args:
        directions: Views (m, 3) in the pair's local frame.
        counts: Candidates of each view, (m,).
        slots: Annotation of each candidate, (m, most).
        springs: Quadratic forms of each view, one for the edges within each person and one for those between them,
            (m, kind=3, n, n), float32; the roots of their values at a difference of images make up the estimate.
        unit: Unit of the candidates' points, float32, metres.
        rank_x: x of the candidates' centred points, (m, n, most), int16.
        rank_y: y of them.
        rank_squares: The quadratic forms' values at them, (m, kind=3, most), float32, square metres.
        factors: Factor of each root in the estimate, (m, kind=3, most), float32.
        points: Centred annotations (annotation, n, 2), metres; 0 where a joint is not seen.
        edges: Their Delaunay edges, between joints that are seen.
        weights: Their weights, summing to 1.
        num_edges: Their numbers of edges.
        rough_points: The centred annotations (annotation, 2, n), float32, metres.
        rough_starts: First joints of the edges, (annotation, edge), uint8.
        rough_ends: Second joints of them.
        rough_weights: The weights, float32.
        is_seen: Which joints of the annotations are seen, (annotation, n).
        is_whole: Whether all of them are, (annotation,).
        has_partial: Whether there is an annotation that is not whole.
        offsets: Jitter of the triangulation, (n, 2), metres.
        scale: 2 sigma_l^2, metres.
        is_every: Whether the logs of all views are averaged, not their likelihoods.
    """

    directions: np.ndarray
    counts: np.ndarray
    slots: np.ndarray
    springs: np.ndarray
    unit: np.float32
    rank_x: np.ndarray
    rank_y: np.ndarray
    rank_squares: np.ndarray
    factors: np.ndarray
    points: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    num_edges: np.ndarray
    rough_points: np.ndarray
    rough_starts: np.ndarray
    rough_ends: np.ndarray
    rough_weights: np.ndarray
    is_seen: np.ndarray
    is_whole: np.ndarray
    has_partial: bool
    offsets: np.ndarray
    scale: float
    is_every: bool


class _EdgeBuffer(NamedTuple):
    """Room for one side of eq. 8: edges (n, 2) and weights (n,), and both narrowed for the rough comparison."""

    edges: np.ndarray
    weights: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    rough_weights: np.ndarray


@inner_kernel()
def _empty_side(count):  # type: ignore[no-untyped-def]
    starts, ends = np.empty(count, dtype=np.uint8), np.empty(count, dtype=np.uint8)
    return _EdgeBuffer(
        np.empty((count, 2), dtype=np.int32), np.empty(count), starts, ends, np.empty(count, dtype=np.float32)
    )


@compiled()
def _narrow(side, count):  # type: ignore[no-untyped-def]
    for e in range(count):
        side.starts[e], side.ends[e], side.rough_weights[e] = side.edges[e, 0], side.edges[e, 1], side.weights[e]


@inner_kernel(fastmath={"contract", "reassoc"})
def _rough_side(dx, dy, starts, ends, count, weights, squares):  # type: ignore[no-untyped-def]
    """Return one side of eq. 8, float32: `dx`, `dy` are the differences of the turned pair from an annotation."""
    for e in range(count):
        i, j = starts[e], ends[e]
        u, v = dx[j] - dx[i], dy[j] - dy[i]
        squares[e] = u * u + v * v
    total = np.float32(0.0)
    for e in range(count):
        total += weights[e] * np.sqrt(squares[e])
    return total


@inner_kernel()
def _choose(estimate, count, but, ceiling, chosen):  # type: ignore[no-untyped-def]
    """Write the candidates, but for one, whose estimate is at most the ceiling; give their number."""
    number = 0
    for c in range(count):
        # Always written, kept if wanted: this avoids mispredicted branches.
        chosen[number] = c
        number += estimate[c] <= ceiling and c != but
    return number


@inner_kernel()
def _touch(slots, chosen, num_chosen, points, starts, ends, weights):  # type: ignore[no-untyped-def]
    """Read from every cache line needed to compare these candidates, so that they are loaded together."""
    total = np.float32(0.0)
    for c in chosen[:num_chosen]:
        slot = slots[c]
        for k in range(0, points.shape[2], 16):
            total += points[slot, 0, k] + points[slot, 1, k]
        for e in range(0, starts.shape[1], 64):
            total += np.float32(starts[slot, e] + ends[slot, e])
        for e in range(0, weights.shape[1], 16):
            total += weights[slot, e]
    return total


@compiled()
def _exact(x, y, fixed, edges, num_edges, weights, own_edges, own_count, own_weights, dx, dy):  # type: ignore[no-untyped-def]
    """Return d_I (eq. 8) of a centred image and a centred annotation; `dx`, `dy` (n,) are scratch."""
    dot = cross = 0.0
    for k in range(x.shape[0]):
        dot += x[k] * fixed[k, 0] + y[k] * fixed[k, 1]
        cross += x[k] * fixed[k, 1] - y[k] * fixed[k, 0]
    length = np.sqrt(dot * dot + cross * cross)
    cosine, sine = 1.0, 0.0
    if length > 1e-300:
        cosine, sine = dot / length, cross / length
    for k in range(x.shape[0]):
        dx[k] = cosine * x[k] - sine * y[k] - fixed[k, 0]
        dy[k] = sine * x[k] + cosine * y[k] - fixed[k, 1]
    return side_sum(dx, dy, own_edges, own_count, own_weights) + side_sum(dx, dy, edges, num_edges, weights)


@compiled()
def best_per_view(points, bank, limit, margin, best, best_slot):  # type: ignore[no-untyped-def]
    """Write the least d_I of each view that can matter, and return the log of eq. 6.

    Every candidate's d_I is estimated from springs between the joints; views are taken in the order of their least
    estimate, so the best view mostly comes first and bounds the others.  A candidate whose estimate
    leaves a chance is compared over the annotation's edges, then over the pair's own, both in float32; only one that
    may be the best by that is compared in float64.  A view is triangulated when the first of its candidates needs it.

    Args:
        points: Joints of both people, (n, 3), metres.
        bank: Tables of the bank.
        limit: d_I above which nothing matters unless a better one is found, metres; where all views are averaged, the
            sum of their least d_I above which nothing matters.
        margin: How far behind the best view another still matters, metres; where all are averaged they all do.
        best: Result (m,), metres: least d_I, inf where it is beyond what matters.
        best_slot: Annotation that reached it, (m,); -1 where none did.

    Returns:
        Log of the mean over the views of exp(-d_I / scale), or the mean of its logs, -inf when nothing mattered; and a
        number without meaning, which keeps reads ahead from being optimised away.
    """
    num_points, num_views, most = points.shape[0], bank.directions.shape[0], bank.slots.shape[1]
    slots, candidate_counts, offsets = bank.slots, bank.counts, bank.offsets
    annotations, edges_of, weights_of, num_edges_of = bank.points, bank.edges, bank.weights, bank.num_edges
    rough_points, rough_starts = bank.rough_points, bank.rough_starts
    rough_ends, rough_weights = bank.rough_ends, bank.rough_weights
    scale = bank.scale
    xs, ys = np.empty((num_views, num_points)), np.empty((num_views, num_points))
    jx, jy = np.empty(num_points), np.empty(num_points)
    dx, dy = np.empty(num_points), np.empty(num_points)
    turn = np.empty((num_views, 2, most), dtype=np.float32)
    estimate = np.empty((num_views, most), dtype=np.float32)
    least, first = np.empty(num_views), np.empty(num_views, dtype=np.int64)
    dx32, dy32 = np.empty(num_points, dtype=np.float32), np.empty(num_points, dtype=np.float32)
    squares32 = np.empty(3 * num_points, dtype=np.float32)
    triangles, neighbours, scratch = workspace(num_points)
    whole, part = _empty_side(3 * num_points), _empty_side(3 * num_points)
    chosen = np.empty(most, dtype=np.int32)
    touched = np.float32(0.0)
    for view in range(num_views):
        best[view] = np.inf
        best_slot[view] = -1
    estimate_dissimilarities(points, bank, xs, ys, turn, estimate, least, first)
    overall = limit
    # Least contribution to the sum of the views not yet searched, and that of the searched ones.
    rest_m, sum_m = 0.0, 0.0
    if bank.is_every:
        for view in range(num_views):
            rest_m += max(MIN_RATIO * least[view] - ESTIMATE_TOLERANCE_M, 0.0) if first[view] >= 0 else 0.0
    for view in np.argsort(least):
        matters = overall + margin
        if bank.is_every:
            rest_m -= max(MIN_RATIO * least[view] - ESTIMATE_TOLERANCE_M, 0.0) if first[view] >= 0 else 0.0
            matters = limit - sum_m - rest_m + ESTIMATE_TOLERANCE_M
        if first[view] < 0 or MIN_RATIO * least[view] > matters + ESTIMATE_TOLERANCE_M:
            # Views after this one are estimated to be farther.
            break
        x, y = xs[view], ys[view]
        num_edges = -1
        bound = matters
        for is_rest in range(2):
            # The candidate with the least estimate goes first: it is mostly the best, and bounds the rest.
            if is_rest:
                ceiling = (bound + ESTIMATE_TOLERANCE_M) / MIN_RATIO
                num_chosen = _choose(estimate[view], candidate_counts[view], first[view], np.float32(ceiling), chosen)
                touched += _touch(
                    slots[view], chosen, num_chosen, rough_points, rough_starts, rough_ends, rough_weights
                )
            else:
                chosen[0] = first[view]
                num_chosen = 1
            for c in chosen[:num_chosen]:
                if MIN_RATIO * estimate[view, c] > bound + ESTIMATE_TOLERANCE_M:
                    continue
                slot = slots[view, c]
                cosine, sine = turn[view, 0, c], turn[view, 1, c]
                for k in range(num_points):
                    px, py = np.float32(x[k]), np.float32(y[k])
                    dx32[k] = cosine * px - sine * py - rough_points[slot, 0, k]
                    dy32[k] = sine * px + cosine * py - rough_points[slot, 1, k]
                starts, ends, rest = rough_starts[slot], rough_ends[slot], rough_weights[slot]
                rough = _rough_side(dx32, dy32, starts, ends, num_edges_of[slot], rest, squares32)
                if rough + 0.5 * MIN_OWN_RATIO * estimate[view, c] > bound + ESTIMATE_TOLERANCE_M:
                    continue
                if num_edges < 0:
                    for k in range(num_points):
                        jx[k] = x[k] + offsets[k, 0]
                        jy[k] = y[k] + offsets[k, 1]
                    num_edges = triangulate(jx, jy, triangles, neighbours, scratch, whole.edges)
                    fill_edge_weights(x, y, whole.edges, num_edges, whole.weights)
                    _narrow(whole, num_edges)
                own, num_own = whole, num_edges
                if not bank.is_whole[slot]:
                    own, is_seen = part, bank.is_seen[slot]
                    num_own = keep_seen_edges(whole.edges, num_edges, whole.weights, is_seen, own.edges, own.weights)
                    _narrow(own, num_own)
                rough += _rough_side(dx32, dy32, own.starts, own.ends, num_own, own.rough_weights, squares32)
                if rough > bound + _ROUGH_TOLERANCE_M:
                    continue
                fixed, others, shares, count = annotations[slot], edges_of[slot], weights_of[slot], num_edges_of[slot]
                total = _exact(x, y, fixed, others, count, shares, own.edges, num_own, own.weights, dx, dy)
                if total < best[view] and total <= matters:
                    best[view], best_slot[view] = total, slot
                    bound = total
        if bank.is_every:
            if best[view] == np.inf:
                break
            sum_m += best[view]
        overall = min(overall, best[view])
    if bank.is_every:
        num_met = 0
        for view in range(num_views):
            if first[view] >= 0:
                num_met += 1
                if best[view] == np.inf:
                    return -np.inf, touched
        return (-sum_m / num_met / scale if num_met > 0 and sum_m <= limit else -np.inf), touched
    total, nearest = 0.0, best.min()
    for view in range(num_views):
        if best[view] > nearest + margin:
            best[view], best_slot[view] = np.inf, -1
        elif best[view] < np.inf:
            total += np.exp((nearest - best[view]) / scale)
    return (np.log(total / num_views) - nearest / scale if total > 0.0 else -np.inf), touched
