"""Joint limits for one pose at a time, compiled: the same walk as `joint_limits`, for use inside chains.

Vectors are tuples of three floats, which numba keeps in registers.  The plain form is the oracle of all of it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.plausibility.joint_limits import NUM_ANGLES, SLACK_RAD, TINY
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.skeletons import PAIR17

__all__ = [
    "bone_of",
    "carry",
    "cross",
    "dot",
    "frame_x",
    "measure_angles",
    "move_to_nearest_valid",
    "scale",
    "turn_to",
]

Array = npt.NDArray[np.float64]
Vector = Any  # (x, y, z); numba infers the tuple type

(
    PELVIS, SPINE, CHEST, NECK, HEAD,
    LEFT_SHOULDER, LEFT_ELBOW, LEFT_WRIST, RIGHT_SHOULDER, RIGHT_ELBOW, RIGHT_WRIST,
    LEFT_HIP, LEFT_KNEE, LEFT_ANKLE, RIGHT_HIP, RIGHT_KNEE, RIGHT_ANKLE,
) = range(17)  # fmt: skip

_INDEX = {(angle.joint, angle.angle): index for index, angle in enumerate(ANGLES)}
_HIP_ELEVATION = _INDEX["left_hip", "elevation"]
_HIP_SPREAD = _INDEX["pelvis", "hip_spread"]
_SPINE = _INDEX["spine", "flexion"]
_TORSION = _INDEX["spine", "torsion"]
_SHOULDER_ELEVATION = _INDEX["left_shoulder", "elevation"]
_SHOULDER_SPREAD = _INDEX["chest", "shoulder_spread"]
_CHEST = _INDEX["chest", "flexion"]
_NECK = _INDEX["neck", "flexion"]
_ARM = _INDEX["left_shoulder", "extension"]
_ELBOW = _INDEX["left_elbow", "flexion"]
_HIP = _INDEX["left_hip", "flexion"]
_KNEE = _INDEX["left_knee", "flexion"]
_NUM_ANGLES = NUM_ANGLES
_SLACK = SLACK_RAD
_TINY = TINY
_TWO_PI = 2.0 * math.pi

assert PAIR17.indices(("left_shoulder", "right_shoulder", "left_hip", "right_hip")) == [5, 8, 11, 14]


# A dict, because the type stubs of numba do not know these two options.
_NO_ENTRIES: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_inner = njit(cache=True, nogil=True, error_model="numpy", **_NO_ENTRIES)
"""For functions that only compiled code calls: without the entries from Python they compile in a third of the time."""


@_inner
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_inner
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@_inner
def _mix(s: float, a: Vector, t: float, b: Vector) -> Vector:
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@_inner
def scale(s: float, a: Vector) -> Vector:
    """A vector s times as long."""
    return (s * a[0], s * a[1], s * a[2])


@_inner
def _unit(a: Vector) -> Vector:
    length = math.sqrt(dot(a, a))
    if length > 1e-12:
        return (a[0] / length, a[1] / length, a[2] / length)
    return (0.0, 0.0, 0.0)


@_inner
def bone_of(points: Array, start: int, end: int) -> Vector:
    """Unit direction from joint `start` to joint `end`; zero when they coincide."""
    return _unit(
        (
            points[end, 0] - points[start, 0],
            points[end, 1] - points[start, 1],
            points[end, 2] - points[start, 2],
        )
    )


@_inner
def carry(start: Vector, end: Vector, vector: Vector) -> Vector:
    """`vector` carried along the shortest turn from unit `start` to unit `end`."""
    total = (start[0] + end[0], start[1] + end[1], start[2] + end[2])
    factor = dot(total, vector) / max(1.0 + dot(start, end), _TINY)
    twice = 2.0 * dot(start, vector)
    return (
        vector[0] - factor * total[0] + twice * end[0],
        vector[1] - factor * total[1] + twice * end[1],
        vector[2] - factor * total[2] + twice * end[2],
    )


@_inner
def _arcsin(value: float) -> float:
    return math.asin(min(1.0, max(-1.0, value)))


@_inner
def _wrap(angle: float) -> float:
    return (angle + math.pi) % _TWO_PI - math.pi


@_inner
def frame_x(points: Array, left: int, right: int, up: Vector) -> Vector:
    """Unit direction from joint `right` to joint `left`, made square to `up`."""
    across = (
        points[left, 0] - points[right, 0],
        points[left, 1] - points[right, 1],
        points[left, 2] - points[right, 2],
    )
    return _unit(_mix(1.0, across, -dot(across, up), up))


@_inner
def _change(index: int, value: float, slack: float, limits: Array, work: Array, move: bool) -> float:
    work[0, index] = value
    work[1, index] = slack
    if not move:
        return 0.0
    low, high = limits[0, index] - slack, limits[1, index] + slack
    if (low - _TINY <= value <= high + _TINY) or high - low >= _TWO_PI:
        return 0.0
    above, below = _wrap(value - high), _wrap(value - low)
    return -above if abs(above) < abs(below) else -below


@_inner
def _turn(points: Array, first: int, last: int, pivot: int, axis: Vector, cosine: float, sine: float) -> None:
    """Turn joints `first` to `last` (inclusive) about a unit axis through joint `pivot`."""
    px, py, pz = points[pivot, 0], points[pivot, 1], points[pivot, 2]
    for joint in range(first, last + 1):
        v = (points[joint, 0] - px, points[joint, 1] - py, points[joint, 2] - pz)
        c = cross(axis, v)
        along = (1.0 - cosine) * dot(axis, v)
        points[joint, 0] = px + cosine * v[0] + sine * c[0] + along * axis[0]
        points[joint, 1] = py + cosine * v[1] + sine * c[1] + along * axis[1]
        points[joint, 2] = pz + cosine * v[2] + sine * c[2] + along * axis[2]


@_inner
def turn_to(points: Array, first: int, last: int, pivot: int, before: Vector, after: Vector) -> None:
    """Turn joints `first` to `last` (inclusive) about joint `pivot` by the shortest turn between unit directions."""
    turned = cross(before, after)
    sine = math.sqrt(dot(turned, turned))
    cosine = dot(before, after)
    if sine > 1e-12:
        axis = scale(1.0 / sine, turned)
    elif cosine < 0.0:
        # Opposite directions: half a turn about some square axis.
        helper = (1.0, 0.0, 0.0) if abs(before[0]) < 0.9 else (0.0, 1.0, 0.0)
        axis = _unit(cross(before, helper))
    else:
        return
    angle = math.atan2(sine, cosine)
    _turn(points, first, last, pivot, axis, math.cos(angle), math.sin(angle))


@_inner
def _girdle(
    points: Array,
    centre: int,
    up: Vector,
    left: int,
    right: int,
    index: int,
    spread_index: int,
    limits: Array,
    work: Array,
    move: bool,
) -> None:
    for side in range(2):
        joint = left if side == 0 else right
        direction = bone_of(points, centre, joint)
        elevation = _arcsin(dot(direction, up))
        change = _change(index + side, elevation, 0.0, limits, work, move)
        if change != 0.0:
            level = _unit(_mix(1.0, direction, -dot(direction, up), up))
            target = elevation + change
            turn_to(points, joint, joint + 2, centre, direction, _mix(math.cos(target), level, math.sin(target), up))
    one, two = bone_of(points, centre, left), bone_of(points, centre, right)
    one = _mix(1.0, one, -dot(one, up), up)
    two = _mix(1.0, two, -dot(two, up), up)
    spread = math.atan2(dot(cross(one, two), up), dot(one, two)) % _TWO_PI
    change = _change(spread_index, spread, 0.0, limits, work, move)
    if change != 0.0:
        cosine, sine = math.cos(0.5 * change), math.sin(0.5 * change)
        _turn(points, left, left + 2, centre, up, cosine, -sine)
        _turn(points, right, right + 2, centre, up, cosine, sine)


@_inner
def _swing(
    points: Array,
    joint: int,
    end: int,
    first: int,
    last: int,
    up: Vector,
    left: Vector,
    front: Vector,
    index: int,
    limits: Array,
    work: Array,
    move: bool,
) -> bool:
    """Flexion at `index`, the lateral angle right after it; tells whether the bone moved."""
    direction = bone_of(points, joint, end)
    sideways = _arcsin(dot(direction, left))
    change_sideways = _change(index + 1, sideways, 0.0, limits, work, move)
    sideways += change_sideways
    flexion = math.atan2(dot(direction, front), dot(direction, up))
    slack = _SLACK * (1.0 / max(math.cos(sideways), _TINY) - 1.0)
    change_flexion = _change(index, flexion, slack, limits, work, move)
    if change_sideways == 0.0 and change_flexion == 0.0:
        return False
    flexion += change_flexion
    level = _mix(math.cos(flexion), up, math.sin(flexion), front)
    after = _mix(math.cos(sideways), level, math.sin(sideways), left)
    turn_to(points, first, last, joint, direction, after)
    return True


@_inner
def _arm(
    points: Array,
    shoulder: int,
    back: Vector,
    across: Vector,
    index: int,
    limits: Array,
    work: Array,
    move: bool,
) -> None:
    direction = bone_of(points, shoulder, shoulder + 1)
    b, m = dot(direction, back), dot(direction, across)
    change_b = _change(index, _arcsin(b), 0.0, limits, work, move)
    change_m = _change(index + 1, _arcsin(m), 0.0, limits, work, move)
    if not move:
        return
    up = cross(back, across)
    rest = dot(direction, up)
    most_b, most_m = math.sin(limits[1, index]), math.sin(limits[1, index + 1])
    side_of = -1.0 if rest < 0 else 1.0
    is_moved = change_b != 0.0 or change_m != 0.0
    if change_b != 0.0:
        grown = math.sqrt((1.0 - most_b**2) / max(m**2 + rest**2, _TINY))
        b, m, rest = most_b, m * grown, rest * grown
    if m > most_m + _TINY:
        is_moved = True
        grown = math.sqrt((1.0 - most_m**2) / max(b**2 + rest**2, _TINY))
        b = min(b * grown, most_b, math.sqrt(1.0 - most_m**2))
        m = most_m
        rest = side_of * math.sqrt(max(1.0 - m**2 - b**2, 0.0))
    if is_moved:
        after = _mix(1.0, _mix(b, back, m, across), rest, up)
        turn_to(points, shoulder + 1, shoulder + 2, shoulder, direction, after)


@_inner
def _hinge(
    points: Array,
    joint: int,
    rest: Vector,
    bend: Vector,
    outward: Vector,
    rotation_index: int,
    flexion_index: int,
    limits: Array,
    work: Array,
    move: bool,
) -> None:
    above, below = bone_of(points, joint, joint + 1), bone_of(points, joint + 1, joint + 2)
    along = dot(above, below)
    across = _mix(1.0, below, -along, above)
    sine = math.sqrt(dot(across, across))
    flexion = math.atan2(sine, along)
    change_flexion = _change(flexion_index, flexion, 0.0, limits, work, move)
    certainty = sine if along > 0 else 1.0
    carried_bend, carried_out = carry(rest, above, bend), carry(rest, above, outward)
    rotation = math.atan2(dot(across, carried_out), dot(across, carried_bend)) if sine > _TINY else 0.0
    slack = _SLACK / max(certainty, _TINY)
    change = _change(rotation_index, rotation, slack, limits, work, move)
    if change_flexion != 0.0:
        bent = flexion + change_flexion
        after = _mix(math.cos(bent), above, math.sin(bent), _unit(across))
        turn_to(points, joint + 2, joint + 2, joint + 1, below, after)
    if change != 0.0:
        handed = -1.0 if dot(cross(carried_bend, carried_out), above) < 0 else 1.0
        _turn(points, joint + 2, joint + 2, joint + 1, above, math.cos(change), handed * math.sin(change))


@_inner
def _walk(points: Array, limits: Array, work: Array, move: bool) -> None:
    y = bone_of(points, PELVIS, SPINE)
    _girdle(points, PELVIS, y, LEFT_HIP, RIGHT_HIP, _HIP_ELEVATION, _HIP_SPREAD, limits, work, move)
    x = frame_x(points, LEFT_HIP, RIGHT_HIP, y)
    z = cross(x, y)
    _swing(points, SPINE, CHEST, CHEST, RIGHT_WRIST, y, x, z, _SPINE, limits, work, move)
    up = bone_of(points, SPINE, CHEST)
    _girdle(
        points, CHEST, up, LEFT_SHOULDER, RIGHT_SHOULDER, _SHOULDER_ELEVATION, _SHOULDER_SPREAD,
        limits, work, move,
    )  # fmt: skip
    shoulders_x = frame_x(points, LEFT_SHOULDER, RIGHT_SHOULDER, up)
    carried = carry(y, up, x)
    torsion = math.atan2(dot(cross(carried, shoulders_x), up), dot(carried, shoulders_x))
    change = _change(_TORSION, torsion, 0.0, limits, work, move)
    if change != 0.0:
        _turn(points, NECK, RIGHT_WRIST, CHEST, up, math.cos(change), math.sin(change))
        shoulders_x = frame_x(points, LEFT_SHOULDER, RIGHT_SHOULDER, up)
    front = cross(shoulders_x, up)
    _swing(points, CHEST, NECK, NECK, HEAD, up, shoulders_x, front, _CHEST, limits, work, move)
    up_neck = bone_of(points, CHEST, NECK)
    neck_x = _unit(_mix(1.0, shoulders_x, -dot(shoulders_x, up_neck), up_neck))
    neck_z = cross(neck_x, up_neck)
    _swing(points, NECK, HEAD, HEAD, HEAD, up_neck, neck_x, neck_z, _NECK, limits, work, move)
    for side in range(2):
        sign = 1.0 if side == 0 else -1.0
        outward = scale(sign, shoulders_x)
        shoulder = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        arm = _ARM + 3 * side
        _arm(points, shoulder, scale(-1.0, front), scale(-1.0, outward), arm, limits, work, move)
        _hinge(points, shoulder, outward, front, up, arm + 2, _ELBOW + side, limits, work, move)
        outward = scale(sign, x)
        down = scale(-1.0, y)
        hip = LEFT_HIP if side == 0 else RIGHT_HIP
        leg = _HIP + 3 * side
        _swing(points, hip, hip + 1, hip + 1, hip + 2, down, outward, z, leg, limits, work, move)
        _hinge(
            points, hip, down, scale(-1.0, z), scale(-1.0, outward), leg + 2, _KNEE + side,
            limits, work, move,
        )  # fmt: skip


@_inner
def _count(limits: Array, work: Array) -> int:
    count = 0
    for index in range(_NUM_ANGLES):
        low, high = limits[0, index] - work[1, index], limits[1, index] + work[1, index]
        is_inside = low - _TINY <= work[0, index] <= high + _TINY
        if not is_inside and high - low < _TWO_PI:
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def measure_angles(pose: Array, work: Array) -> None:
    """Write the angles and their slack into `work` (2, 29), radians, of one pose (17, 3); the pose is not changed."""
    _walk(pose, work, work, False)


@njit(cache=True, nogil=True, error_model="numpy")
def move_to_nearest_valid(pose: Array, limits: Array, work: Array, valid: Array) -> tuple[int, float]:
    """Find the nearest valid pose of one pose, as `JointLimits.nearest_valid` does.

    Args:
        pose: Positions (17, 3), float64, metres; not changed.
        limits: Least and greatest valid angles, (2, 29), radians: `JointLimits.lower_rad` and `upper_rad`.
        work: Scratch (2, 29), overwritten.
        valid: The valid pose is written here, (17, 3).

    Returns:
        Number of invalid angles of `pose`, and the sum over the joints of the squared distance moved (square metres).
        A valid pose returns (0, 0.0) after the angles alone.
    """
    # Not `valid[:] = pose`: its error message alone takes seconds to compile.
    for joint in range(17):
        for axis in range(3):
            valid[joint, axis] = pose[joint, axis]
    _walk(valid, limits, work, False)
    num_invalid = _count(limits, work)
    if num_invalid == 0:
        return 0, 0.0
    _walk(valid, limits, work, True)
    total = 0.0
    for joint in range(17):
        for axis in range(3):
            total += (valid[joint, axis] - pose[joint, axis]) ** 2
    return num_invalid, total
