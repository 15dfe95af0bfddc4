"""Compiled inner loops of the likelihoods by mean joint distance and by shape context."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.compiled import compiled
from pasdedeux.interaction.shape_context import INNER_RADIUS_M, NUM_SECTORS, NUM_SHELLS
from pasdedeux.projections.tree import select
from pasdedeux.sampling.kernels import ROUGH_TOLERANCE_M

__all__ = ["best_cartesian", "best_shape", "fill_histograms"]

_NUM_BINS = NUM_SHELLS * NUM_SECTORS
_SHELL_SQUARES = (INNER_RADIUS_M * 2.0 ** np.arange(NUM_SHELLS - 1)) ** 2
"""Squared radii between the shells, square metres."""
_CIRCLE = 2.0**32
"""A whole turn in the integers that angles are kept in: they wrap by themselves."""

_PROBE = np.array([7, 10, 24, 27, 13, 16, 30, 33, 4, 21, 0, 17, 6, 23, 12, 29], dtype=np.int64)
_JOINTS: npt.NDArray[np.int64] = np.concatenate([_PROBE, np.setdiff1d(np.arange(34), _PROBE)])
"""Order in which joints are compared: hands, feet, heads and pelvises of both people first, as they differ most."""
_CHECKED = np.zeros(34)
_CHECKED[[8, 12, 16, 22]] = 1.8, 1.5, 1.35, 1.2
"""After so many joints a candidate is left when its cost is more than so many times what matters."""
_MIN_OF_FIRST = 0.6
"""The best of a view is taken to cost at least so many times what the one with the least rigid residual does."""


@compiled()
def _angle(y, x):  # type: ignore[no-untyped-def]
    return np.uint32(np.int64(np.arctan2(y, x) / (2.0 * np.pi) * _CIRCLE) & 0xFFFFFFFF)


@compiled()
def _fill_polar(x, y, shells, angles):  # type: ignore[no-untyped-def]
    """Write the first bin of the shell and the angle of every other joint, seen from each, (n, n - 1)."""
    for i in range(x.shape[0]):
        for j in range(i):
            dx, dy = x[j] - x[i], y[j] - y[i]
            square = dx * dx + dy * dy
            shell = 0
            for edge in _SHELL_SQUARES:
                shell += NUM_SECTORS * (square >= edge)
            angle = _angle(dy, dx)
            shells[i, j] = shells[j, i - 1] = shell
            angles[i, j] = angle
            angles[j, i - 1] = np.uint32(angle + np.uint32(0x80000000))


@compiled(inline="always")
def _bin_of(shell, angle):  # type: ignore[no-untyped-def]
    """Return the bin: the upper half of angle times sectors, by halves, so that it fits in 32 bits."""
    sectors = np.uint32(NUM_SECTORS)
    carried = np.uint32((angle & np.uint32(0xFFFF)) * sectors) >> np.uint32(16)
    return shell + np.int32(np.uint32((angle >> np.uint32(16)) * sectors + carried) >> np.uint32(16))


@compiled()
def fill_histograms(points, counts):  # type: ignore[no-untyped-def]
    """Count the bins of point sets (set, n, 2) into `counts` (set, n, bin), which is overwritten.

    Joints stand in the order in which they are compared.
    """
    num_points = points.shape[1]
    shells = np.empty((num_points, num_points - 1), dtype=np.int32)
    angles = np.empty((num_points, num_points - 1), dtype=np.uint32)
    counts[:] = 0
    for row in range(points.shape[0]):
        _fill_polar(points[row, :, 0], points[row, :, 1], shells, angles)
        for at in range(num_points):
            i = _JOINTS[at]
            for j in range(num_points - 1):
                counts[row, at, _bin_of(shells[i, j], angles[i, j])] += 1


@compiled(fastmath={"contract"})
def _align(x, y, lanes_x, lanes_y, count, dot, cross):  # type: ignore[no-untyped-def]
    """Write s . c and s x c of an image and each candidate, float32, a candidate per lane."""
    for c in range(count):
        dot[c] = cross[c] = np.float32(0.0)
    for k in range(x.shape[0]):
        sx, sy = np.float32(x[k]), np.float32(y[k])
        px, py = lanes_x[k], lanes_y[k]
        for c in range(count):
            dot[c] += sx * px[c] + sy * py[c]
            cross[c] += sx * py[c] - sy * px[c]


@compiled()
def _align_views(images, counts, lanes_x, lanes_y, squares, dots, crosses, residual, least, first):  # type: ignore[no-untyped-def]
    """Write for every view what the best turn leaves of each candidate, up to the image's own part, and the least.

    Args:
        images: Centred images of the pair (m, 2, n), metres.
        counts: Candidates of each view, (m,).
        lanes_x: x of the candidates, (m, n, most), float32, metres.
        lanes_y: y of them.
        squares: Sums of squares of them, (m, most), float32.
        dots: Result (m, most), float32: s . c.
        crosses: Result (m, most), float32: s x c.
        residual: Result (m, most), float32, square metres.
        least: Result (m,): root mean square over the joints of the least, metres; inf without candidates.
        first: Result (m,): which candidate has it.
    """
    for view in range(images.shape[0]):
        count = counts[view]
        least[view], first[view] = np.inf, -1
        if count == 0:
            continue
        x, y = images[view, 0], images[view, 1]
        own, dot, cross = residual[view], dots[view], crosses[view]
        _align(x, y, lanes_x[view], lanes_y[view], count, dot, cross)
        for c in range(count):
            own[c] = squares[view, c] - np.float32(2.0) * np.sqrt(dot[c] * dot[c] + cross[c] * cross[c])
        first[view] = np.argmin(own[:count])
        square = 0.0
        for k in range(x.shape[0]):
            square += x[k] * x[k] + y[k] * y[k]
        least[view] = np.sqrt(max(square + own[first[view]], 0.0) / x.shape[0])


@compiled(fastmath={"contract"})
def _rough_distances(x, y, lanes_x, lanes_y, count, dot, cross, total):  # type: ignore[no-untyped-def]
    """Write the summed joint distance of each candidate after the best turn; float32, a candidate per lane.

    Args:
        x: The centred image, (n,), metres.
        y: The same upwards.
        lanes_x: x of the candidates, (n, most), float32, metres.
        lanes_y: y of them.
        count: Number of candidates.
        dot: s . c of each, (most,), float32; overwritten by the cosine of the turn.
        cross: s x c of each; overwritten by the sine.
        total: Result (most,), float32, metres.
    """
    for c in range(count):
        # Points that all coincide are not turned: the least number keeps 0 / 0 away.
        scale = np.float32(1.0) / np.sqrt(max(dot[c] * dot[c] + cross[c] * cross[c], np.float32(1e-30)))
        dot[c] *= scale
        cross[c] *= scale
        total[c] = np.float32(0.0)
    for k in range(x.shape[0]):
        sx, sy = np.float32(x[k]), np.float32(y[k])
        px, py = lanes_x[k], lanes_y[k]
        for c in range(count):
            dx, dy = dot[c] * sx - cross[c] * sy - px[c], cross[c] * sx + dot[c] * sy - py[c]
            total[c] += np.sqrt(dx * dx + dy * dy)


@compiled()
def best_cartesian(  # type: ignore[no-untyped-def]
    images, counts, slots, points, lanes_x, lanes_y, squares, limit, margin, best, best_slot
):
    """Write the least mean joint distance of each view, metres, and the slot that has it, as far as it can matter.

    All candidates are compared in float32; only those that may be the best by that are compared in float64.

    Args:
        images: As for `_align_views`.
        counts: The same.
        slots: Annotation of each candidate, (m, most).
        points: Centred annotations (annotation, n, 2), metres.
        lanes_x: As for `_align_views`.
        lanes_y: The same.
        squares: The same.
        limit: Distance above which nothing matters unless a better one is found, metres.
        margin: How far behind the best view another still matters, metres.
        best: Result (m,); inf where it is beyond what matters.
        best_slot: Result (m,); -1 there.
    """
    num_views, num_points, most = images.shape[0], images.shape[2], slots.shape[1]
    dots, crosses = np.empty((num_views, most), dtype=np.float32), np.empty((num_views, most), dtype=np.float32)
    rough = np.empty((num_views, most), dtype=np.float32)
    least, first = np.empty(num_views), np.empty(num_views, dtype=np.int64)
    _align_views(images, counts, lanes_x, lanes_y, squares, dots, crosses, rough, least, first)
    for view in range(num_views):
        if counts[view] > 0:
            x, y, own = images[view, 0], images[view, 1], rough[view]
            _rough_distances(x, y, lanes_x[view], lanes_y[view], counts[view], dots[view], crosses[view], own)
            least[view] = own[: counts[view]].min()
    best[:], best_slot[:] = np.inf, -1
    overall = limit
    for view in np.argsort(least):
        x, y = images[view, 0], images[view, 1]
        bound = overall + margin
        nearest = np.float32(least[view] + 2.0 * ROUGH_TOLERANCE_M * num_points)
        for c in range(counts[view]):
            # The best lies within rounding of the least; nothing beyond that or beyond what matters need be looked at.
            if rough[view, c] > nearest or rough[view, c] > (bound + ROUGH_TOLERANCE_M) * num_points:
                continue
            slot = slots[view, c]
            fixed = points[slot]
            cosine, sine = _turn(x, y, fixed)
            total = 0.0
            for k in range(num_points):
                dx = cosine * x[k] - sine * y[k] - fixed[k, 0]
                dy = sine * x[k] + cosine * y[k] - fixed[k, 1]
                total += np.sqrt(dx * dx + dy * dy)
            total /= num_points
            if total <= bound and total < best[view]:
                best[view], best_slot[view], bound = total, slot, total
        overall = min(overall, best[view])


@compiled()
def _turn(x, y, fixed):  # type: ignore[no-untyped-def]
    dot = cross = 0.0
    for k in range(x.shape[0]):
        dot += x[k] * fixed[k, 0] + y[k] * fixed[k, 1]
        cross += x[k] * fixed[k, 1] - y[k] * fixed[k, 0]
    length = np.sqrt(dot * dot + cross * cross)
    if length > 1e-300:
        return dot / length, cross / length
    return 1.0, 0.0


@compiled()
def _shared(shells, angles, angle, histogram, bins, own):  # type: ignore[no-untyped-def]
    """Return the sum of a b / (a + b) over the bins, of one joint's turned histogram and a candidate's, in counts.

    Summed in integers, 2^-24 each: on every machine the same, and in any order.
    """
    for j in range(shells.shape[0]):
        bins[j] = _bin_of(shells[j], np.uint32(angles[j] + angle))
    for b in range(own.shape[0]):
        own[b] = np.float32(0.0)
    for j in range(shells.shape[0]):
        own[bins[j]] += np.float32(1.0)
    total = np.int32(0)
    for b in range(own.shape[0]):
        one, two = own[b], np.float32(histogram[b])
        part = np.int32(one * two / max(one + two, np.float32(1.0)) * np.float32(16777216.0))
        total = np.int32(total + part)
    return total / 16777216.0


@compiled()
def _cost(shells, angles, angle, histograms, bound, is_exact, bins, own):  # type: ignore[no-untyped-def]
    """Return the shape-context cost, inf once it is more than `bound` (or, unless exact, will hardly be less)."""
    num_points = shells.shape[0]
    cost = 0.0
    for at in range(num_points):
        i = _JOINTS[at]
        if _CHECKED[at] > 0.0 and not is_exact and cost > _CHECKED[at] * bound * at:
            return np.inf
        cost += 1.0 - 2.0 * _shared(shells[i], angles[i], angle, histograms[at], bins, own) / (num_points - 1)
        if cost > bound * num_points:
            return np.inf
    return cost / num_points


@compiled()
def best_shape(  # type: ignore[no-untyped-def]
    images, counts, slots, histograms, lanes_x, lanes_y, squares, num_ranked, is_exact, limit, margin, best, best_slot
):
    """Write the least shape-context cost of each view and the slot that has it, as far as it can matter.

    Args:
        images: As for `_align_views`.
        counts: The same.
        slots: Annotation of each candidate, (m, most).
        histograms: Counts of `fill_histograms` for the annotations, (annotation, n, bin), uint8.
        lanes_x: As for `_align_views`.
        lanes_y: The same.
        squares: The same.
        num_ranked: Candidates of a view compared, nearest by rigid residual.
        is_exact: Compare all, to the end.
        limit: Cost above which nothing matters unless a better one is found.
        margin: How far behind the best view another still matters.
        best: Result (m,); inf where it is beyond what matters.
        best_slot: Result (m,); -1 there.
    """
    num_views, num_points, most = images.shape[0], images.shape[2], slots.shape[1]
    dots, crosses = np.empty((num_views, most), dtype=np.float32), np.empty((num_views, most), dtype=np.float32)
    residual = np.empty((num_views, most), dtype=np.float32)
    least, first = np.empty(num_views), np.empty(num_views, dtype=np.int64)
    shells = np.empty((num_views, num_points, num_points - 1), dtype=np.int32)
    angles = np.empty((num_views, num_points, num_points - 1), dtype=np.uint32)
    bins, own = np.empty(num_points - 1, dtype=np.int32), np.empty(_NUM_BINS, dtype=np.float32)
    order = np.empty(most, dtype=np.int32)
    _align_views(images, counts, lanes_x, lanes_y, squares, dots, crosses, residual, least, first)
    best[:], best_slot[:] = np.inf, -1
    overall = limit
    for view in np.argsort(least):
        # What the one with the least residual costs says which views to take first, and which are too far.
        least[view] = np.inf
        if counts[view] == 0:
            continue
        _fill_polar(images[view, 0], images[view, 1], shells[view], angles[view])
        slot = slots[view, first[view]]
        angle = _angle(np.float64(crosses[view, first[view]]), np.float64(dots[view, first[view]]))
        ceiling = np.inf if is_exact else (overall + margin) / _MIN_OF_FIRST
        least[view] = _cost(shells[view], angles[view], angle, histograms[slot], ceiling, is_exact, bins, own)
        if least[view] <= overall + margin:
            best[view], best_slot[view] = least[view], slot
        overall = min(overall, least[view])
    for view in np.argsort(least):
        if counts[view] == 0 or (not is_exact and _MIN_OF_FIRST * least[view] > overall + margin):
            continue
        bound = min(overall + margin, best[view])
        order[: counts[view]] = np.arange(counts[view])
        kept = counts[view] if is_exact else min(num_ranked, counts[view])
        if kept < counts[view]:
            select(residual[view], order, 0, counts[view], kept)
        for c in order[:kept]:
            if c == first[view]:
                continue
            slot = slots[view, c]
            angle = _angle(np.float64(crosses[view, c]), np.float64(dots[view, c]))
            cost = _cost(shells[view], angles[view], angle, histograms[slot], bound, is_exact, bins, own)
            if cost <= bound and cost < best[view]:
                best[view], best_slot[view], bound = cost, slot, cost
        overall = min(overall, best[view])
