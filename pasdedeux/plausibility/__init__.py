"""Plausibility: joint limits and capsules: which poses a body can take."""

from pasdedeux.plausibility.capsules import (
    RADIUS_PER_HEIGHT,
    CapsuleModel,
    body_height_m,
    capsule_model,
    pair_penetration,
    segment_distance,
)
from pasdedeux.plausibility.joint_limits import MAX_INVALID_ANGLES, JointLimits, NearestValid
from pasdedeux.plausibility.ranges import ANGLES, AngleRange

__all__ = [
    "ANGLES",
    "MAX_INVALID_ANGLES",
    "RADIUS_PER_HEIGHT",
    "AngleRange",
    "CapsuleModel",
    "JointLimits",
    "NearestValid",
    "body_height_m",
    "capsule_model",
    "pair_penetration",
    "segment_distance",
]
