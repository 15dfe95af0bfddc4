"""Augmentation: a pair's motion for other body proportions, contacts kept and bone lengths exact."""

from pasdedeux.augmentation.augment import Augmenter, Variant
from pasdedeux.augmentation.bulk import BulkSettings, BulkSolver
from pasdedeux.augmentation.contacts import ContactSettings, UserContact
from pasdedeux.augmentation.descent import descend
from pasdedeux.augmentation.energy import energy_terms, total_energy
from pasdedeux.augmentation.mesh import InteractionMesh, build_mesh
from pasdedeux.augmentation.problem import Problem, Targets
from pasdedeux.augmentation.quality import FrameLimits, FrameQuality, Limit, Quality, QualityLimits
from pasdedeux.augmentation.rotations import variant_rotations
from pasdedeux.augmentation.settings import POLISH, AugmentationSettings
from pasdedeux.augmentation.source import Source, reference_motion
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import (
    LIMB_GROUPS,
    PAPER_SCALES,
    Variation,
    bone_variations,
    drawn_variations,
    group_variations,
    population_variations,
    scale_grid,
    uniform_variations,
)
from pasdedeux.augmentation.weights import Weights
from pasdedeux.augmentation.windows import WindowSettings

__all__ = [
    "LIMB_GROUPS",
    "PAPER_SCALES",
    "POLISH",
    "AugmentationSettings",
    "Augmenter",
    "BulkSettings",
    "BulkSolver",
    "ContactSettings",
    "FrameLimits",
    "FrameQuality",
    "InteractionMesh",
    "Limit",
    "Problem",
    "Quality",
    "QualityLimits",
    "Source",
    "Targets",
    "UserContact",
    "Variant",
    "Variation",
    "Weights",
    "WindowSettings",
    "bone_variations",
    "build_mesh",
    "build_problem",
    "build_targets",
    "descend",
    "drawn_variations",
    "energy_terms",
    "group_variations",
    "population_variations",
    "reference_motion",
    "scale_grid",
    "total_energy",
    "uniform_variations",
    "variant_rotations",
]
