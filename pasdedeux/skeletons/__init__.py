"""Skeletons: topologies, joint names, and mappings between them."""

from pasdedeux.skeletons.expi18 import EXPI18, EXPI18_OF_BODY22, MAPPED_SKELETONS, MODEL_SKELETONS
from pasdedeux.skeletons.mapping import JointMap
from pasdedeux.skeletons.skeleton import Skeleton
from pasdedeux.skeletons.working import BODY22, COUNTED17, OP14, PAIR17, WORKING_SKELETONS

__all__ = [
    "BODY22",
    "COUNTED17",
    "EXPI18",
    "EXPI18_OF_BODY22",
    "MAPPED_SKELETONS",
    "MODEL_SKELETONS",
    "OP14",
    "PAIR17",
    "WORKING_SKELETONS",
    "JointMap",
    "Skeleton",
]
