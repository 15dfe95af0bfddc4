"""Compiled inner loops of guided proposals."""

from __future__ import annotations

import math

import numba
import numpy as np

from pasdedeux.sampling.growth_kernels import place_bones

__all__ = ["move_by", "way_to_image"]


@numba.njit(cache=True, nogil=True)
def _product(p, q):  # type: ignore[no-untyped-def]
    return (
        p[3] * q[0] + q[3] * p[0] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] - p[0] * q[2] + q[3] * p[1] + p[2] * q[0],
        p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + q[3] * p[2],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )


@numba.njit(cache=True, nogil=True)
def _quaternion(x, y, z):  # type: ignore[no-untyped-def]
    angle = math.sqrt(x * x + y * y + z * z)
    factor = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return (x * factor, y * factor, z * factor, math.cos(0.5 * angle))


@numba.njit(cache=True, nogil=True)
def _carried_back(q, v):  # type: ignore[no-untyped-def]
    """Turn a vector by the inverse of a unit quaternion."""
    inverse = (-q[0], -q[1], -q[2], q[3])
    turned = _product(_product(inverse, (v[0], v[1], v[2], 0.0)), q)
    return (turned[0], turned[1], turned[2])


@numba.njit(cache=True, nogil=True)
def _swing(a, b):  # type: ignore[no-untyped-def]
    """Return the rotation vector of the shortest turn from direction a to direction b; 0 where one is empty."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return (0.0, 0.0, 0.0)
    angle = math.atan2(sine, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
    return (x * angle / sine, y * angle / sine, z * angle / sine)


@numba.njit(cache=True, nogil=True)
def way_to_image(  # type: ignore[no-untyped-def]
    parameters, pair, towards, image, lengths, directions, axes, order, parents, neck, blocks, tightness, way
):
    """Write how far blocks are from where an image wants them, with depth and bone lengths of the pair.

    Args:
        parameters: Parameters (108,).
        pair: The positions that they give, (2, 17, 3), metres.
        towards: Unit direction to the camera, (3,).
        image: Centred image points (2, 17, 2), metres.
        lengths: Bone lengths of the pair, (2, 17), metres.
        directions: Bone directions of the chart's seed, (2, 17, 3).
        axes: Axes that bones turn about, (2, 17, 2, 3).
        order: Joints from the root outward.
        parents: Parent of each joint, -1 for the root.
        neck: Joint that the backbone ends in.
        blocks: Blocks that are to move, (n,).
        tightness: As for `place_bones`.
        way: Result (n, 6): rotation vector and shift of a root, in the world; of a bone, its two rotations.
    """
    num_joints = parents.shape[0]
    centre = np.zeros(3)
    for person in range(2):
        for joint in range(num_joints):
            for axis in range(3):
                centre[axis] += pair[person, joint, axis] / (2 * num_joints)
    # Two axes square to the view, turned in the image plane as the image lies best.
    helper = 0 if abs(towards[0]) < 0.6 else 1
    right = np.zeros(3)
    right[helper] = 1.0
    right -= towards[helper] * towards
    right /= math.sqrt(right[0] ** 2 + right[1] ** 2 + right[2] ** 2)
    up = np.empty(3)
    up[0] = towards[1] * right[2] - towards[2] * right[1]
    up[1] = towards[2] * right[0] - towards[0] * right[2]
    up[2] = towards[0] * right[1] - towards[1] * right[0]
    along, across = 0.0, 0.0
    depth = np.empty((2, num_joints))
    for person in range(2):
        for joint in range(num_joints):
            x, y, z = 0.0, 0.0, 0.0
            for axis in range(3):
                offset = pair[person, joint, axis] - centre[axis]
                x += offset * right[axis]
                y += offset * up[axis]
                z += offset * towards[axis]
            depth[person, joint] = z
            along += x * image[person, joint, 0] + y * image[person, joint, 1]
            across += x * image[person, joint, 1] - y * image[person, joint, 0]
    angle = math.atan2(across, along)
    cosine, sine = math.cos(angle), math.sin(angle)
    view = np.empty((3, 3))
    for axis in range(3):
        view[0, axis] = cosine * right[axis] - sine * up[axis]
        view[1, axis] = sine * right[axis] + cosine * up[axis]
        view[2, axis] = towards[axis]
    placed = np.empty((2, num_joints, 3))
    place_bones(image, depth, lengths, order, parents, tightness, placed)
    is_moved = np.zeros(2 * num_joints, dtype=np.bool_)
    at_block = np.full(2 * num_joints, -1)
    for at in range(blocks.shape[0]):
        is_moved[blocks[at]] = True
        at_block[blocks[at]] = at
    way[:] = 0.0
    frames = np.empty((num_joints, 4))
    wanted = np.empty(3)
    for person in range(2):
        start = person * (6 + 3 * (num_joints - 1))
        root = order[0]
        for index in range(order.shape[0]):
            joint = order[index]
            parent = parents[joint]
            block = person * num_joints + joint
            below = root if parent < 0 else parent
            end = neck if parent < 0 else joint
            for axis in range(3):
                wanted[axis] = 0.0
                for row in range(3):
                    wanted[axis] += (placed[person, end, row] - placed[person, below, row]) * view[row, axis]
            if parent < 0:
                first = start
                frame = _quaternion(parameters[first], parameters[first + 1], parameters[first + 2])
                if is_moved[block]:
                    own = way[at_block[block]]
                    spine = pair[person, neck] - pair[person, joint]
                    turn = _swing((spine[0], spine[1], spine[2]), (wanted[0], wanted[1], wanted[2]))
                    own[0], own[1], own[2] = turn[0], turn[1], turn[2]
                    for axis in range(3):
                        target = 0.0
                        for row in range(3):
                            target += placed[person, joint, row] * view[row, axis]
                        own[3 + axis] = target - (pair[person, joint, axis] - centre[axis])
                    frame = _product(_quaternion(turn[0], turn[1], turn[2]), frame)
            else:
                first = start + 3 + 3 * joint
                u, v = parameters[first], parameters[first + 1]
                above = (frames[parent, 0], frames[parent, 1], frames[parent, 2], frames[parent, 3])
                one, two = axes[person, joint, 0], axes[person, joint, 1]
                if is_moved[block]:
                    local = _carried_back(above, (wanted[0], wanted[1], wanted[2]))
                    seed = directions[person, joint]
                    turn = _swing((seed[0], seed[1], seed[2]), local)
                    own = way[at_block[block]]
                    target_u = turn[0] * one[0] + turn[1] * one[1] + turn[2] * one[2]
                    target_v = turn[0] * two[0] + turn[1] * two[1] + turn[2] * two[2]
                    own[0], own[1] = target_u - u, target_v - v
                    u, v = target_u, target_v
                frame = _product(
                    above, _quaternion(u * one[0] + v * two[0], u * one[1] + v * two[1], u * one[2] + v * two[2])
                )
            frames[joint, 0], frames[joint, 1], frames[joint, 2], frames[joint, 3] = frame


@numba.njit(cache=True, nogil=True)
def move_by(parameters, blocks, step, num_joints):  # type: ignore[no-untyped-def]
    """Move blocks in place by a step (n, 6) as `way_to_image` gives it; tells whether no root turned by pi or more."""
    for at in range(blocks.shape[0]):
        person, joint = blocks[at] // num_joints, blocks[at] % num_joints
        start = person * (3 + 3 * num_joints)
        if joint == 0:
            x, y, z = step[at, 0], step[at, 1], step[at, 2]
            if x * x + y * y + z * z >= math.pi * math.pi:
                return False
            q = _product(
                _quaternion(x, y, z), _quaternion(parameters[start], parameters[start + 1], parameters[start + 2])
            )
            sign = -1.0 if q[3] < 0.0 else 1.0
            sine = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
            factor = 2.0 * sign if sine < 1e-12 else 2.0 * math.atan2(sine, sign * q[3]) * sign / sine
            for axis in range(3):
                parameters[start + axis] = factor * q[axis]
                parameters[start + 3 + axis] += step[at, 3 + axis]
        else:
            first = start + 3 + 3 * joint
            parameters[first] += step[at, 0]
            parameters[first + 1] += step[at, 1]
    return True
