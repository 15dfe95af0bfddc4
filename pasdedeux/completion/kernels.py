"""Compiled loops over draws: their distances from an image under a view, and from a pair in 3D."""

from __future__ import annotations

import math

import numpy as np

from pasdedeux.arrays import Array, Floats32, Integers
from pasdedeux.compiled import compiled
from pasdedeux.interaction.kernels import best_turn, turned_squares

LANES = 256
"""Number of draws side by side in memory, over which arithmetic runs."""


@compiled(fastmath=True)
def write_view_distances(
    points: Floats32, tilt: Floats32, direction: Floats32, image: Floats32, joints: Integers, out: Floats32
) -> None:
    """Write the squared distance of every draw, seen from one view and turned best in the plane, from an image.

    Args:
        points: Draws in their own local frames with j along y, joints in the order of the index,
            (block, joint, 3, LANES), metres.
        tilt: Sine and cosine of the angle between i and j of each draw, (block, 2, LANES).
        direction: View (a, b, c) in the local frame, (3,).
        image: Centred image points of the joints compared, (m, 2), metres.
        joints: The compared joints, in the order of the index, (m,).
        out: Squared distances summed over the joints, (block, LANES), square metres; may be a little below 0.
    """
    count = np.float32(joints.shape[0])
    unit = np.float32(1.0)
    two = np.float32(2.0)
    basis, sums = np.empty((6, LANES), np.float32), np.empty((5, LANES), np.float32)
    wx, wy, side, p, q, r = basis[0], basis[1], basis[2], basis[3], basis[4], basis[5]
    a, b, u_sum, v_sum, square_sum = sums[0], sums[1], sums[2], sums[3], sums[4]
    squares = np.float32(0.0)
    for at in range(image.shape[0]):
        squares += image[at, 0] * image[at, 0] + image[at, 1] * image[at, 1]
    for block in range(points.shape[0]):
        for lane in range(LANES):
            sine, cosine = tilt[block, 0, lane], tilt[block, 1, lane]
            x = sine * direction[0]
            y = cosine * direction[0] + direction[1]
            z = sine * direction[2]
            length = unit / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-30))
            x, y, z = x * length, y * length, z * length
            # Two unit vectors square to the view, without a branch (Duff et al. 2017, "Building an orthonormal basis,
            # revisited"): (1 + g p, g q, -g x) and (q, g + r, -y).
            g = np.float32(math.copysign(1.0, z))
            h = -unit / (g + z)
            wx[lane], wy[lane], side[lane] = x, y, g
            p[lane], q[lane], r[lane] = unit + g * x * x * h, x * y * h, g + y * y * h
            a[lane] = b[lane] = u_sum[lane] = v_sum[lane] = square_sum[lane] = np.float32(0.0)
        for at in range(joints.shape[0]):
            joint = joints[at]
            ix, iy = image[at, 0], image[at, 1]
            xs, ys, zs = points[block, joint, 0], points[block, joint, 1], points[block, joint, 2]
            for lane in range(LANES):
                x, y, z, g = xs[lane], ys[lane], zs[lane], side[lane]
                u = p[lane] * x + g * q[lane] * y - g * wx[lane] * z
                v = q[lane] * x + r[lane] * y - wy[lane] * z
                a[lane] += u * ix + v * iy
                b[lane] += u * iy - v * ix
                u_sum[lane] += u
                v_sum[lane] += v
                square_sum[lane] += u * u + v * v
        for lane in range(LANES):
            best = np.sqrt(a[lane] * a[lane] + b[lane] * b[lane])
            centred = square_sum[lane] - (u_sum[lane] * u_sum[lane] + v_sum[lane] * v_sum[lane]) / count
            out[block, lane] = squares + centred - two * best


@compiled()
def rewrite_view_distances(
    points: Floats32, directions: Array, which: Integers, image: Array, joints: Integers, ceiling: float, out: Array
) -> None:
    """Write the same squared distances in double precision for some draws, each under its own view.

    Args:
        points: Draws as in `write_view_distances`, but one after the other, (draw, joint, 3), metres.
        directions: World directions towards the camera in the frame of `points`, (n, 3), unit.
        which: Indices of the draws, (n,).
        image: Centred image points (m, 2), metres.
        joints: Joints compared, (m,).
        ceiling: Draws farther than this by the first half of the joints stay at infinity, square metres.
        out: Squared distances (n,), square metres.
    """
    count = joints.shape[0]
    half = count // 2
    for row in range(which.shape[0]):
        x, y, z = directions[row, 0], directions[row, 1], directions[row, 2]
        g = math.copysign(1.0, z)
        h = -1.0 / (g + z)
        p, q, r = 1.0 + g * x * x * h, x * y * h, g + y * y * h
        a = b = u_sum = v_sum = total = ix_sum = iy_sum = 0.0
        out[row] = np.inf
        for at in range(count):
            joint = joints[at]
            px, py, pz = points[which[row], joint, 0], points[which[row], joint, 1], points[which[row], joint, 2]
            u = p * px + g * q * py - g * x * pz
            v = q * px + r * py - y * pz
            ix, iy = image[at, 0], image[at, 1]
            a += u * ix + v * iy
            b += u * iy - v * ix
            u_sum += u
            v_sum += v
            ix_sum += ix
            iy_sum += iy
            total += u * u + v * v + ix * ix + iy * iy
            if at == half:
                seen = at + 1.0
                near_a = a - (u_sum * ix_sum + v_sum * iy_sum) / seen
                near_b = b - (u_sum * iy_sum - v_sum * ix_sum) / seen
                squares = (u_sum * u_sum + v_sum * v_sum + ix_sum * ix_sum + iy_sum * iy_sum) / seen
                if total - squares - 2.0 * math.hypot(near_a, near_b) > ceiling:
                    break
        else:
            squares = (u_sum * u_sum + v_sum * v_sum) / count
            out[row] = max(total - squares - 2.0 * math.hypot(a, b), 0.0)


@compiled()
def fill_rigid_residuals(pairs: Floats32, joints: Integers, fixed: Array, out: Array) -> None:
    """Write the squared distance of every draw from a 3D pair over some joints, after the best proper rigid motion.

    Args:
        pairs: Draws (draw, joint, 3), metres.
        joints: Joints compared, (m,).
        fixed: The pair's joints, centred, (m, 3), metres.
        out: Squared distances summed over the joints, (draw,), square metres.
    """
    count = joints.shape[0]
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    moving = np.empty((count, 3))
    centre = np.empty(3)
    for draw in range(pairs.shape[0]):
        centre[:] = 0.0
        for at in range(count):
            for axis in range(3):
                moving[at, axis] = pairs[draw, joints[at], axis]
                centre[axis] += moving[at, axis] / count
        for at in range(count):
            for axis in range(3):
                moving[at, axis] -= centre[axis]
        best_turn(moving, fixed, key, m, q, rotmat)
        out[draw] = turned_squares(rotmat, moving, fixed)
