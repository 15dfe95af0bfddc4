"""From op14 positions to a motion with rotations, ready to be written as BVH."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.motion import Motion
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.reconstruction.bones import REST_DIRECTIONS, bone_rotations
from pasdedeux.skeletons import OP14, Skeleton

__all__ = ["MOTION_SKELETON", "motion_from_bones", "motion_from_positions", "upright_motion"]

Array = npt.NDArray[np.float64]

_TURNING = OP14.children(OP14.root)
"""Joints whose bones start at the neck and turn on their own."""


def _motion_skeleton() -> Skeleton:
    names, parents = [], []
    for joint in OP14.order:
        name = OP14.joint_names[joint]
        parent = OP14.parents[joint]
        if parent < 0:
            parents.append(-1)
        elif joint in _TURNING:
            names.append(f"{name}_base")
            parents.append(names.index(OP14.joint_names[parent]))
            parents.append(len(names) - 1)
        else:
            parents.append(names.index(OP14.joint_names[parent]))
        names.append(name)
    return Skeleton("op14_motion", tuple(names), tuple(parents))


MOTION_SKELETON: Skeleton = _motion_skeleton()
"""op14 with one more joint of offset zero (`<joint>_base`) at the neck for each bone that starts there, as the CMU
files have at hips and shoulders: a joint turns all its children, and hips, shoulders and head turn on their own."""


def motion_from_bones(bone_unitquat: Array, lengths_m: Array, neck_m: Array, *, rate_hz: float) -> Motion:
    """Return a motion from bone rotations.

    Args:
        bone_unitquat: Rotations of the bones (frame, 14, 4), see `bones.bone_rotations`.
        lengths_m: Bone lengths (14,), metres.
        neck_m: World position of the neck (frame, 3), metres; the root of the motion.
        rate_hz: Frames per second of the motion, the true one.
    """
    local = np.zeros((len(bone_unitquat), MOTION_SKELETON.num_joints, 4))
    local[..., 3] = 1.0
    offsets = np.zeros((MOTION_SKELETON.num_joints, 3))
    for joint, name in enumerate(OP14.joint_names):
        out = MOTION_SKELETON.index(name)
        offsets[out] = REST_DIRECTIONS[joint] * lengths_m[joint]
        # The rotation of the bone that ends in a joint sits at the joint where it starts.
        turner = out if MOTION_SKELETON.parents[out] < 0 else MOTION_SKELETON.parents[out]
        local[:, turner] = bone_unitquat[:, joint]
    return Motion(
        skeleton=MOTION_SKELETON,
        rest_offsets_m=offsets,
        root_translation_m=np.array(neck_m, dtype=np.float64),
        local_unitquat=local,
        rate_hz=rate_hz,
    )


def motion_from_positions(positions_m: Array, lengths_m: Array, *, rate_hz: float) -> Motion:
    """Return motion of op14 positions (frame, 14, 3) with bones of `lengths_m` (14,); joints stay where they are."""
    return motion_from_bones(bone_rotations(positions_m), lengths_m, positions_m[:, OP14.root], rate_hz=rate_hz)


def upright_motion(positions_m: Array, camera: DatabaseCamera, *, rate_hz: float) -> Motion:
    """Return the motion of op14 positions (frame, 14, 3) in the axes of a pitched camera, turned upright.

    Bone lengths are those of the first frame; positions are expected to keep them.
    """
    upright = positions_m @ np.asarray(camera.camera_from_upright_rotmat)  # row vectors: this is the inverse rotation
    return motion_from_positions(upright, bone_lengths(OP14, upright[0]), rate_hz=rate_hz)
