"""Augmentation: a pair's motion for other body proportions, contacts kept and bone lengths exact."""

from pasdedeux.augmentation.augment import Augmenter, Variant
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, reference_motion, scaled_rest, variant_rotations
from pasdedeux.augmentation.variations import LIMB_GROUPS, VariationSettings, make_variations, uniform_variations
from pasdedeux.interaction.known_contacts import UserContact

__all__ = [
    "LIMB_GROUPS",
    "AugmentationSettings",
    "Augmenter",
    "Source",
    "UserContact",
    "Variant",
    "VariationSettings",
    "make_variations",
    "reference_motion",
    "scaled_rest",
    "uniform_variations",
    "variant_rotations",
]
