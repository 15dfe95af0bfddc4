"""Joint rotations of a variant: swing from its bones, twist from the source."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics import local_rotations
from pasdedeux.skeletons import BODY22

__all__ = ["scaled_rest", "variant_rotations"]

Array = npt.NDArray[np.float64]


def scaled_rest(rest_m: Array, bone_scale: Array) -> Array:
    """Return the rest pose with scaled bones: positions and scales (*batch, 22, 3) and (*batch, 22); the root stays."""
    scaled = np.array(np.broadcast_to(rest_m, np.broadcast_shapes(rest_m.shape, (*bone_scale.shape, 3))))
    for joint in BODY22.order:
        parent = BODY22.parents[joint]
        if parent >= 0:
            offset = rest_m[..., joint, :] - rest_m[..., parent, :]
            scaled[..., joint, :] = scaled[..., parent, :] + offset * bone_scale[..., joint, None]
    return scaled


def variant_rotations(rest_m: Array, bone_scale: Array, positions_m: Array, source_world_unitquat: Array) -> Array:
    """Return local rotations (T, 2, 22, 4) that play a variant on its own scaled skeleton.

    Joints with several children (pelvis, upper spine) take the rotation that fits all of them best, so a hip or collar
    may miss by what the girdle bends; every other bone is met exactly.

    Args:
        rest_m: body22 of each person in the source's rest pose (2, 22, 3), metres.
        bone_scale: Scales of the variant (2, 22).
        positions_m: The variant (T, 2, 22, 3), metres.
        source_world_unitquat: World rotations of the source from its rest pose (T, 2, 22, 4), whose twist is kept.

    Raises:
        InputError: The rest pose does not have two people of 22 joints.
    """
    if rest_m.shape != (2, BODY22.num_joints, 3):
        raise InputError(f"rest poses have shape {rest_m.shape}, expected (2, {BODY22.num_joints}, 3)")
    rest = scaled_rest(rest_m, bone_scale)
    people = [
        local_rotations(BODY22, rest[person], positions_m[:, person], source_world_unitquat[:, person])
        for person in (0, 1)
    ]
    return np.stack(people, axis=1)
