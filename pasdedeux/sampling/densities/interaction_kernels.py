"""Compiled inner loops of the likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pasdedeux.cameras.frames import frame_columns, square_to
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.interaction.kernels import fill_edge_weights, keep_seen_edges, side_sum
from pasdedeux.interaction.triangulation import triangulate, workspace
from pasdedeux.kinematics.rotation_kernels import cross, dot, mix, normalise, row_of, subtract
from pasdedeux.skeletons import PAIR17

_NUM_JOINTS = PAIR17.num_joints
_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))

ESTIMATE_TOLERANCE_M = 1e-3
"""What rounding may do to an estimate of d_I, metres: it is the root of a small difference of large numbers."""

_ROUGH_TOLERANCE_M = 2e-5
"""What the rough comparison in float32 may be wrong by, metres; for people within a few metres its error is 1e-6."""


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
        factors: What each root counts in the estimate, (m, kind=3, most), float32.
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


class _Side(NamedTuple):
    """Room for one side of eq. 8: edges (n, 2) and weights (n,), and both narrowed for the rough comparison."""

    edges: np.ndarray
    weights: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    rough_weights: np.ndarray


@inner_kernel()
def _empty_side(count):  # type: ignore[no-untyped-def]
    starts, ends = np.empty(count, dtype=np.uint8), np.empty(count, dtype=np.uint8)
    return _Side(np.empty((count, 2), dtype=np.int32), np.empty(count), starts, ends, np.empty(count, dtype=np.float32))


@compiled()
def _narrow(side, count):  # type: ignore[no-untyped-def]
    for e in range(count):
        side.starts[e], side.ends[e], side.rough_weights[e] = side.edges[e, 0], side.edges[e, 1], side.weights[e]


@inner_kernel(fastmath={"contract"})
def _estimate(  # type: ignore[no-untyped-def]
    image, pulls, constants, rank_x, rank_y, rank_squares, factors, count, work, turn, estimate
):
    """Write each candidate's best rotation and the estimate of its d_I; float32, a candidate per lane.

    Args:
        image: The centred image s, (2, n), float32, metres times the unit of `rank_x`.
        pulls: The springs L of each kind times it, (kind=3, 2, n), float32.
        constants: s' L s of each kind, (kind=3,), float32, square metres.
        rank_x: x of the candidates, (n, most), int16, in some unit.
        rank_y: y of them.
        rank_squares: c' L c of them, (kind=3, most), float32, square metres.
        factors: What the root of each kind counts, (kind=3, most), float32.
        count: Number of candidates.
        work: Scratch (8, most), float32; the first three rows become the values of the quadratic forms, square metres.
        turn: Result (2, most), float32: cosine and sine.
        estimate: Result (most,), float32, metres.
    """
    zero, two = np.float32(0.0), np.float32(2.0)
    dot, cross, along_a, across_a = work[0], work[1], work[2], work[3]
    along_b, across_b, along_ab, across_ab = work[4], work[5], work[6], work[7]
    for c in range(count):
        dot[c] = cross[c] = along_a[c] = across_a[c] = zero
        along_b[c] = across_b[c] = along_ab[c] = across_ab[c] = zero
    for k in range(_NUM_JOINTS):
        other = k + _NUM_JOINTS
        sx, sy, tx, ty = image[0, k], image[1, k], image[0, other], image[1, other]
        ax, ay, bx, by = pulls[0, 0, k], pulls[0, 1, k], pulls[1, 0, other], pulls[1, 1, other]
        ux, uy, vx, vy = pulls[2, 0, k], pulls[2, 1, k], pulls[2, 0, other], pulls[2, 1, other]
        px, py, qx, qy = rank_x[k], rank_y[k], rank_x[other], rank_y[other]
        for c in range(count):
            ox, oy, rx, ry = np.float32(px[c]), np.float32(py[c]), np.float32(qx[c]), np.float32(qy[c])
            dot[c] += (sx * ox + sy * oy) + (tx * rx + ty * ry)
            cross[c] += (sx * oy - sy * ox) + (tx * ry - ty * rx)
            along_a[c] += ax * ox + ay * oy
            across_a[c] += ax * oy - ay * ox
            along_b[c] += bx * rx + by * ry
            across_b[c] += bx * ry - by * rx
            along_ab[c] += (ux * ox + uy * oy) + (vx * rx + vy * ry)
            across_ab[c] += (ux * oy - uy * ox) + (vx * ry - vy * rx)
    for c in range(count):
        # Points that all coincide are not turned: the least number keeps 0 / 0 away.
        scale = np.float32(1.0) / np.sqrt(max(dot[c] * dot[c] + cross[c] * cross[c], np.float32(1e-30)))
        cosine, sine = dot[c] * scale, cross[c] * scale
        turn[0, c], turn[1, c] = cosine, sine
        a = constants[0] + rank_squares[0, c] - two * (cosine * along_a[c] + sine * across_a[c])
        b = constants[1] + rank_squares[1, c] - two * (cosine * along_b[c] + sine * across_b[c])
        ab = constants[2] + rank_squares[2, c] - two * (cosine * along_ab[c] + sine * across_ab[c])
        work[0, c], work[1, c], work[2, c] = a, b, ab
        estimate[c] = (
            factors[0, c] * np.sqrt(max(a, zero))
            + factors[1, c] * np.sqrt(max(b, zero))
            + factors[2, c] * np.sqrt(max(ab, zero))
        )


@inner_kernel()
def _estimate_views(points, bank, x, y, turn, estimate, least, first):  # type: ignore[no-untyped-def]
    """Project under every view and estimate d_I of all of its candidates.

    Args:
        points: Joints of both people, (n, 3), metres.
        bank: Tables of the bank.
        x: Result (m, n), the centred image, metres.
        y: The same upwards.
        turn: Result (m, 2, most), float32: cosine and sine of the best rotation.
        estimate: Result (m, most), float32: estimates of d_I, metres.
        least: Result (m,): least of the estimates, metres; inf without candidates.
        first: Result (m,): which candidate has it.
    """
    num_points = points.shape[0]
    image = np.empty((2, num_points), dtype=np.float32)
    pulls = np.empty((3, 2, num_points), dtype=np.float32)
    constants = np.empty(3, dtype=np.float32)
    work = np.empty((8, bank.rank_x.shape[2]), dtype=np.float32)
    unit, rank_x, rank_y = bank.unit, bank.rank_x, bank.rank_y
    rank_squares, factors = bank.rank_squares, bank.factors
    roots = row_of(points, _PELVIS), row_of(points, _PELVIS + _NUM_JOINTS)
    necks = row_of(points, _NECK), row_of(points, _NECK + _NUM_JOINTS)
    i, j, k = frame_columns(subtract(roots[1], roots[0]), subtract(necks[0], roots[0]), subtract(necks[1], roots[1]))
    for view in range(bank.directions.shape[0]):
        count = bank.counts[view]
        least[view], first[view] = np.inf, -1
        if count == 0:
            continue
        a, b, c = row_of(bank.directions, view)
        _project(points, mix(1.0, mix(a, i, b, j), c, k), x[view], y[view])
        for joint in range(num_points):
            image[0, joint], image[1, joint] = x[view, joint], y[view, joint]
        _pull(bank.springs[view], image, pulls, constants)
        image *= unit
        pulls *= unit
        x16, y16, squares, own = rank_x[view], rank_y[view], rank_squares[view], estimate[view]
        _estimate(image, pulls, constants, x16, y16, squares, factors[view], count, work, turn[view], own)
        if bank.has_partial:
            _leave_unseen(x[view], y[view], bank, view, work, turn[view], own)
        at = np.argmin(own[:count])
        least[view], first[view] = own[at], at


@inner_kernel()
def _project(points, towards, x, y):  # type: ignore[no-untyped-def]
    """Write the centred orthographic image of points (n, 3) from a direction of any length, in any turn."""
    back = normalise(towards)
    up = normalise(square_to(back))
    right = cross(up, back)
    mean_x = mean_y = 0.0
    for k in range(points.shape[0]):
        point = row_of(points, k)
        x[k], y[k] = dot(point, right), dot(point, up)
        mean_x += x[k]
        mean_y += y[k]
    mean_x /= points.shape[0]
    mean_y /= points.shape[0]
    for k in range(points.shape[0]):
        x[k] -= mean_x
        y[k] -= mean_y


@inner_kernel(fastmath={"contract"})
def _leave_unseen(x, y, bank, view, values, turn, estimate):  # type: ignore[no-untyped-def]
    """Take the springs of joints that a candidate does not show out of its estimate; float32.

    Args:
        x: The centred image, (n,), metres.
        y: The same upwards.
        bank: Tables of the bank.
        view: Which view it is.
        values: Values of the quadratic forms of each candidate, (kind=3, most), square metres.
        turn: Cosine and sine of each candidate's best rotation, (2, most).
        estimate: Result for candidates that are not whole, (most,), metres.
    """
    num_points = x.shape[0]
    dx, dy = np.empty(num_points, dtype=np.float32), np.empty(num_points, dtype=np.float32)
    is_left = np.empty(num_points, dtype=np.float32)
    # What leaves each form, by the joint at the other end: a lane each, so sums stay in written order.
    gone = np.empty((3, num_points), dtype=np.float32)
    springs, factors, slots = bank.springs[view], bank.factors[view], bank.slots[view]
    zero = np.float32(0.0)
    for c in range(bank.counts[view]):
        slot = slots[c]
        if bank.is_whole[slot]:
            continue
        cosine, sine = turn[0, c], turn[1, c]
        for k in range(num_points):
            px, py = np.float32(x[k]), np.float32(y[k])
            dx[k] = cosine * px - sine * py - bank.rough_points[slot, 0, k]
            dy[k] = sine * px + cosine * py - bank.rough_points[slot, 1, k]
            is_left[k] = np.float32(1.0)
            gone[0, k] = gone[1, k] = gone[2, k] = zero
        a, b, ab = values[0, c], values[1, c], values[2, c]
        for j in range(num_points):
            if bank.is_seen[slot, j]:
                continue
            is_left[j] = zero
            kind = 1 if j >= _NUM_JOINTS else 0
            own, between, within, across = springs[kind, j], springs[2, j], gone[kind], gone[2]
            # Off the diagonal a form has minus the spring; a spring that an earlier joint took is not taken again.
            for k in range(num_points):
                u, v = dx[k] - dx[j], dy[k] - dy[j]
                squared = is_left[k] * (u * u + v * v)
                within[k] += own[k] * squared
                across[k] += between[k] * squared
        # Within a person only that person's joints are tied.
        for k in range(_NUM_JOINTS):
            a += gone[0, k]
            b += gone[1, k + _NUM_JOINTS]
            ab += gone[2, k] + gone[2, k + _NUM_JOINTS]
        estimate[c] = (
            factors[0, c] * np.sqrt(max(a, zero))
            + factors[1, c] * np.sqrt(max(b, zero))
            + factors[2, c] * np.sqrt(max(ab, zero))
        )


@inner_kernel(fastmath={"contract"})
def _pull(springs, image, pulls, constants):  # type: ignore[no-untyped-def]
    """Write the springs (kind=3, n, n) times the image (2, n), and its own value under each; all float32."""
    num_points = image.shape[1]
    for kind in range(3):
        # Within a person only that person's joints are tied.
        low = _NUM_JOINTS if kind == 1 else 0
        high = _NUM_JOINTS if kind == 0 else num_points
        constants[kind] = np.float32(0.0)
        for axis in range(2):
            row = pulls[kind, axis]
            row[:] = np.float32(0.0)
            for j in range(low, high):
                value = image[axis, j]
                spring = springs[kind, j]
                for k in range(num_points):
                    row[k] += spring[k] * value
            for k in range(low, high):
                constants[kind] += row[k] * image[axis, k]


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
        # Written always and kept if wanted: no branch that would be guessed wrong.
        chosen[number] = c
        number += estimate[c] <= ceiling and c != but
    return number


@inner_kernel()
def _touch(slots, chosen, num_chosen, points, starts, ends, weights):  # type: ignore[no-untyped-def]
    """Read from every cache line that comparing these candidates will need, so that they come from memory together."""
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
    """Write the least d_I of each view, as far as it can matter, and give the log of eq. 6.

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
    _estimate_views(points, bank, xs, ys, turn, estimate, least, first)
    overall = limit
    # What views not looked at yet add to the sum at the least, and what those looked at add.
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
