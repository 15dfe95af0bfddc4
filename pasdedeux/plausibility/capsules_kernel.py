"""Capsule penetration of one pair at a time, compiled, for use inside chains and over long clips."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

__all__ = ["clip_penetration", "pair_penetration"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@njit(cache=True, nogil=True)
def _clip(value: float) -> float:
    return min(1.0, max(0.0, value))


@njit(cache=True, nogil=True)
def _depth(a: Array, parent_a: int, child_a: int, b: Array, parent_b: int, child_b: int, reach: float) -> float:
    """Penetration depth of two capsules whose radii sum to `reach`; 0 when they are apart."""
    ax, ay, az = a[parent_a, 0], a[parent_a, 1], a[parent_a, 2]
    bx, by, bz = b[parent_b, 0], b[parent_b, 1], b[parent_b, 2]
    ux, uy, uz = a[child_a, 0] - ax, a[child_a, 1] - ay, a[child_a, 2] - az
    vx, vy, vz = b[child_b, 0] - bx, b[child_b, 1] - by, b[child_b, 2] - bz
    gx, gy, gz = ax - bx, ay - by, az - bz
    aa = ux * ux + uy * uy + uz * uz
    bb = vx * vx + vy * vy + vz * vz
    # Balls round the two bones: far apart is told without a division.
    mx, my, mz = gx + 0.5 * (ux - vx), gy + 0.5 * (uy - vy), gz + 0.5 * (uz - vz)
    far = reach + 0.5 * (math.sqrt(aa) + math.sqrt(bb))
    if mx * mx + my * my + mz * mz >= far * far:
        return 0.0
    ab = ux * vx + uy * vy + uz * vz
    ag = ux * gx + uy * gy + uz * gz
    bg = vx * gx + vy * gy + vz * gz
    tiny = 1e-18
    determinant = aa * bb - ab * ab
    is_skew = determinant > 1e-12 * aa * bb + tiny
    s = _clip((ab * bg - ag * bb) / determinant) if is_skew else 0.0
    t = (ab * s + bg) / bb if bb > tiny else 0.0
    inside = _clip(t)
    if t != inside or not is_skew:
        s = _clip((ab * inside - ag) / max(aa, tiny))
    if aa <= tiny:
        s = 0.0
    dx, dy, dz = gx + s * ux - inside * vx, gy + s * uy - inside * vy, gz + s * uz - inside * vz
    return max(reach - math.sqrt(dx * dx + dy * dy + dz * dz), 0.0)


@njit(cache=True, nogil=True)
def pair_penetration(
    pair: Array, radii: Array, parents: Indices, within: Indices, between: Indices, out: Array
) -> float:
    """Return the sum of penetration depths of one pair, metres.

    Args:
        pair: Positions (person=2, J, 3), float64, metres.
        radii: Radii (person=2, J), metres.
        parents: `CapsuleModel.parents`, (J,).
        within: `CapsuleModel.within`, (pair, 2).
        between: `CapsuleModel.between`, (pair, 2).
        out: The sums within person A, within person B and between them are written here, (3,).
    """
    for person in range(2):
        total = 0.0
        points, radius = pair[person], radii[person]
        for row in range(within.shape[0]):
            one, other = within[row, 0], within[row, 1]
            total += _depth(points, parents[one], one, points, parents[other], other, radius[one] + radius[other])
        out[person] = total
    total = 0.0
    for row in range(between.shape[0]):
        one, other = between[row, 0], between[row, 1]
        total += _depth(pair[0], parents[one], one, pair[1], parents[other], other, radii[0, one] + radii[1, other])
    out[2] = total
    return out[0] + out[1] + out[2]


@njit(cache=True, nogil=True)
def clip_penetration(pairs: Array, radii: Array, parents: Indices, within: Indices, between: Indices) -> Array:
    """Return the sums within A, within B and between them, (frame, 3), of pairs (frame, person=2, J, 3), metres."""
    sums = np.empty((pairs.shape[0], 3))
    for frame in range(pairs.shape[0]):
        pair_penetration(pairs[frame], radii, parents, within, between, sums[frame])
    return sums
