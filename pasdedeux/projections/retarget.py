"""Normalise op14 poses: proportions of the reference body, mid-hip at the origin, facing +Z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_directions, place_bones
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.skeletons import OP14

REFERENCE_STATURE_M = 1.75
"""Stature of the reference body (Yiannakides et al. 2019, section 6.2: a character with height 175 cm)."""

_FRACTION_OF_STATURE = {
    "head": 0.105,  # from the shoulder line 0.818 up to the nose 0.907, 0.055 to the front
    "shoulder": 0.115,  # half the distance of the shoulder joints; 0.129 is to the acromion
    "elbow": 0.186,
    "wrist": 0.146,
    "hip": 0.293,  # from the shoulder line 0.818 down to the hip joints 0.530, 0.055 to the side
    "knee": 0.245,
    "ankle": 0.246,
}
"""Bone lengths as fractions of stature, by the joint the bone ends in (Drillis and Contini 1966, in Winter 2009,
fig. 4.1; widths narrowed from the body's outline to the joint centres)."""


REFERENCE_LENGTHS_M: Array = REFERENCE_STATURE_M * np.array(
    [_FRACTION_OF_STATURE.get(name.rpartition("_")[2], 0.0) for name in OP14.joint_names]
)
"""Bone lengths of the reference body (14,), metres, by the joint each bone ends in; 0 for the neck, the root."""
REFERENCE_LENGTHS_M.flags.writeable = False

_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_LEFT_SHOULDER, _RIGHT_SHOULDER = OP14.index("left_shoulder"), OP14.index("right_shoulder")


@dataclass(frozen=True)
class CentredPoses:
    """Poses without place and heading, and both of these.

    Args:
        poses_m: Positions (*batch, 14, 3), mid-hip at the origin, body facing +Z, metres.
        heading_rad: Removed yaw (*batch,).
        root_translation_m: Removed mid-hip (*batch, 3), metres.
    """

    poses_m: Array
    heading_rad: Array
    root_translation_m: Array


def mid_hip(positions: Array) -> Array:
    """Return the middle of the hips (*batch, d) of op14 positions (*batch, 14, d); NaN where a hip is missing."""
    return np.asarray(0.5 * (positions[..., _LEFT_HIP, :] + positions[..., _RIGHT_HIP, :]))


def retarget_proportions(positions: Array, lengths_m: Array = REFERENCE_LENGTHS_M) -> Array:
    """Return op14 poses with other bone lengths, bone directions and mid-hip kept.

    Retargeting before projection is essential: without it, the distance of a match is 22-45 cm instead of 9.

    Args:
        positions: Positions (*batch, 14, 3), metres.
        lengths_m: Bone lengths (14,) or (*batch, 14), metres.

    Returns:
        Positions (*batch, 14, 3) whose op14 bones have exactly these lengths.

    Raises:
        InputError: Wrong shape, a value that is not finite, or a bone of length zero (it has no direction).
    """
    positions = np.asarray(positions, dtype=np.float64)
    if positions.shape[-2:] != (OP14.num_joints, 3):
        raise InputError(f"op14 positions have shape {positions.shape}, expected (..., {OP14.num_joints}, 3)")
    if not np.isfinite(positions).all():
        raise InputError("op14 positions hold a value that is not finite; missing joints cannot be retargeted")
    directions = bone_directions(OP14, positions)
    is_empty = (np.sum(directions**2, axis=-1) < 0.5) & (np.array(OP14.parents) >= 0)
    if is_empty.any():
        joint = OP14.joint_names[int(np.argwhere(is_empty)[0][-1])]
        raise InputError(f"the op14 bone that ends in '{joint}' has length zero; it has no direction to keep")
    moved = place_bones(OP14, np.zeros((*positions.shape[:-2], 3)), directions, np.asarray(lengths_m))
    return moved + (mid_hip(positions) - mid_hip(moved))[..., None, :]


def body_heading(positions: Array) -> Array:
    """Return the yaw (*batch,) of the body, from the lines through hips and shoulders; 0 faces +Z.

    The two lines are added first, so a twisted trunk gives the mean.  A body whose lines are vertical or cancel out has
    no heading and gets 0.
    """
    across = (
        positions[..., _LEFT_HIP, :]
        - positions[..., _RIGHT_HIP, :]
        + positions[..., _LEFT_SHOULDER, :]
        - positions[..., _RIGHT_SHOULDER, :]
    )
    has_heading = np.hypot(across[..., 0], across[..., 2]) > 1e-9
    return np.where(has_heading, np.arctan2(-across[..., 2], across[..., 0]), 0.0)


def centre_and_face(positions: Array) -> CentredPoses:
    """Remove mid-hip and heading from op14 positions (*batch, 14, 3)."""
    root = mid_hip(positions)
    centred = positions - root[..., None, :]
    heading = body_heading(positions)
    turned = np.einsum("...ij,...nj->...ni", yaw_rotmat(-heading), centred)
    return CentredPoses(np.asarray(turned), heading, root)
