"""Rotations of op14 bones: a turning frame for every bone, so that a twisted trunk and shrugged shoulders are kept.

The neck of `op14` has five children (head, shoulders, hips).  One rotation of the neck cannot turn hips and shoulders
against each other, so a rotation here belongs to the *bone that ends in a joint*: the neck carries the frame of the
body, every other joint the swing of its bone against the bone before it.  Rest is a T-pose facing +Z.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import (
    conjugate,
    multiply,
    normalise,
    rotate,
    swing_between,
    unitquat_from_rotmat,
)
from pasdedeux.skeletons import OP14

__all__ = ["REST_DIRECTIONS", "bone_rotations", "place_bone_rotations", "world_bone_rotations"]

Array = npt.NDArray[np.float64]

_NECK = OP14.root
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
REST_DIRECTIONS.flags.writeable = False


def _body_rotation(positions: Array) -> Array:
    """Return the frame of the body (*batch, 4): up from mid-hip to neck, left from right to left hip and shoulder."""
    left_hip, right_hip, left_shoulder, right_shoulder = OP14.indices(
        ["left_hip", "right_hip", "left_shoulder", "right_shoulder"]
    )
    hips = positions[..., left_hip, :] - positions[..., right_hip, :]
    shoulders = positions[..., left_shoulder, :] - positions[..., right_shoulder, :]
    up = positions[..., _NECK, :] - 0.5 * (positions[..., left_hip, :] + positions[..., right_hip, :])
    up = normalise(up, fallback=np.array([0.0, 1.0, 0.0]))
    across = hips + shoulders
    across = across - np.sum(across * up, axis=-1, keepdims=True) * up
    helper = np.where(np.abs(up[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    helper = helper - np.sum(helper * up, axis=-1, keepdims=True) * up
    is_flat = np.linalg.norm(across, axis=-1, keepdims=True) < 1e-9
    left = normalise(np.where(is_flat, helper, across))
    return unitquat_from_rotmat(np.stack([left, up, np.cross(left, up)], axis=-1))


def bone_rotations(positions: Array) -> Array:
    """Return the rotations (*batch, 14, 4) of op14 bones from positions (*batch, 14, 3), any unit.

    Entry of the neck: the frame of the body in the world.  Entry of every other joint: the shortest rotation of the
    bone that ends there, against the bone before it (the frame of the body for head, shoulders and hips).  A bone of
    length zero keeps the rotation of the bone before it (identity).
    """
    local = np.empty((*positions.shape[:-1], 4))
    world = np.empty_like(local)
    local[..., _NECK, :] = world[..., _NECK, :] = _body_rotation(positions)
    for joint in OP14.order[1:]:
        parent = OP14.parents[joint]
        bone = rotate(conjugate(world[..., parent, :]), positions[..., joint, :] - positions[..., parent, :])
        rest = np.broadcast_to(REST_DIRECTIONS[joint], bone.shape)
        local[..., joint, :] = swing_between(rest, bone)
        world[..., joint, :] = multiply(world[..., parent, :], local[..., joint, :])
    return local


def world_bone_rotations(bone_unitquat: Array) -> Array:
    """Return the rotation of every bone against the world (*batch, 14, 4) from `bone_rotations`."""
    world = np.empty(bone_unitquat.shape)
    for joint in OP14.order:
        parent = OP14.parents[joint]
        own = bone_unitquat[..., joint, :]
        world[..., joint, :] = own if parent < 0 else multiply(world[..., parent, :], own)
    return world


def place_bone_rotations(bone_unitquat: Array, lengths_m: Array, root_m: Array) -> Array:
    """Return positions (*batch, 14, 3): the inverse of `bone_rotations`, with mid-hip at `root_m`.

    Args:
        bone_unitquat: Rotations of the bones (*batch, 14, 4).
        lengths_m: Bone lengths (14,) or (*batch, 14), metres.
        root_m: Mid-hip (*batch, 3), metres.
    """
    world = world_bone_rotations(bone_unitquat)
    directions = rotate(world, np.broadcast_to(REST_DIRECTIONS, (*world.shape[:-1], 3)))
    positions = np.zeros(directions.shape)
    for joint in OP14.order[1:]:
        reach = np.asarray(lengths_m)[..., joint, None]
        positions[..., joint, :] = positions[..., OP14.parents[joint], :] + directions[..., joint, :] * reach
    left_hip, right_hip = OP14.index("left_hip"), OP14.index("right_hip")
    mid = 0.5 * (positions[..., left_hip, :] + positions[..., right_hip, :])
    return np.asarray(positions + (root_m - mid)[..., None, :])
