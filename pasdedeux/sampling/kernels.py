"""Compiled inner loops of the likelihood."""

from __future__ import annotations

import numba
import numpy as np

from pasdedeux.cameras.frames import LEAST_SINE
from pasdedeux.interaction.kernels import fill_edge_weights, side_sum
from pasdedeux.interaction.triangulation import triangulate
from pasdedeux.skeletons import PAIR17

__all__ = ["best_per_view", "pair_axes"]

_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))
_NUM_JOINTS = PAIR17.num_joints

ROUGH_TOLERANCE_M = 2e-5
"""What the rough comparison in float32 may be wrong by, metres; for people within a few metres its error is 1e-6."""


@numba.njit(cache=True, nogil=True)
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    length = np.sqrt(x * x + y * y + z * z)
    if length <= 1e-12:
        return 0.0, 0.0, 0.0, 0.0
    return x / length, y / length, z / length, length


@numba.njit(cache=True, nogil=True)
def pair_axes(points, axes):  # type: ignore[no-untyped-def]
    """Write the columns i, j, k of the pair's local frame (lift eq. 3); `pasdedeux.cameras.pair_frame` as a loop.

    Args:
        points: Joints of both people, (34, 3), metres.
        axes: Result (3, 3), columns i, j, k.
    """
    second = _NUM_JOINTS
    p, n = _PELVIS, _NECK
    ax, ay, az, _ = _unit(points[n, 0] - points[p, 0], points[n, 1] - points[p, 1], points[n, 2] - points[p, 2])
    bx, by, bz, _ = _unit(
        points[second + n, 0] - points[second + p, 0],
        points[second + n, 1] - points[second + p, 1],
        points[second + n, 2] - points[second + p, 2],
    )
    sx, sy, sz = ax + bx, ay + by, az + bz
    if np.sqrt(sx * sx + sy * sy + sz * sz) < 1e-6:
        sx, sy, sz = ax, ay, az
    jx, jy, jz, length = _unit(sx, sy, sz)
    if length == 0.0:
        jx, jy, jz = 0.0, 1.0, 0.0
    dx = points[second + p, 0] - points[p, 0]
    dy = points[second + p, 1] - points[p, 1]
    dz = points[second + p, 2] - points[p, 2]
    gap = np.sqrt(dx * dx + dy * dy + dz * dz)
    ix, iy, iz, _ = _unit(dx, dy, dz)
    cosine = ix * jx + iy * jy + iz * jz
    ux, uy, uz = ix - cosine * jx, iy - cosine * jy, iz - cosine * jz
    sine = np.sqrt(ux * ux + uy * uy + uz * uz)
    if sine < LEAST_SINE or gap < 1e-9:
        if sine <= 1e-9:
            along = ax * jx + ay * jy + az * jz
            ux, uy, uz = ax - along * jx, ay - along * jy, az - along * jz
            if np.sqrt(ux * ux + uy * uy + uz * uz) <= 1e-6:
                sx = sy = sz = 0.0
                if abs(jx) <= abs(jy) and abs(jx) <= abs(jz):
                    sx = 1.0
                elif abs(jy) <= abs(jz):
                    sy = 1.0
                else:
                    sz = 1.0
                along = sx * jx + sy * jy + sz * jz
                ux, uy, uz = sx - along * jx, sy - along * jy, sz - along * jz
        ux, uy, uz, _ = _unit(ux, uy, uz)
        if gap < 1e-9:
            ix, iy, iz = ux, uy, uz
        else:
            kept = np.sqrt(1.0 - LEAST_SINE * LEAST_SINE)
            if cosine < 0.0:
                kept = -kept
            ix = kept * jx + LEAST_SINE * ux
            iy = kept * jy + LEAST_SINE * uy
            iz = kept * jz + LEAST_SINE * uz
    axes[0, 0], axes[1, 0], axes[2, 0] = ix, iy, iz
    axes[0, 1], axes[1, 1], axes[2, 1] = jx, jy, jz
    axes[0, 2], axes[1, 2], axes[2, 2] = iy * jz - iz * jy, iz * jx - ix * jz, ix * jy - iy * jx


@numba.njit(cache=True, nogil=True)
def _project(points, axes, direction, x, y):  # type: ignore[no-untyped-def]
    """Write the centred orthographic image of points (n, 3) under a view (a, b, c), in any turn."""
    zx, zy, zz, _ = _unit(
        axes[0, 0] * direction[0] + axes[0, 1] * direction[1] + axes[0, 2] * direction[2],
        axes[1, 0] * direction[0] + axes[1, 1] * direction[1] + axes[1, 2] * direction[2],
        axes[2, 0] * direction[0] + axes[2, 1] * direction[1] + axes[2, 2] * direction[2],
    )
    hx = hy = hz = 0.0
    if abs(zx) <= abs(zy) and abs(zx) <= abs(zz):
        hx = 1.0
    elif abs(zy) <= abs(zz):
        hy = 1.0
    else:
        hz = 1.0
    along = hx * zx + hy * zy + hz * zz
    ux, uy, uz, _ = _unit(hx - along * zx, hy - along * zy, hz - along * zz)
    rx, ry, rz = uy * zz - uz * zy, uz * zx - ux * zz, ux * zy - uy * zx
    mean_x = mean_y = 0.0
    for k in range(points.shape[0]):
        x[k] = points[k, 0] * rx + points[k, 1] * ry + points[k, 2] * rz
        y[k] = points[k, 0] * ux + points[k, 1] * uy + points[k, 2] * uz
        mean_x += x[k]
        mean_y += y[k]
    mean_x /= points.shape[0]
    mean_y /= points.shape[0]
    for k in range(points.shape[0]):
        x[k] -= mean_x
        y[k] -= mean_y


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _rank(x, y, rank_x, rank_y, squares, count, a, b, score):  # type: ignore[no-untyped-def]
    """Write for each candidate what the best rotation leaves, up to the pair's own constant; float32, a lane each."""
    for c in range(count):
        a[c] = np.float32(0.0)
        b[c] = np.float32(0.0)
    for k in range(0, x.shape[0] - 1, 2):
        sx, sy = np.float32(x[k]), np.float32(y[k])
        tx, ty = np.float32(x[k + 1]), np.float32(y[k + 1])
        px, py, qx, qy = rank_x[k], rank_y[k], rank_x[k + 1], rank_y[k + 1]
        for c in range(count):
            a[c] += (sx * px[c] + sy * py[c]) + (tx * qx[c] + ty * qy[c])
            b[c] += (sx * py[c] - sy * px[c]) + (tx * qy[c] - ty * qx[c])
    for c in range(count):
        score[c] = squares[c] - np.float32(2.0) * np.sqrt(a[c] * a[c] + b[c] * b[c])


@numba.njit(cache=True, nogil=True)
def _least(score, count, num_best, order):  # type: ignore[no-untyped-def]
    """Write the indices of the `num_best` least scores into the front of `order`, in no order; give their number."""
    for c in range(count):
        order[c] = c
    kept = min(num_best, count)
    low, high = 0, count - 1
    while low < high and kept < count:
        pivot = score[order[(low + high) // 2]]
        i, j = low, high
        while i <= j:
            while score[order[i]] < pivot:
                i += 1
            while score[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if kept - 1 <= j:
            high = j
        elif kept - 1 >= i:
            low = i
        else:
            break
    return kept


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _rough_own_side(dx, dy, edges, num_edges, weights, kept, sums):  # type: ignore[no-untyped-def]
    """Write the pair's own side of eq. 8 for `kept` candidates at once, float32, a candidate per lane.

    `dx`, `dy` (n, kept) are the differences of the turned pair from each candidate.
    """
    for c in range(kept):
        sums[c] = np.float32(0.0)
    for e in range(num_edges):
        start_x, end_x = dx[edges[e, 0]], dx[edges[e, 1]]
        start_y, end_y = dy[edges[e, 0]], dy[edges[e, 1]]
        weight = np.float32(weights[e])
        for c in range(kept):
            u, v = end_x[c] - start_x[c], end_y[c] - start_y[c]
            sums[c] += weight * np.sqrt(u * u + v * v)


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _rough_other_side(dx, dy, c, starts, ends, count, weights, squares):  # type: ignore[no-untyped-def]
    """Give the side of eq. 8 over the edges of candidate c, float32."""
    for e in range(count):
        i, j = starts[e], ends[e]
        u, v = dx[j, c] - dx[i, c], dy[j, c] - dy[i, c]
        squares[e] = u * u + v * v
    total = np.float32(0.0)
    for e in range(count):
        total += weights[e] * np.sqrt(squares[e])
    return total


@numba.njit(cache=True, nogil=True)
def _rank_views(  # type: ignore[no-untyped-def]
    points, directions, candidate_counts, rank_x, rank_y, rank_squares, num_ranked, x, y, kept, of, turn, spread
):
    """Project under every view and keep its best candidates by what the best rotation in the plane leaves.

    Args:
        points: Joints of both people, (n, 3), metres.
        directions: Views (m, 3) in the pair's local frame.
        candidate_counts: Candidates of each view, (m,).
        rank_x: As for `best_per_view`.
        rank_y: The same.
        rank_squares: The same.
        num_ranked: Candidates kept, R.
        x: Result (m, n), the centred image, metres.
        y: The same upwards.
        kept: Result (m,): number of kept candidates.
        of: Result (m, R): which they are.
        turn: Result (m, 2, R), float32: cosine and sine of the best rotation.
        spread: Result (m,): root mean square over the joints of what it leaves of the best one, metres; inf for none.
    """
    num_points, most = points.shape[0], rank_x.shape[2]
    axes = np.empty((3, 3))
    a, b = np.empty(most, dtype=np.float32), np.empty(most, dtype=np.float32)
    score = np.empty(most, dtype=np.float32)
    order = np.empty(most, dtype=np.int32)
    pair_axes(points, axes)
    for view in range(directions.shape[0]):
        count = candidate_counts[view]
        kept[view] = 0
        spread[view] = np.inf
        if count == 0:
            continue
        _project(points, axes, directions[view], x[view], y[view])
        _rank(x[view], y[view], rank_x[view], rank_y[view], rank_squares[view], count, a, b, score)
        kept[view] = _least(score, count, num_ranked, order)
        least = np.float32(np.inf)
        for at in range(kept[view]):
            c = order[at]
            of[view, at] = c
            length = np.sqrt(a[c] * a[c] + b[c] * b[c])
            turn[view, 0, at], turn[view, 1, at] = np.float32(1.0), np.float32(0.0)
            if length > np.float32(0.0):
                turn[view, 0, at], turn[view, 1, at] = a[c] / length, b[c] / length
            least = min(least, score[c])
        square = 0.0
        for k in range(num_points):
            square += x[view, k] * x[view, k] + y[view, k] * y[view, k]
        spread[view] = np.sqrt(max(square + least, 0.0) / num_points)


@numba.njit(cache=True, nogil=True)
def best_per_view(  # type: ignore[no-untyped-def]
    points,
    directions,
    candidate_counts,
    slots,
    rank_x,
    rank_y,
    rank_squares,
    annotations,
    annotation_edges,
    annotation_weights,
    annotation_counts,
    rough_starts,
    rough_ends,
    rough_weights,
    offsets,
    beta_m,
    num_ranked,
    least_ratio,
    own_share,
    limit,
    margin,
    best,
    best_slot,
):
    """Write the least d_I of each view, as far as it can matter.

    Views are taken in the order of what the best rotation leaves of their best candidate, so the best view mostly
    comes first.  Candidates are compared roughly, in float32, first; only those that may be the best by that are
    compared in float64.

    Args:
        points: Joints of both people, (n, 3), metres.
        directions: Views (m, 3) in the pair's local frame.
        candidate_counts: Candidates of each view, (m,).
        slots: Annotation of each candidate, (m, most).
        rank_x: x of the candidates' centred points, (m, n, most), float32, metres.
        rank_y: y of them.
        rank_squares: Sum of squares of them, (m, most), float32.
        annotations: Centred annotations (annotation, n, 2), metres.
        annotation_edges: Their Delaunay edges.
        annotation_weights: Their weights, summing to 1.
        annotation_counts: Their numbers of edges.
        rough_starts: First joints of the edges, (annotation, edge), uint8.
        rough_ends: Second joints of them.
        rough_weights: The weights, float32.
        offsets: Jitter of the triangulation, (n, 2), metres.
        beta_m: Edge length below which weights stop growing, metres.
        num_ranked: Candidates compared in full per view.
        least_ratio: A view is left when so many times what the best rotation leaves is more than matters; 0: never.
        own_share: A candidate is left when the side of eq. 8 over the pair's own edges alone is more than this share of
            what matters; 1 never loses any.
        limit: d_I above which nothing matters unless a better one is found, metres.
        margin: How far behind the best view another still matters, metres.
        best: Result (m,), metres: least d_I, inf where it is beyond what matters.
        best_slot: Annotation that reached it, (m,); -1 where none did.
    """
    num_points, num_views = points.shape[0], directions.shape[0]
    lanes = min(num_ranked, slots.shape[1])
    xs, ys = np.empty((num_views, num_points)), np.empty((num_views, num_points))
    jx, jy = np.empty(num_points), np.empty(num_points)
    dx, dy = np.empty(num_points), np.empty(num_points)
    kept_of = np.empty(num_views, dtype=np.int64)
    of = np.empty((num_views, lanes), dtype=np.int32)
    turn = np.empty((num_views, 2, lanes), dtype=np.float32)
    spread = np.empty(num_views)
    dx32 = np.empty((num_points, lanes), dtype=np.float32)
    dy32 = np.empty((num_points, lanes), dtype=np.float32)
    squares32 = np.empty(3 * num_points, dtype=np.float32)
    rough = np.empty(lanes, dtype=np.float32)
    triangles = np.empty((2 * num_points + 8, 3), dtype=np.int32)
    neighbours = np.empty((2 * num_points + 8, 3), dtype=np.int32)
    scratch = np.empty((5, 2 * num_points + 8), dtype=np.int32)
    edges = np.empty((3 * num_points, 2), dtype=np.int32)
    weights = np.empty(3 * num_points)
    for view in range(num_views):
        best[view] = np.inf
        best_slot[view] = -1
    _rank_views(
        points,
        directions,
        candidate_counts,
        rank_x,
        rank_y,
        rank_squares,
        lanes,
        xs,
        ys,
        kept_of,
        of,
        turn,
        spread,
    )
    overall = limit
    for view in np.argsort(spread):
        kept = kept_of[view]
        if kept == 0 or least_ratio * spread[view] > overall + margin:
            # Views after this one leave more.
            break
        x, y = xs[view], ys[view]
        for k in range(num_points):
            jx[k] = x[k] + offsets[k, 0]
            jy[k] = y[k] + offsets[k, 1]
        num_edges = triangulate(jx, jy, triangles, neighbours, scratch, edges)
        fill_edge_weights(x, y, edges, num_edges, beta_m, weights)
        for k in range(num_points):
            px, py = np.float32(x[k]), np.float32(y[k])
            fixed_x, fixed_y, along_x, along_y = rank_x[view, k], rank_y[view, k], dx32[k], dy32[k]
            for at in range(kept):
                c = of[view, at]
                along_x[at] = turn[view, 0, at] * px - turn[view, 1, at] * py - fixed_x[c]
                along_y[at] = turn[view, 1, at] * px + turn[view, 0, at] * py - fixed_y[c]
        _rough_own_side(dx32, dy32, edges, num_edges, weights, kept, rough)
        bound = np.float32(overall + margin + ROUGH_TOLERANCE_M)
        # The candidate with the least own side goes first: it is mostly the best, and bounds the rest.
        first = int(np.argmin(rough[:kept]))
        for turn_of in range(kept):
            at = first if turn_of == 0 else (0 if turn_of == first else turn_of)
            if rough[at] > np.float32(own_share) * bound:
                rough[at] = np.float32(np.inf)
                continue
            slot = slots[view, of[view, at]]
            rough[at] += _rough_other_side(
                dx32,
                dy32,
                at,
                rough_starts[slot],
                rough_ends[slot],
                annotation_counts[slot],
                rough_weights[slot],
                squares32,
            )
            bound = min(bound, rough[at] + np.float32(ROUGH_TOLERANCE_M))
        for at in range(kept):
            if rough[at] > bound:
                continue
            slot = slots[view, of[view, at]]
            fixed = annotations[slot]
            dot = cross = 0.0
            for k in range(num_points):
                dot += x[k] * fixed[k, 0] + y[k] * fixed[k, 1]
                cross += x[k] * fixed[k, 1] - y[k] * fixed[k, 0]
            length = np.sqrt(dot * dot + cross * cross)
            cosine, sine = 1.0, 0.0
            if length > 1e-300:
                cosine, sine = dot / length, cross / length
            for k in range(num_points):
                dx[k] = cosine * x[k] - sine * y[k] - fixed[k, 0]
                dy[k] = sine * x[k] + cosine * y[k] - fixed[k, 1]
            total = side_sum(dx, dy, annotation_edges[slot], annotation_counts[slot], annotation_weights[slot])
            total += side_sum(dx, dy, edges, num_edges, weights)
            if total < best[view] and total <= overall + margin:
                best[view] = total
                best_slot[view] = slot
        overall = min(overall, best[view])
