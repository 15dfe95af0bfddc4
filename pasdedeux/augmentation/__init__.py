"""Augmentation: a pair's motion for other body proportions, contacts kept and bone lengths exact."""

from pasdedeux.augmentation.augment import Augmenter, Variant
from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.contacts import UserContact
from pasdedeux.augmentation.energy import descend, fit_terms, total_energy
from pasdedeux.augmentation.mesh import InteractionMesh, build_mesh
from pasdedeux.augmentation.problem import Problem, Targets
from pasdedeux.augmentation.quality import FrameLimits, FrameQuality, Quality, QualityLimits
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, reference_motion, variant_rotations
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import (
    LIMB_GROUPS,
    PAPER_SCALES,
    DrawnBodies,
    DrawnScales,
    ScaleGrid,
    Variation,
    VariationSettings,
    bone_variations,
    drawn_variations,
    group_variations,
    make_variations,
    population_variations,
    uniform_variations,
)
from pasdedeux.augmentation.weights import Weights

__all__ = [
    "LIMB_GROUPS",
    "PAPER_SCALES",
    "AugmentationSettings",
    "Augmenter",
    "BulkSolver",
    "DrawnBodies",
    "DrawnScales",
    "FrameLimits",
    "FrameQuality",
    "InteractionMesh",
    "Problem",
    "Quality",
    "QualityLimits",
    "ScaleGrid",
    "Source",
    "Targets",
    "UserContact",
    "Variant",
    "Variation",
    "VariationSettings",
    "Weights",
    "bone_variations",
    "build_mesh",
    "build_problem",
    "build_targets",
    "descend",
    "drawn_variations",
    "fit_terms",
    "group_variations",
    "make_variations",
    "population_variations",
    "reference_motion",
    "total_energy",
    "uniform_variations",
    "variant_rotations",
]
