"""Compiled images of a pair: its local frame, and its orthographic image under a view."""

from __future__ import annotations

import numpy as np

from pasdedeux.cameras.frames import MIN_SINE
from pasdedeux.compiled import compiled
from pasdedeux.skeletons import PAIR17

_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))
_NUM_JOINTS = PAIR17.num_joints


@compiled()
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    length = np.sqrt(x * x + y * y + z * z)
    if length <= 1e-12:
        return 0.0, 0.0, 0.0, 0.0
    return x / length, y / length, z / length, length


@compiled()
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
    if sine < MIN_SINE or gap < 1e-9:
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
            kept = np.sqrt(1.0 - MIN_SINE * MIN_SINE)
            if cosine < 0.0:
                kept = -kept
            ix = kept * jx + MIN_SINE * ux
            iy = kept * jy + MIN_SINE * uy
            iz = kept * jz + MIN_SINE * uz
    axes[0, 0], axes[1, 0], axes[2, 0] = ix, iy, iz
    axes[0, 1], axes[1, 1], axes[2, 1] = jx, jy, jz
    axes[0, 2], axes[1, 2], axes[2, 2] = iy * jz - iz * jy, iz * jx - ix * jz, ix * jy - iy * jx


@compiled()
def project(points, axes, direction, x, y):  # type: ignore[no-untyped-def]
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
