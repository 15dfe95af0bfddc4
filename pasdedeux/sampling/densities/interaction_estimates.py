"""Compiled estimates of the dissimilarity of every candidate of every view, from which few are compared exactly."""

from __future__ import annotations

import numpy as np

from pasdedeux.cameras.frames import frame_columns, most_square_axis
from pasdedeux.compiled import inner_kernel
from pasdedeux.kinematics.rotation_kernels import cross, dot, normalise, row_of, subtract, weighted_sum
from pasdedeux.skeletons import PAIR17

_NUM_JOINTS = PAIR17.num_joints
_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))


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
        factors: Factor of the root of each kind, (kind=3, most), float32.
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
        # Coincident points are not turned: the smallest number avoids 0 / 0.
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
def estimate_dissimilarities(points, bank, x, y, turn, estimate, least, first):  # type: ignore[no-untyped-def]
    """Project under every view and estimate d_I of all of its candidates.

    Args:
        points: Joints of both people, (n, 3), metres.
        bank: Tables of the bank.
        x: Result (m, n), the centred image, metres.
        y: The same upwards.
        turn: Result (m, 2, most), float32: cosine and sine of the best rotation.
        estimate: Result (m, most), float32: estimates of d_I, metres.
        least: Result (m,): least of the estimates, metres; inf without candidates.
        first: Result (m,): the candidate that has it.
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
        _project(points, weighted_sum(1.0, weighted_sum(a, i, b, j), c, k), x[view], y[view])
        for joint in range(num_points):
            image[0, joint], image[1, joint] = x[view, joint], y[view, joint]
        _pull(bank.springs[view], image, pulls, constants)
        image *= unit
        pulls *= unit
        x16, y16, squares, estimates = rank_x[view], rank_y[view], rank_squares[view], estimate[view]
        _estimate(image, pulls, constants, x16, y16, squares, factors[view], count, work, turn[view], estimates)
        if bank.has_partial:
            _leave_unseen(x[view], y[view], bank, view, work, turn[view], estimates)
        at = np.argmin(estimates[:count])
        least[view], first[view] = estimates[at], at


@inner_kernel()
def _project(points, towards, x, y):  # type: ignore[no-untyped-def]
    """Write the centred orthographic image of points (n, 3) from a direction of any length, in any turn."""
    back = normalise(towards)
    up = normalise(most_square_axis(back))
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
    # Removed from each form, by the joint at the other end: a lane each, so sums keep their order.
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
