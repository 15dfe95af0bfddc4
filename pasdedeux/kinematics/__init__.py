"""Kinematics: rotations, forward kinematics, bone lengths, rigid alignment, motions."""

from pasdedeux.kinematics.alignment import RigidTransform, align_rigid, best_rotation
from pasdedeux.kinematics.forward import (
    bone_directions,
    bone_lengths,
    forward_kinematics,
    local_from_world,
    local_rotations,
    place_bones,
)
from pasdedeux.kinematics.motion import Motion

__all__ = [
    "Motion",
    "RigidTransform",
    "align_rigid",
    "best_rotation",
    "bone_directions",
    "bone_lengths",
    "forward_kinematics",
    "local_from_world",
    "local_rotations",
    "place_bones",
]
