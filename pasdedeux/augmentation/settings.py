"""Settings of augmentation."""

from __future__ import annotations

from dataclasses import dataclass, field

from pasdedeux.augmentation.bulk import BulkSettings
from pasdedeux.augmentation.contacts import ContactSettings, UserContact
from pasdedeux.augmentation.quality import FrameLimits, QualityLimits
from pasdedeux.augmentation.weights import Weights
from pasdedeux.augmentation.windows import WindowSettings
from pasdedeux.fitting import FitSettings
from pasdedeux.plausibility import JointLimits

__all__ = ["POLISH", "AugmentationSettings"]

POLISH = FitSettings(max_iterations=40, tolerance=1e-4)
"""Descent after bulk that comes to within a thousandth of the least energy; the fallback's own stops earlier."""


@dataclass(frozen=True)
class AugmentationSettings:
    """Everything that decides a variant.

    Args:
        weights: Weights of the terms.
        contacts: What counts as contact, stance and floor.
        limits: When a figure of a variant is a warning or a failure.
        frame_limits: The same for the figures of one frame.
        bulk: The bulk solver's settings.
        descent: The guaranteed solver's settings.
        fallback_residual_m: A variant whose bones the bulk solver leaves further than this from their lengths (root
            mean square) goes to the guaranteed solver, started from where bulk ended.
        is_bulk: Use the bulk solver; without it every variant is solved by guaranteed descent.
        mesh_smoothing_s: Averaging of the mesh weights over time.
        fixed_person: Person (0 or 1) who keeps the source's motion, or None.
        girth: New over old radius of the bodies of A and B; 1 leaves them as thick as they were, whatever the bones do.
        joint_limits: Ranges of the joints that variants are checked against, widened by what the source does; None
            checks nothing.
        user_contacts: Contacts that replace what is found.
        windows: How long takes are cut.
    """

    weights: Weights = field(default_factory=Weights)
    contacts: ContactSettings = field(default_factory=ContactSettings)
    limits: QualityLimits = field(default_factory=QualityLimits)
    frame_limits: FrameLimits = field(default_factory=FrameLimits)
    bulk: BulkSettings = field(default_factory=lambda: BulkSettings(is_single_precision=True))
    descent: FitSettings = field(default_factory=lambda: FitSettings(max_iterations=12, tolerance=5e-3))
    fallback_residual_m: float = 5e-4
    is_bulk: bool = True
    mesh_smoothing_s: float = 0.25
    fixed_person: int | None = None
    girth: tuple[float, float] = (1.0, 1.0)
    joint_limits: JointLimits | None = None
    user_contacts: tuple[UserContact, ...] = ()
    windows: WindowSettings = field(default_factory=WindowSettings)
