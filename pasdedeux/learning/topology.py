"""Models of other skeletons than `body22`: takes and variants on them, and what tells weights of one from another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pasdedeux.augmentation import Source, reference_motion
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.model import TrainingItem, VariantModel
from pasdedeux.skeletons import BODY22, MODEL_SKELETONS, JointMap, Skeleton


def mapped_source(source: Source, joints: JointMap) -> Source:
    """Return a take of `body22` on another skeleton, without objects."""
    motion_m = joints.positions(source.positions_m, BODY22.joint_names)
    return replace(source, positions_m=motion_m, skeleton=joints.target, objects=None)


def mapped_item(item: TrainingItem, joints: JointMap, source: Source) -> TrainingItem:
    """Return an item of `body22` on another skeleton: its motion, and its scales.

    A bone's scale is what plain forward kinematics on `body22` makes of its median length.  Stated contacts, which name
    bones of `body22`, are left out.

    Args:
        item: The item.
        joints: What the joints follow from.
        source: What `mapped_source` gives of its take, the same for all of its items.
    """
    request = item.request
    scales = complete_scales(request.source, np.stack([request.bone_scale, np.ones_like(request.bone_scale)]))
    posed = joints.positions(reference_motion(request.source, scales), BODY22.joint_names)
    scaled, plain = np.median(bone_lengths(joints.target, posed), axis=1)
    bone_scale = np.where(plain > 0.0, scaled / np.where(plain > 0.0, plain, 1.0), 1.0)
    asked = replace(request, source=source, bone_scale=bone_scale, contacts=())
    return TrainingItem(item.variant_id, asked, joints.positions(item.motion_m, BODY22.joint_names))


def check_topology(model: VariantModel, source: Source) -> None:
    """Refuse a take of another skeleton than a model's.

    Raises:
        InputError: Names both.
    """
    own = model.skeleton
    if own not in (None, source.skeleton):
        raise InputError(
            f"{model.name}: weights of another topology: it is of {own.name}, {own.num_joints} joints a person, "
            f"and {source.name} of {source.skeleton.name}, {source.skeleton.num_joints}"
        )


def skeleton_of(name: str, num_joints: int) -> Skeleton:
    """Return the skeleton of so many joints that a model's arrays are of.

    Raises:
        InputError: There is none.
    """
    for skeleton in MODEL_SKELETONS.values():
        if skeleton.num_joints == num_joints:
            return skeleton
    known = ", ".join(f"{one.name} {one.num_joints}" for one in MODEL_SKELETONS.values())
    raise InputError(f"{name}: weights of another topology, {num_joints} joints; known skeletons: {known}")
