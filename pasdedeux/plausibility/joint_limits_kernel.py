"""Compiled joint limits: walk over the joints of a pose, measure angles, and move bad ones.

`joint_limits` defines the angles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.kinematics.rotation_kernels import (
    Vector,
    carry,
    cross,
    dot,
    length,
    normalise,
    row_of,
    scale,
    subtract,
    weighted_sum,
)
from pasdedeux.plausibility.ranges import ANGLE_INDEX, NUM_ANGLES, SLACK_RAD, TINY
from pasdedeux.skeletons import PAIR17

(
    PELVIS, SPINE, CHEST, NECK, HEAD,
    LEFT_SHOULDER, LEFT_ELBOW, LEFT_WRIST, RIGHT_SHOULDER, RIGHT_ELBOW, RIGHT_WRIST,
    LEFT_HIP, LEFT_KNEE, LEFT_ANKLE, RIGHT_HIP, RIGHT_KNEE, RIGHT_ANKLE,
) = range(17)  # fmt: skip

_HIP_ELEVATION = ANGLE_INDEX["left_hip", "elevation"]
_HIP_SPREAD = ANGLE_INDEX["pelvis", "hip_spread"]
_SPINE = ANGLE_INDEX["spine", "flexion"]
_TORSION = ANGLE_INDEX["spine", "torsion"]
_SHOULDER_ELEVATION = ANGLE_INDEX["left_shoulder", "elevation"]
_SHOULDER_SPREAD = ANGLE_INDEX["chest", "shoulder_spread"]
_CHEST = ANGLE_INDEX["chest", "flexion"]
_NECK = ANGLE_INDEX["neck", "flexion"]
_ARM = ANGLE_INDEX["left_shoulder", "extension"]
_ELBOW = ANGLE_INDEX["left_elbow", "flexion"]
_HIP = ANGLE_INDEX["left_hip", "flexion"]
_KNEE = ANGLE_INDEX["left_knee", "flexion"]
_TWO_PI = 2.0 * math.pi

assert PAIR17.indices(("left_shoulder", "right_shoulder", "left_hip", "right_hip")) == [5, 8, 11, 14]


class _Walk(NamedTuple):
    """Input and output of a walk over the joints.

    Args:
        points: Pose (17, 3), metres; joints move if an angle is out of range.
        limits: Smallest and greatest valid angles, (2, 29), radians.
        measured: The angles before any move, and the slack of their ranges, (2, 29), radians.
        is_limited: Whether joints move; otherwise angles are only measured.
    """

    points: Array
    limits: Array
    measured: Array
    is_limited: bool


@inner_kernel()
def _bone_of(points: Array, start: int, end: int) -> Vector:
    """Return the unit direction from joint `start` to joint `end`; zero when they coincide."""
    return normalise(subtract(row_of(points, end), row_of(points, start)))


@inner_kernel()
def _arcsin(value: float) -> float:
    return math.asin(min(1.0, max(-1.0, value)))


@inner_kernel()
def _angle(sine: float, cosine: float) -> float:
    """Return the angle of a scaled sine and cosine; 0, not half a turn, if an empty bone gives -0."""
    return math.atan2(sine, cosine + 0.0)


@inner_kernel()
def _wrap(angle: float) -> float:
    return (angle + math.pi) % _TWO_PI - math.pi


@inner_kernel()
def _frame_x(points: Array, left: int, right: int, up: Vector) -> Vector:
    """Return the unit direction from joint `right` to joint `left`, made square to `up`."""
    across = subtract(row_of(points, left), row_of(points, right))
    return normalise(weighted_sum(1.0, across, -dot(across, up), up))


@inner_kernel()
def _change(walk: _Walk, index: int, value: float, slack: float) -> float:
    """Write an angle and its slack; return the change to its nearest limit, 0 within the range."""
    walk.measured[0, index] = value
    walk.measured[1, index] = slack
    if not walk.is_limited:
        return 0.0
    low, high = walk.limits[0, index] - slack, walk.limits[1, index] + slack
    if (low - TINY <= value <= high + TINY) or high - low >= _TWO_PI:
        return 0.0
    above, below = _wrap(value - high), _wrap(value - low)
    return -above if abs(above) < abs(below) else -below


@inner_kernel()
def _turn(points: Array, first: int, last: int, pivot: int, axis: Vector, cosine: float, sine: float) -> None:
    """Turn joints `first` to `last` about a unit axis through joint `pivot`; an axis of zero does nothing."""
    if dot(axis, axis) == 0.0:
        return
    px, py, pz = points[pivot, 0], points[pivot, 1], points[pivot, 2]
    for joint in range(first, last + 1):
        v = (points[joint, 0] - px, points[joint, 1] - py, points[joint, 2] - pz)
        c = cross(axis, v)
        along = (1.0 - cosine) * dot(axis, v)
        points[joint, 0] = px + cosine * v[0] + sine * c[0] + along * axis[0]
        points[joint, 1] = py + cosine * v[1] + sine * c[1] + along * axis[1]
        points[joint, 2] = pz + cosine * v[2] + sine * c[2] + along * axis[2]


@inner_kernel()
def _turn_to(points: Array, first: int, last: int, pivot: int, before: Vector, after: Vector) -> None:
    """Turn joints `first` to `last` (inclusive) about joint `pivot` by the shortest turn between unit directions."""
    turned = cross(before, after)
    sine = length(turned)
    cosine = dot(before, after)
    if sine > 1e-12:
        axis = scale(1.0 / sine, turned)
    elif cosine < 0.0:
        # Opposite directions: half a turn about some square axis.
        helper = (1.0, 0.0, 0.0) if abs(before[0]) < 0.9 else (0.0, 1.0, 0.0)
        axis = normalise(cross(before, helper))
    else:
        return
    angle = math.atan2(sine, cosine)
    _turn(points, first, last, pivot, axis, math.cos(angle), math.sin(angle))


@inner_kernel()
def _girdle(walk: _Walk, centre: int, up: Vector, left: int, right: int, index: int, spread_index: int) -> None:
    points = walk.points
    for side in range(2):
        joint = left if side == 0 else right
        direction = _bone_of(points, centre, joint)
        elevation = _arcsin(dot(direction, up))
        change = _change(walk, index + side, elevation, 0.0)
        if change != 0.0:
            level = normalise(weighted_sum(1.0, direction, -dot(direction, up), up))
            target = elevation + change
            _turn_to(
                points, joint, joint + 2, centre, direction, weighted_sum(math.cos(target), level, math.sin(target), up)
            )
    left_bone, right_bone = _bone_of(points, centre, left), _bone_of(points, centre, right)
    left_bone = weighted_sum(1.0, left_bone, -dot(left_bone, up), up)
    right_bone = weighted_sum(1.0, right_bone, -dot(right_bone, up), up)
    spread = _angle(dot(cross(left_bone, right_bone), up), dot(left_bone, right_bone)) % _TWO_PI
    change = _change(walk, spread_index, spread, 0.0)
    if change != 0.0:
        cosine, sine = math.cos(0.5 * change), math.sin(0.5 * change)
        _turn(points, left, left + 2, centre, up, cosine, -sine)
        _turn(points, right, right + 2, centre, up, cosine, sine)


@inner_kernel()
def _swing(
    walk: _Walk, joint: int, end: int, first: int, last: int, up: Vector, left: Vector, front: Vector, index: int
) -> None:
    """Flexion at `index`, the lateral angle right after it."""
    points = walk.points
    direction = _bone_of(points, joint, end)
    sideways = _arcsin(dot(direction, left))
    change_sideways = _change(walk, index + 1, sideways, 0.0)
    sideways += change_sideways
    flexion = _angle(dot(direction, front), dot(direction, up))
    slack = SLACK_RAD * (1.0 / max(math.cos(sideways), TINY) - 1.0)
    change_flexion = _change(walk, index, flexion, slack)
    if change_sideways == 0.0 and change_flexion == 0.0:
        return
    flexion += change_flexion
    level = weighted_sum(math.cos(flexion), up, math.sin(flexion), front)
    after = weighted_sum(math.cos(sideways), level, math.sin(sideways), left)
    _turn_to(points, first, last, joint, direction, after)


@inner_kernel()
def _arm(walk: _Walk, shoulder: int, back: Vector, across: Vector, index: int) -> None:
    points = walk.points
    direction = _bone_of(points, shoulder, shoulder + 1)
    b, m = dot(direction, back), dot(direction, across)
    change_b = _change(walk, index, _arcsin(b), 0.0)
    change_m = _change(walk, index + 1, _arcsin(m), 0.0)
    if change_b == 0.0 and change_m == 0.0:
        return
    up = cross(back, across)
    rest = dot(direction, up)
    max_b, max_m = math.sin(walk.limits[1, index]), math.sin(walk.limits[1, index + 1])
    side_of = -1.0 if rest < 0 else 1.0
    if change_b != 0.0:
        grown = math.sqrt((1.0 - max_b**2) / max(m**2 + rest**2, TINY))
        b, m, rest = max_b, m * grown, rest * grown
    if m > max_m + TINY:
        grown = math.sqrt((1.0 - max_m**2) / max(b**2 + rest**2, TINY))
        b = min(b * grown, max_b, math.sqrt(1.0 - max_m**2))
        m = max_m
        rest = side_of * math.sqrt(max(1.0 - m**2 - b**2, 0.0))
    after = weighted_sum(1.0, weighted_sum(b, back, m, across), rest, up)
    _turn_to(points, shoulder + 1, shoulder + 2, shoulder, direction, after)


@inner_kernel()
def _hinge(
    walk: _Walk, joint: int, rest: Vector, bend: Vector, outward: Vector, rotation_index: int, flexion_index: int
) -> None:
    points = walk.points
    above, below = _bone_of(points, joint, joint + 1), _bone_of(points, joint + 1, joint + 2)
    along = dot(above, below)
    across = weighted_sum(1.0, below, -along, above)
    sine = length(across)
    flexion = _angle(sine, along)
    change_flexion = _change(walk, flexion_index, flexion, 0.0)
    certainty = sine if along > 0 else 1.0
    carried_bend, carried_out = carry(rest, above, bend), carry(rest, above, outward)
    rotation = _angle(dot(across, carried_out), dot(across, carried_bend)) if sine > TINY else 0.0
    slack = SLACK_RAD / max(certainty, TINY)
    change = _change(walk, rotation_index, rotation, slack)
    if change_flexion != 0.0:
        bent = flexion + change_flexion
        after = weighted_sum(math.cos(bent), above, math.sin(bent), normalise(across))
        _turn_to(points, joint + 2, joint + 2, joint + 1, below, after)
    if change != 0.0:
        handed = -1.0 if dot(cross(carried_bend, carried_out), above) < 0 else 1.0
        _turn(points, joint + 2, joint + 2, joint + 1, above, math.cos(change), handed * math.sin(change))


@inner_kernel()
def _walk(walk: _Walk) -> None:
    points = walk.points
    y = _bone_of(points, PELVIS, SPINE)
    _girdle(walk, PELVIS, y, LEFT_HIP, RIGHT_HIP, _HIP_ELEVATION, _HIP_SPREAD)
    x = _frame_x(points, LEFT_HIP, RIGHT_HIP, y)
    z = cross(x, y)
    _swing(walk, SPINE, CHEST, CHEST, RIGHT_WRIST, y, x, z, _SPINE)
    up = _bone_of(points, SPINE, CHEST)
    _girdle(walk, CHEST, up, LEFT_SHOULDER, RIGHT_SHOULDER, _SHOULDER_ELEVATION, _SHOULDER_SPREAD)
    shoulders_x = _frame_x(points, LEFT_SHOULDER, RIGHT_SHOULDER, up)
    carried = carry(y, up, x)
    torsion = _angle(dot(cross(carried, shoulders_x), up), dot(carried, shoulders_x))
    change = _change(walk, _TORSION, torsion, 0.0)
    if change != 0.0:
        _turn(points, NECK, RIGHT_WRIST, CHEST, up, math.cos(change), math.sin(change))
        shoulders_x = _frame_x(points, LEFT_SHOULDER, RIGHT_SHOULDER, up)
    front = cross(shoulders_x, up)
    _swing(walk, CHEST, NECK, NECK, HEAD, up, shoulders_x, front, _CHEST)
    up_neck = _bone_of(points, CHEST, NECK)
    neck_x = normalise(weighted_sum(1.0, shoulders_x, -dot(shoulders_x, up_neck), up_neck))
    neck_z = cross(neck_x, up_neck)
    _swing(walk, NECK, HEAD, HEAD, HEAD, up_neck, neck_x, neck_z, _NECK)
    for side in range(2):
        sign = 1.0 if side == 0 else -1.0
        outward = scale(sign, shoulders_x)
        shoulder = LEFT_SHOULDER if side == 0 else RIGHT_SHOULDER
        arm = _ARM + 3 * side
        _arm(walk, shoulder, scale(-1.0, front), scale(-1.0, outward), arm)
        _hinge(walk, shoulder, outward, front, up, arm + 2, _ELBOW + side)
        outward = scale(sign, x)
        down = scale(-1.0, y)
        hip = LEFT_HIP if side == 0 else RIGHT_HIP
        leg = _HIP + 3 * side
        _swing(walk, hip, hip + 1, hip + 1, hip + 2, down, outward, z, leg)
        _hinge(walk, hip, down, scale(-1.0, z), scale(-1.0, outward), leg + 2, _KNEE + side)


@compiled()
def measure_poses(poses: Array) -> Array:
    """Return the angles and their slack (n, 2, 29), radians, of poses (n, 17, 3)."""
    measured = np.empty((poses.shape[0], 2, NUM_ANGLES))
    for row in range(poses.shape[0]):
        _walk(_Walk(poses[row], measured[row], measured[row], False))
    return measured


@compiled()
def move_to_nearest_valid(pose: Array, limits: Array, measured: Array, valid: Array) -> tuple[int, float]:
    """Find the nearest valid pose of one pose, as `JointLimits.nearest_valid` does.

    Args:
        pose: Positions (17, 3), float64, metres; not changed.
        limits: Smallest and greatest valid angles, (2, 29), radians: `JointLimits.ranges_rad`.
        measured: Scratch (2, 29), overwritten.
        valid: The valid pose is written here, (17, 3).

    Returns:
        Number of invalid angles of `pose`, and the sum over the joints of the squared distance moved (square metres).
        A valid pose returns (0, 0.0) after the angles alone.
    """
    # Not `valid[:] = pose`, whose error message alone takes seconds to compile.
    for joint in range(17):
        for axis in range(3):
            valid[joint, axis] = pose[joint, axis]
    _walk(_Walk(valid, limits, measured, False))
    num_invalid = 0
    for index in range(NUM_ANGLES):
        low, high = limits[0, index] - measured[1, index], limits[1, index] + measured[1, index]
        num_invalid += not (low - TINY <= measured[0, index] <= high + TINY) and high - low < _TWO_PI
    if num_invalid == 0:
        return 0, 0.0
    _walk(_Walk(valid, limits, measured, True))
    squared = 0.0
    for joint in range(17):
        for axis in range(3):
            squared += (valid[joint, axis] - pose[joint, axis]) ** 2
    return num_invalid, squared


@compiled()
def move_poses(poses: Array, limits: Array) -> tuple[Array, Integers, Array]:
    """Return the nearest valid poses (n, 17, 3), how many angles were invalid (n,), and the squared distances (n,)."""
    valid, measured = np.empty(poses.shape), np.empty((2, NUM_ANGLES))
    count, squared = np.empty(poses.shape[0], np.int64), np.empty(poses.shape[0])
    for row in range(poses.shape[0]):
        count[row], squared[row] = move_to_nearest_valid(poses[row], limits, measured, valid[row])
    return valid, count, squared
