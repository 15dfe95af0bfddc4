"""Kernels of `body`: place a whole body on op14 joints, close its spine by Newton steps, and reach with its limbs."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.kinematics.rotation_kernels import (
    Quaternion,
    Vector,
    conjugate,
    cross,
    dot,
    length,
    multiply,
    normalise,
    put_row,
    put_unitquat,
    rotate,
    row_of,
    scale,
    subtract,
    swing_between,
    unitquat_from_rotvec,
    unitquat_of,
    weighted_sum,
)
from pasdedeux.reconstruction.bones import REST_DIRECTIONS
from pasdedeux.reconstruction.cleanup import bend_one_leg
from pasdedeux.skeletons import BODY22, OP14

_NECK, _NOSE = OP14.root, OP14.index("head")
_HIPS_AT = np.array(OP14.indices(["left_hip", "right_hip"]))
_SHOULDERS_AT = np.array(OP14.indices(["left_shoulder", "right_shoulder"]))
_PARENTS = np.array(BODY22.parents)
_ORDER = np.array(BODY22.order[1:])
_PELVIS, _SPINE1, _SPINE2, _SPINE3, _NECK22, _HEAD22 = BODY22.indices(
    ["pelvis", "spine1", "spine2", "spine3", "neck", "head"]
)
_COLLARS = np.array(BODY22.indices(["left_collar", "right_collar"]))
_ARMS = np.array(BODY22.arms)
_LEGS = np.array(BODY22.legs)
_TOES = np.array(BODY22.indices(["left_toe", "right_toe"]))
_OP14_ARMS = np.array(OP14.arms)
_OP14_LEGS = np.array(OP14.legs)
_REST_NOSE = tuple(REST_DIRECTIONS[_NOSE].tolist())

_LEAST_WIDTH_M = 1e-3
_MAX_ROUNDS = 30
_CLOSED_M = 1e-10
_MAX_STEP = 0.5
"""Largest turn of all joints together in one step, radians; the tangent holds no further."""
_DAMPING = 1e-9
_GIVES = np.array([0.7, 1.0, 1.0, 1.0, 1.0, 1.0])
"""Relative compliance of pelvis tilt, three spine joints and two collars when the chain is closed."""


@compiled()
def held_hips(positions: Array, lengths: Array, width: float) -> Array:
    """Return op14 positions (frame, 14, 3) with bones of these lengths (14,) and hips `width` apart; the ankles stay.

    In op14, the two bones from the neck to the hips turn independently, so the distance between the hips varies.
    """
    held = positions.copy()
    left, right = lengths[_HIPS_AT[0]], lengths[_HIPS_AT[1]]
    width = min(max(width, abs(left - right) + _LEAST_WIDTH_M), left + right - _LEAST_WIDTH_M)
    out = (left * left - right * right + width * width) / (2.0 * width)
    drop = np.sqrt(left * left - out * out)
    for at in range(positions.shape[0]):
        pose = held[at]
        neck, first, second = row_of(pose, _NECK), row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
        across = normalise(subtract(first, second))
        if dot(across, across) == 0.0:
            across = (1.0, 0.0, 0.0)
        down = subtract(weighted_sum(0.5, first, 0.5, second), neck)
        down = normalise(subtract(down, scale(dot(down, across), across)))
        ahead = cross(down, across)
        for side in range(2):
            hip, knee, ankle = _OP14_LEGS[side, 0], _OP14_LEGS[side, 1], _OP14_LEGS[side, 2]
            aside = out if side == 0 else out - width
            place, end = weighted_sum(1.0, weighted_sum(1.0, neck, drop, down), aside, across), row_of(pose, ankle)
            shift = subtract(place, row_of(pose, hip))
            moved_knee, moved_end = (
                weighted_sum(1.0, row_of(pose, knee), 1.0, shift),
                weighted_sum(1.0, end, 1.0, shift),
            )
            new_knee, new_ankle = bend_one_leg(place, moved_knee, moved_end, end, ahead)
            put_row(pose, hip, place)
            put_row(pose, knee, new_knee)
            put_row(pose, ankle, new_ankle)
    return held


@compiled()
def pose_bodies(
    poses: Array, trunk: Array, bent: Array, nose: Array, offsets: Array, rest: Array, least_toe: float
) -> tuple[Array, Array]:
    """Return pelvis (frame, 3) and local rotations (frame, 22, 4), see `body.pose_body`.

    `rest` (22, 3) has the mid-hip at the origin; `least_toe` is the least height of the toes, metres.
    """
    count = poses.shape[0]
    local, pelvis = np.empty((count, offsets.shape[0], 4)), np.empty((count, 3))
    world, points = np.empty((offsets.shape[0], 4)), np.empty((offsets.shape[0], 3))
    for at in range(count):
        pose = poses[at]
        put_unitquat(world, _PELVIS, multiply(unitquat_of(trunk, at), unitquat_of(bent[at], _PELVIS)))
        _hang_on_hips(pose, world, points, rest)
        _bend(bent[at], world, points, offsets, _SPINE1)
        _close_spine(pose, bent[at], world, points, offsets, rest)
        _face(pose, bent[at], unitquat_of(trunk, at), rotate(unitquat_of(nose, at), _REST_NOSE), world, points, offsets)
        for side in range(2):
            _reach(pose, _OP14_ARMS[side], bent[at], _ARMS[side], world, points, offsets, _COLLARS[side])
            _reach(pose, _OP14_LEGS[side], bent[at], _LEGS[side], world, points, offsets, _PELVIS)
            _put_down(_LEGS[side, 2], _TOES[side], bent[at], world, points, offsets, least_toe)
        put_row(pelvis, at, row_of(points, _PELVIS))
        put_unitquat(local[at], _PELVIS, unitquat_of(world, _PELVIS))
        for joint in _ORDER:
            put_unitquat(
                local[at], joint, multiply(conjugate(unitquat_of(world, _PARENTS[joint])), unitquat_of(world, joint))
            )
    return pelvis, local


@inner_kernel()
def _hang_on_hips(pose: Array, world: Array, points: Array, rest: Array) -> None:
    """Turn the pelvis until the line of its hips is that of the pose, and place it there."""
    left, right = row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
    turn = unitquat_of(world, _PELVIS)
    across = rotate(turn, subtract(row_of(rest, _LEGS[0, 0]), row_of(rest, _LEGS[1, 0])))
    put_unitquat(world, _PELVIS, _unit(multiply(swing_between(across, subtract(left, right)), turn)))
    _place_pelvis(weighted_sum(0.5, left, 0.5, right), world, points, rest)


@inner_kernel()
def _place_pelvis(middle: Vector, world: Array, points: Array, rest: Array) -> None:
    """Place the pelvis so that its hips have this middle."""
    up = rotate(unitquat_of(world, _PELVIS), row_of(rest, _PELVIS))
    put_row(points, _PELVIS, weighted_sum(1.0, middle, 1.0, up))


@inner_kernel()
def _bend(bent: Array, world: Array, points: Array, offsets: Array, first: int) -> None:
    """Turn the trunk as in the match, if `first` is the lowest spine joint, and place spine, collars and shoulders."""
    if first == _SPINE1:
        for joint in (_SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1]):
            put_unitquat(world, joint, multiply(unitquat_of(world, _PARENTS[joint]), unitquat_of(bent, joint)))
    for joint in (_SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1], _ARMS[0, 0], _ARMS[1, 0]):
        _place(joint, world, points, offsets)


@compiled()
def _place(joint: int, world: Array, points: Array, offsets: Array) -> None:
    parent = _PARENTS[joint]
    bone = rotate(unitquat_of(world, parent), row_of(offsets, joint))
    put_row(points, joint, weighted_sum(1.0, row_of(points, parent), 1.0, bone))


@inner_kernel()
def _close_spine(pose: Array, bent: Array, world: Array, points: Array, offsets: Array, rest: Array) -> None:
    """Turn pelvis, spine and collars until they reach the shoulders: Newton steps of least weighted turning."""
    left, right = row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
    middle, hinge = weighted_sum(0.5, left, 0.5, right), normalise(subtract(left, right))
    turning = (_PELVIS, _SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1])
    jacobian, error = np.empty((6, 18)), np.empty(6)
    for _ in range(_MAX_ROUNDS):
        worst = 0.0
        for side in range(2):
            for axis in range(3):
                error[3 * side + axis] = pose[_SHOULDERS_AT[side], axis] - points[_ARMS[side, 0], axis]
                worst = max(worst, abs(error[3 * side + axis]))
        if worst < _CLOSED_M:
            break
        jacobian[:] = 0.0
        for number in range(6):
            joint = turning[number]
            for side in range(2):
                if number >= 4 and number - 4 != side:
                    continue
                shoulder = row_of(points, _ARMS[side, 0])
                arm = subtract(shoulder, middle if number == 0 else row_of(points, joint))
                if number == 0:
                    moved = cross(hinge, arm)
                    for axis in range(3):
                        jacobian[3 * side + axis, 0] = _GIVES[0] * moved[axis]
                    continue
                # Turning by w moves the shoulder by w x arm.
                for axis in range(3):
                    ahead, behind = (axis + 1) % 3, (axis + 2) % 3
                    jacobian[3 * side + axis, 3 * number + ahead] = _GIVES[number] * arm[behind]
                    jacobian[3 * side + axis, 3 * number + behind] = -_GIVES[number] * arm[ahead]
        normal = jacobian @ jacobian.T
        for row in range(6):
            normal[row, row] += _DAMPING
        turns = jacobian.T @ np.linalg.solve(normal, error)
        largest = np.sqrt((turns**2).sum())
        if largest > _MAX_STEP:
            turns *= _MAX_STEP / largest
        for number in range(6):
            joint, give = turning[number], _GIVES[number]
            if number == 0:
                turn = scale(give * turns[0], hinge)
            else:
                turn = (give * turns[3 * number], give * turns[3 * number + 1], give * turns[3 * number + 2])
            # A turn of a joint also turns all joints after it.
            for carried in range(number, 6 if number < 4 else number + 1):
                turned = multiply(unitquat_from_rotvec(turn), unitquat_of(world, turning[carried]))
                put_unitquat(world, turning[carried], _unit(turned))
        _place_pelvis(middle, world, points, rest)
        _bend(bent, world, points, offsets, _PELVIS)


@inner_kernel()
def _face(
    pose: Array, bent: Array, trunk: Quaternion, nose: Vector, world: Array, points: Array, offsets: Array
) -> None:
    """Hold the head to the trunk as in the match, turned by the swing of the nose from its place in the match."""
    turn = swing_between(rotate(trunk, nose), subtract(row_of(pose, _NOSE), row_of(pose, _NECK)))
    held = multiply(turn, trunk)
    for joint in (_PELVIS, _SPINE1, _SPINE2, _SPINE3, _NECK22, _HEAD22):
        held = multiply(held, unitquat_of(bent, joint))
        if joint in (_NECK22, _HEAD22):
            put_unitquat(world, joint, _unit(held))
            _place(joint, world, points, offsets)


@inner_kernel()
def _reach(
    pose: Array, wanted: Integers, bent: Array, limb: Integers, world: Array, points: Array, offsets: Array, above: int
) -> None:
    """Turn a limb (joint, hinge and end), attached to `above`, until it follows the pose."""
    start, hinge, end = limb[0], limb[1], limb[2]
    _place(start, world, points, offsets)
    first, second = row_of(pose, wanted[1]), row_of(pose, wanted[2])
    shift = subtract(row_of(points, start), row_of(pose, wanted[0]))
    if max(abs(shift[0]), abs(shift[1]), abs(shift[2])) > _CLOSED_M:
        aside = rotate(unitquat_of(world, above), (0.0, 0.0, 1.0))
        hinged, ended = weighted_sum(1.0, first, 1.0, shift), weighted_sum(1.0, second, 1.0, shift)
        first, second = bend_one_leg(row_of(points, start), hinged, ended, second, aside)
    for joint, child, target in ((start, hinge, first), (hinge, end, second)):
        turn = multiply(unitquat_of(world, _PARENTS[joint]), unitquat_of(bent, joint))
        bone = rotate(turn, row_of(offsets, child))
        aim = subtract(target, row_of(points, joint))
        put_unitquat(world, joint, _unit(multiply(swing_between(bone, aim), turn)))
        _place(child, world, points, offsets)
    put_unitquat(world, end, multiply(unitquat_of(world, hinge), unitquat_of(bent, end)))


@inner_kernel()
def _put_down(ankle: int, toe: int, bent: Array, world: Array, points: Array, offsets: Array, least_toe: float) -> None:
    """Tilt the foot until its ball is not below `least_toe`."""
    _place(toe, world, points, offsets)
    if points[toe, 1] < least_toe:
        foot = subtract(row_of(points, toe), row_of(points, ankle))
        size = length(foot)
        rise = min(max(least_toe - points[ankle, 1], -size), size)
        level = np.sqrt(max(size * size - rise * rise, 0.0))
        ahead = normalise((foot[0], 0.0, foot[2]))
        aim = (level * ahead[0], rise, level * ahead[2])
        put_unitquat(world, ankle, _unit(multiply(swing_between(foot, aim), unitquat_of(world, ankle))))
        _place(toe, world, points, offsets)
    put_unitquat(world, toe, multiply(unitquat_of(world, ankle), unitquat_of(bent, toe)))


@inner_kernel()
def _unit(q: Quaternion) -> Quaternion:
    norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q[0] * norm, q[1] * norm, q[2] * norm, q[3] * norm
