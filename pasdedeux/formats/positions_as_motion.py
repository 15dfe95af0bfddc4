"""Positions as a motion: its rotations are swings, or it has joints added so that it passes through them exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics import Motion, bone_lengths, local_from_world, local_rotations, place_bones
from pasdedeux.kinematics.rotations import multiply, rotate, swing_between
from pasdedeux.skeletons import Skeleton

RIGID_M = 1e-4
"""Children that keep their places to each other within this are left to the rotation of their joint."""


def motion_from_positions(skeleton: Skeleton, positions_m: Array, rate_hz: float) -> Motion:
    """Return a motion for positions (frame, J, 3) that came without rotations: the rotations are swings only.

    The rest pose has the median bone lengths and the directions of the first frame.  Where bone lengths vary the
    motion's joints differ from the positions by that much.
    """
    for frame, joint in np.argwhere(~np.isfinite(positions_m).all(axis=-1)):
        raise InputError(f"frame {frame}: the position of '{skeleton.joint_names[joint]}' is not finite")
    lengths = np.median(bone_lengths(skeleton, positions_m), axis=0)
    first = positions_m[0]
    offsets = np.zeros((skeleton.num_joints, 3))
    for parent, child in skeleton.bones:
        vector = first[child] - first[parent]
        length = float(np.linalg.norm(vector))
        offsets[child] = vector * (lengths[child] / length) if length > 0 else 0.0
    rest = place_bones(skeleton, np.zeros(3), offsets, np.ones(skeleton.num_joints))
    return Motion(
        skeleton=skeleton,
        rest_offsets_m=offsets,
        root_translation_m=positions_m[:, skeleton.root],
        local_unitquat=local_rotations(skeleton, rest, positions_m),
        rate_hz=rate_hz,
    )


def exact_motion(skeleton: Skeleton, positions_m: Array, rate_hz: float) -> Motion:
    """Return a motion whose joints lie at positions (frame, J, 3), as far as those keep their bone lengths.

    A joint turns all its children together, so children that move against each other - hips against the spine - would
    be off by that much.  Between such a joint and each of its children stands one more joint, `<child>_base`, at
    offset zero and with a rotation of its own, as in the CMU files at hips and shoulders.
    """
    rigid = motion_from_positions(skeleton, positions_m, rate_hz)
    world = rigid.world()[1]
    free = {
        joint
        for joint in skeleton.order
        if len(skeleton.children(joint)) > 1 and _slack(skeleton, joint, rigid, world[:, joint], positions_m) > RIGID_M
    }
    if not free:
        return rigid
    names: list[str] = []
    parents: list[int] = []
    offsets: list[Array] = []
    turns: list[Array] = []
    place: dict[int, int] = {}
    for joint in skeleton.order:
        parent = skeleton.parents[joint]
        above = place.get(parent, -1)
        if parent in free:
            carried = rotate(turns[above], np.broadcast_to(rigid.rest_offsets_m[joint], positions_m[:, joint].shape))
            swing = swing_between(carried, positions_m[:, joint] - positions_m[:, parent])
            names.append(f"{skeleton.joint_names[joint]}_base")
            parents.append(above)
            offsets.append(np.zeros(3))
            turns.append(multiply(swing, turns[above]))
            above = len(names) - 1
        place[joint] = len(names)
        names.append(skeleton.joint_names[joint])
        parents.append(above)
        offsets.append(rigid.rest_offsets_m[joint])
        turns.append(_turn(skeleton, joint, rigid, turns[above] if above >= 0 else None, world[:, joint], positions_m))
    freed = Skeleton(name=skeleton.name, joint_names=tuple(names), parents=tuple(parents))
    local = local_from_world(freed, np.stack(turns, axis=1))
    return replace(rigid, skeleton=freed, rest_offsets_m=np.array(offsets), local_unitquat=local)


def _slack(skeleton: Skeleton, joint: int, rigid: Motion, turn: Array, positions_m: Array) -> float:
    """Return how far the children of a joint are off when its rotation carries them all, metres."""
    children = list(skeleton.children(joint))
    carried = rotate(turn[:, None], np.broadcast_to(rigid.rest_offsets_m[children], (len(turn), len(children), 3)))
    posed = positions_m[:, children] - positions_m[:, joint, None]
    return float(np.linalg.norm(carried - posed, axis=-1).max())


def _turn(
    skeleton: Skeleton, joint: int, rigid: Motion, above: Array | None, fitted: Array, positions_m: Array
) -> Array:
    """Return the world rotation (frame, 4) of a joint: fitted to several children, swung to one; else the one above."""
    children = skeleton.children(joint)
    if len(children) > 1 or above is None:
        return fitted
    if not children:
        return above
    (child,) = children
    carried = rotate(above, np.broadcast_to(rigid.rest_offsets_m[child], positions_m[:, child].shape))
    return multiply(swing_between(carried, positions_m[:, child] - positions_m[:, joint]), above)
