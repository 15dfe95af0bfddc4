"""Plausibility: joint limits and capsules: which poses a body can take."""

from pasdedeux.plausibility.capsules import (
    RADIUS_PER_HEIGHT,
    CapsuleModel,
    Penetration,
    body_height_m,
    capsule_model,
    penetration,
    segment_distance,
)
from pasdedeux.plausibility.capsules_kernel import clip_penetration, pair_penetration
from pasdedeux.plausibility.joint_limits import MOST_INVALID_ANGLES, JointLimits, NearestValid, joint_angles
from pasdedeux.plausibility.joint_limits_kernel import measure_angles, move_to_nearest_valid
from pasdedeux.plausibility.ranges import ANGLES, AngleRange

__all__ = [
    "ANGLES",
    "MOST_INVALID_ANGLES",
    "RADIUS_PER_HEIGHT",
    "AngleRange",
    "CapsuleModel",
    "JointLimits",
    "NearestValid",
    "Penetration",
    "body_height_m",
    "capsule_model",
    "clip_penetration",
    "joint_angles",
    "measure_angles",
    "move_to_nearest_valid",
    "pair_penetration",
    "penetration",
    "segment_distance",
]
