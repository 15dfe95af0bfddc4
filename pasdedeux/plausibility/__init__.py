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
from pasdedeux.plausibility.learned_limits import LearnedLimits
from pasdedeux.plausibility.learned_limits_kernel import move_to_nearest_learned
from pasdedeux.plausibility.occupancy import BONES, NUM_ABOVE, NUM_CELLS, Occupancy
from pasdedeux.plausibility.occupancy_kernel import weakest_bone
from pasdedeux.plausibility.ranges import ANGLES, AngleRange

__all__ = [
    "ANGLES",
    "BONES",
    "MOST_INVALID_ANGLES",
    "NUM_ABOVE",
    "NUM_CELLS",
    "RADIUS_PER_HEIGHT",
    "AngleRange",
    "CapsuleModel",
    "JointLimits",
    "LearnedLimits",
    "NearestValid",
    "Occupancy",
    "Penetration",
    "body_height_m",
    "capsule_model",
    "clip_penetration",
    "joint_angles",
    "measure_angles",
    "move_to_nearest_learned",
    "move_to_nearest_valid",
    "pair_penetration",
    "penetration",
    "segment_distance",
    "weakest_bone",
]
