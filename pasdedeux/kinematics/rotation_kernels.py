"""Vectors, segments and unit quaternions inside compiled loops: tuples of floats, which numba keeps in registers.

Conventions as in `rotations`: quaternions (x, y, z, w), rotation vectors in radians, the left factor turns last.  Only
compiled code can call these functions.
"""

from __future__ import annotations

import math
from typing import Any

from pasdedeux.compiled import inner_kernel

Vector = Any  # (x, y, z); numba infers the tuple type
Quaternion = Any  # (x, y, z, w)
_TINY = 1e-12


@inner_kernel()
def row_of(points: Any, row: int) -> Vector:
    """Return row `row` of an array (n, 3) as a vector."""
    return (points[row, 0], points[row, 1], points[row, 2])


@inner_kernel()
def put_row(points: Any, row: int, vector: Vector) -> None:
    """Set row `row` of an array (n, 3)."""
    points[row, 0], points[row, 1], points[row, 2] = vector


@inner_kernel()
def unitquat_of(rotations: Any, row: int) -> Quaternion:
    """Return row `row` of an array (n, 4) as a rotation."""
    return (rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3])


@inner_kernel()
def put_unitquat(rotations: Any, row: int, q: Quaternion) -> None:
    """Set row `row` of an array (n, 4)."""
    rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3] = q


@inner_kernel()
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel()
def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner_kernel()
def length(a: Vector) -> float:
    """Return the length of a vector."""
    return math.sqrt(dot(a, a))


@inner_kernel()
def subtract(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inner_kernel()
def scale(factor: float, a: Vector) -> Vector:
    """Return a vector `factor` times as long."""
    return (factor * a[0], factor * a[1], factor * a[2])


@inner_kernel()
def divide(a: Vector, size: float) -> Vector:
    """Return a / size."""
    return (a[0] / size, a[1] / size, a[2] / size)


@inner_kernel()
def weighted_sum(s: float, a: Vector, t: float, b: Vector) -> Vector:
    """Return s a + t b."""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@inner_kernel()
def normalise(a: Vector) -> Vector:
    """Return the unit vector along `a`; zero where `a` is."""
    size = length(a)
    if size > _TINY:
        return divide(a, size)
    return (0.0, 0.0, 0.0)


@inner_kernel()
def carry(start: Vector, end: Vector, vector: Vector) -> Vector:
    """Return `vector` carried along the shortest turn from unit `start` to unit `end`."""
    total = (start[0] + end[0], start[1] + end[1], start[2] + end[2])
    factor = dot(total, vector) / max(1.0 + dot(start, end), 1e-9)
    twice = 2.0 * dot(start, vector)
    return (
        vector[0] - factor * total[0] + twice * end[0],
        vector[1] - factor * total[1] + twice * end[1],
        vector[2] - factor * total[2] + twice * end[2],
    )


@inner_kernel()
def closest_on_segments(aa: float, bb: float, ab: float, ag: float, bg: float, parallel: float) -> tuple[float, float]:
    """Return the closest points of segments a and b as parameters (0 at their starts, 1 at their ends).

    Ericson (2004), "Real-Time Collision Detection", section 5.1.9: the parameter on one segment is solved, clamped, and
    the other follows.  A segment may be a point.

    Args:
        aa: Squared length of a.
        bb: Squared length of b.
        ab: Scalar product of a and b.
        ag: Of a and the vector g from the start of b to the start of a.
        bg: Of b and g.
        parallel: Where to begin on a if a and b are parallel, 0 to 1.
    """
    tiny = 1e-18
    determinant = aa * bb - ab * ab
    is_skew = determinant > 1e-12 * aa * bb + tiny
    s = min(1.0, max(0.0, (ab * bg - ag * bb) / determinant)) if is_skew else parallel
    t = (ab * s + bg) / bb if bb > tiny else 0.0
    inside = min(1.0, max(0.0, t))
    if t != inside or not is_skew:
        s = min(1.0, max(0.0, (ab * inside - ag) / max(aa, tiny)))
    if aa <= tiny:
        s = 0.0
    return s, inside


@inner_kernel()
def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Compose rotations: `right` first, then `left`."""
    return (
        left[3] * right[0] + left[0] * right[3] + left[1] * right[2] - left[2] * right[1],
        left[3] * right[1] - left[0] * right[2] + left[1] * right[3] + left[2] * right[0],
        left[3] * right[2] + left[0] * right[1] - left[1] * right[0] + left[2] * right[3],
        left[3] * right[3] - left[0] * right[0] - left[1] * right[1] - left[2] * right[2],
    )


@inner_kernel()
def conjugate(q: Quaternion) -> Quaternion:
    """Invert a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


@inner_kernel()
def rotate(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector by a unit quaternion: v + w t + q x t of t = 2 q x v."""
    t = scale(2.0, cross(q, v))
    return (
        v[0] + q[3] * t[0] + q[1] * t[2] - q[2] * t[1],
        v[1] + q[3] * t[1] + q[2] * t[0] - q[0] * t[2],
        v[2] + q[3] * t[2] + q[0] * t[1] - q[1] * t[0],
    )


@inner_kernel()
def unitquat_from_rotvec(rotvec: Vector) -> Quaternion:
    """Return the unit quaternion of a rotation vector in radians; zero gives the identity."""
    angle = length(rotvec)
    factor = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return (rotvec[0] * factor, rotvec[1] * factor, rotvec[2] * factor, math.cos(0.5 * angle))


@inner_kernel()
def rotvec_from_unitquat(q: Quaternion) -> Vector:
    """Return the shortest rotation vector in radians of a unit quaternion."""
    if q[3] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    sine = length(q)
    return scale(2.0 if sine < _TINY else 2.0 * math.atan2(sine, q[3]) / sine, q)


@inner_kernel()
def swing_between(start: Vector, end: Vector) -> Quaternion:
    """Return the shortest rotation of direction `start` into `end`, which need not be unit.

    Opposite directions turn half way about some axis square to `start`; an empty direction gives the identity.
    """
    a, b = normalise(start), normalise(end)
    if dot(a, a) == 0.0 or dot(b, b) == 0.0:
        return (0.0, 0.0, 0.0, 1.0)
    cosine = dot(a, b)
    if cosine < -1.0 + 1e-10:
        axis = normalise(cross(a, (1.0, 0.0, 0.0) if abs(a[0]) < 0.9 else (0.0, 1.0, 0.0)))
        return (axis[0], axis[1], axis[2], 0.0)
    axis = cross(a, b)
    norm = 1.0 / math.sqrt(dot(axis, axis) + (1.0 + cosine) ** 2)
    return (axis[0] * norm, axis[1] * norm, axis[2] * norm, (1.0 + cosine) * norm)


@inner_kernel()
def unitquat_from_axes(x: Vector, y: Vector, z: Vector) -> Quaternion:
    """Return the unit quaternion, w >= 0, of the rotation matrix with these columns."""
    trace = x[0] + y[1] + z[2]
    largest = max(x[0], y[1], z[2], trace)
    if largest == x[0]:
        q = (1.0 + 2.0 * x[0] - trace, y[0] + x[1], z[0] + x[2], y[2] - z[1])
    elif largest == y[1]:
        q = (y[0] + x[1], 1.0 + 2.0 * y[1] - trace, z[1] + y[2], z[0] - x[2])
    elif largest == z[2]:
        q = (z[0] + x[2], z[1] + y[2], 1.0 + 2.0 * z[2] - trace, x[1] - y[0])
    else:
        q = (y[2] - z[1], z[0] - x[2], x[1] - y[0], 1.0 + trace)
    norm = 1.0 / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if q[3] < 0:
        norm = -norm
    return (q[0] * norm, q[1] * norm, q[2] * norm, q[3] * norm)
