"""Rotations of op14 bones: a frame for every bone, which keeps twists of the trunk and shrugs of the shoulders.

The neck of `op14` has five children (head, shoulders, hips), and one rotation cannot turn hips against shoulders.  So
rotations belong to the *bone that ends in a joint*: the neck has the frame of the body, every other joint the swing of
its bone relative to the bone before it.  Rest is a T-pose facing +Z.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import (
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
    unitquat_from_axes,
    unitquat_of,
    weighted_sum,
)
from pasdedeux.skeletons import OP14

_NECK = OP14.root
_ORDER = np.array(OP14.order[1:])
_PARENTS = np.array(OP14.parents)
_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_LEFT_SHOULDER, _RIGHT_SHOULDER = OP14.index("left_shoulder"), OP14.index("right_shoulder")
_HIP_SLOPE = 0.19
"""Sideways part of the bone from neck to hip at rest: 0.055 over 0.293 of stature, the reference body's."""


def _rest_directions() -> Array:
    rest = {
        "head": (0.0, 0.85, np.sqrt(1.0 - 0.85**2)),
        "shoulder": (1.0, 0.0, 0.0),
        "elbow": (1.0, 0.0, 0.0),
        "wrist": (1.0, 0.0, 0.0),
        "hip": (_HIP_SLOPE, -np.sqrt(1.0 - _HIP_SLOPE**2), 0.0),
        "knee": (0.0, -1.0, 0.0),
        "ankle": (0.0, -1.0, 0.0),
        "neck": (0.0, 0.0, 0.0),
    }
    directions = np.array([rest[name.removeprefix("left_").removeprefix("right_")] for name in OP14.joint_names])
    is_right = np.array([name.startswith("right_") for name in OP14.joint_names])
    directions[is_right, 0] *= -1.0
    return directions


REST_DIRECTIONS: Array = _rest_directions()
"""Direction (14, 3) of each bone at rest: T-pose facing +Z, so the left side is +X; zero for the neck.

The head of op14 is the nose, before the neck's line."""
_REST = REST_DIRECTIONS.copy()  # compiled code wants it writeable, or it compiles twice
REST_DIRECTIONS.flags.writeable = False


def bone_rotations(positions: Array) -> Array:
    """Return the rotations (*batch, 14, 4) of op14 bones from positions (*batch, 14, 3), any unit.

    Entry of the neck: the frame of the body in the world, up from mid-hip to neck and left from the right to the left
    hip and shoulder.  Entry of every other joint: the shortest rotation of the bone that ends there, relative to the
    bone before it (the frame of the body for head, shoulders and hips).  A bone of length zero has the identity.
    """
    flat = np.array(positions, dtype=np.float64, order="C").reshape(-1, OP14.num_joints, 3)
    return _bone_rotations(flat).reshape(*positions.shape[:-1], 4)


def place_bone_rotations(bone_unitquat: Array, lengths_m: Array, root_m: Array) -> Array:
    """Return positions (*batch, 14, 3): the inverse of `bone_rotations`, with mid-hip at `root_m`.

    Args:
        bone_unitquat: Rotations of the bones (*batch, 14, 4).
        lengths_m: Bone lengths (14,) or (*batch, 14), metres.
        root_m: Mid-hip (*batch, 3), metres.
    """
    shape = bone_unitquat.shape[:-1]
    flat = np.array(bone_unitquat, dtype=np.float64, order="C").reshape(-1, OP14.num_joints, 4)
    lengths = np.array(np.broadcast_to(lengths_m, shape), dtype=np.float64, order="C")
    placed = _place_bones(flat, lengths.reshape(flat.shape[:-1])).reshape(*shape, 3)
    return np.asarray(placed + np.asarray(root_m)[..., None, :])


@compiled()
def _bone_rotations(positions: Array) -> Array:
    """Return the rotations (n, 14, 4) of poses (n, 14, 3); see `bone_rotations`."""
    local = np.empty((*positions.shape[:2], 4))
    for at in range(positions.shape[0]):
        pose = positions[at]
        left_hip, right_hip = row_of(pose, _LEFT_HIP), row_of(pose, _RIGHT_HIP)
        hips = subtract(left_hip, right_hip)
        shoulders = subtract(row_of(pose, _LEFT_SHOULDER), row_of(pose, _RIGHT_SHOULDER))
        up = normalise(subtract(row_of(pose, _NECK), weighted_sum(0.5, left_hip, 0.5, right_hip)))
        if dot(up, up) == 0.0:
            up = (0.0, 1.0, 0.0)
        across = weighted_sum(1.0, hips, 1.0, shoulders)
        across = subtract(across, scale(dot(across, up), up))
        if length(across) < 1e-9:
            across = (1.0, 0.0, 0.0) if abs(up[0]) < 0.9 else (0.0, 1.0, 0.0)
            across = subtract(across, scale(dot(across, up), up))
        left = normalise(across)
        world = np.empty((pose.shape[0], 4))
        put_unitquat(local[at], _NECK, unitquat_from_axes(left, up, cross(left, up)))
        put_unitquat(world, _NECK, unitquat_of(local[at], _NECK))
        for joint in _ORDER:
            before = unitquat_of(world, _PARENTS[joint])
            bone = rotate(conjugate(before), subtract(row_of(pose, joint), row_of(pose, _PARENTS[joint])))
            swing = swing_between(row_of(_REST, joint), bone)
            put_unitquat(local[at], joint, swing)
            put_unitquat(world, joint, multiply(before, swing))
    return local


@compiled()
def _place_bones(unitquat: Array, lengths: Array) -> Array:
    """Return positions (n, 14, 3) about the mid-hip of rotations (n, 14, 4) of bones of these lengths (n, 14)."""
    positions = np.zeros((*unitquat.shape[:2], 3))
    for at in range(unitquat.shape[0]):
        pose, world = positions[at], unitquat[at].copy()
        for joint in _ORDER:
            parent = _PARENTS[joint]
            turn = multiply(unitquat_of(world, parent), unitquat_of(unitquat[at], joint))
            put_unitquat(world, joint, turn)
            bone = rotate(turn, row_of(_REST, joint))
            put_row(pose, joint, weighted_sum(1.0, row_of(pose, parent), lengths[at, joint], bone))
        for axis in range(3):
            pose[:, axis] -= 0.5 * (pose[_LEFT_HIP, axis] + pose[_RIGHT_HIP, axis])
    return positions
