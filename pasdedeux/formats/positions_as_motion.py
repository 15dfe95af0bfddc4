"""Conversion of positions to a motion whose rotations are swings."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics import Motion, bone_lengths, local_rotations, place_bones
from pasdedeux.skeletons import Skeleton


def motion_from_positions(skeleton: Skeleton, positions_m: Array, rate_hz: float) -> Motion:
    """Return a motion for positions (frame, J, 3) without rotations; its rotations are swings only.

    The rest pose has the median bone lengths and the directions of the first frame.  If bone lengths vary, the joints
    of the motion differ from the positions by that much.
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


def source_from_positions(
    skeleton: Skeleton, positions: Array, *, rate_hz: float | None, metres_per_unit: float | None
) -> SourceMotion:
    """Return the source motion for positions (frame, J, 3) in a file's unit; see `motion_from_positions`."""
    motion = motion_from_positions(skeleton, positions, rate_hz or 1.0)
    return SourceMotion(
        skeleton=motion.skeleton,
        rest_offsets=motion.rest_offsets_m,
        root_translation=motion.root_translation_m,
        local_unitquat=motion.local_unitquat,
        rate_hz=rate_hz,
        metres_per_unit=metres_per_unit,
    )
