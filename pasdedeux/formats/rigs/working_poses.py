"""Conversion of source motions to the working skeletons pair17, op14 and body22."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError, named
from pasdedeux.kinematics import Motion, bone_lengths
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.skeletons.layouts import Layout

MIN_BONE_M = 1e-3
"""If a bone of a working skeleton is shorter at rest, the mapping puts two joints in one place."""


@dataclass(frozen=True)
class WorkingPoses:
    """A motion in the working skeletons, world frame, metres.

    Args:
        pair17_m: (frame, 17, 3).
        op14_m: (frame, 14, 3).
        body22_m: (frame, 22, 3).
        body22_world_unitquat: World rotation of the source joint that carries each joint, from the rest pose,
            (frame, 22, 4).
        body22_rest_m: body22 in the source's rest pose, root at the origin, (22, 3).
    """

    pair17_m: Array
    op14_m: Array
    body22_m: Array
    body22_world_unitquat: Array
    body22_rest_m: Array


def derive_working_poses(motion: Motion, layout: Layout) -> WorkingPoses:
    """Derive the working skeletons of a motion through a layout."""
    extended = _with_points(motion, layout)
    names = extended.skeleton.joint_names
    positions, world_unitquat = extended.world()
    body22 = layout.joint_map(BODY22.name)
    rest = body22.positions(extended.rest_positions_m(), names)
    carriers = [names.index(body22.carrier(joint)) for joint in BODY22.joint_names]
    return WorkingPoses(
        pair17_m=layout.joint_map(PAIR17.name).positions(positions, names),
        op14_m=layout.joint_map(OP14.name).positions(positions, names),
        body22_m=body22.positions(positions, names),
        body22_world_unitquat=world_unitquat[:, carriers],
        body22_rest_m=rest - rest[BODY22.root],
    )


def check_layout(motion: Motion, layout: Layout) -> None:
    """Refuse a layout that does not fit the rest pose of a motion."""
    extended = _with_points(motion, layout)
    source_rest = extended.rest_positions_m()
    for skeleton in (PAIR17, OP14, BODY22):
        rest = layout.joint_map(skeleton.name).positions(source_rest, extended.skeleton.joint_names)
        lengths = bone_lengths(skeleton, rest)
        for parent, child in skeleton.bones:
            if lengths[child] < MIN_BONE_M:
                raise InputError(
                    f"layout '{layout.name}': the bone from '{skeleton.joint_names[parent]}' to "
                    f"'{skeleton.joint_names[child]}' of '{skeleton.name}' is {lengths[child] * 1000:.2g} mm long "
                    f"at rest; at least {MIN_BONE_M * 1000:g} mm is needed"
                )


def _with_points(motion: Motion, layout: Layout) -> Motion:
    """Return the motion with the added points of the layout as joints."""
    skeleton, offsets_m = motion.skeleton, motion.rest_offsets_m
    with named(f"layout '{layout.name}'"):
        carriers = skeleton.indices(point.joint for point in layout.points)
        units_m = [float(np.linalg.norm(offsets_m[skeleton.index(point.unit_bone)])) for point in layout.points]
    added = [np.array(point.offset) * unit_m for point, unit_m in zip(layout.points, units_m, strict=True)]
    return motion.with_joints([point.name for point in layout.points], carriers, added)
