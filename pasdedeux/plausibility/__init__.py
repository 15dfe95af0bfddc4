"""Plausibility: joint limits and capsules: which poses a body can take."""

from pasdedeux.plausibility.joint_limits import MOST_INVALID_ANGLES, JointLimits, NearestValid, joint_angles
from pasdedeux.plausibility.joint_limits_kernel import count_invalid_angles, measure_angles, move_to_nearest_valid
from pasdedeux.plausibility.ranges import ANGLES, AngleRange

__all__ = [
    "ANGLES",
    "MOST_INVALID_ANGLES",
    "AngleRange",
    "JointLimits",
    "NearestValid",
    "count_invalid_angles",
    "joint_angles",
    "measure_angles",
    "move_to_nearest_valid",
]
