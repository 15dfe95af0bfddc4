"""Settings of augmentation: how variants are solved and judged."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pasdedeux.augmentation.quality import FrameLimits, QualityLimits
from pasdedeux.augmentation.weights import Weights
from pasdedeux.augmentation.windows import OVERLAP_S
from pasdedeux.interaction.contacts import TOUCH_M
from pasdedeux.interaction.known_contacts import Letter
from pasdedeux.settings import Settings

__all__ = ["AugmentationSettings"]


def _check_fade(fade: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= fade[0] < fade[1]:
        raise ValueError(f"({fade[0]:g}, {fade[1]:g}): the fade must end beyond its start, both from 0")
    return fade


class AugmentationSettings(Settings):
    """Everything that decides how a variant is solved and judged."""

    fixed_person: Letter | None = Field(
        None, description="Person who keeps the source's motion, in takes that have this person"
    )
    weights: Weights = Field(Weights(), description="Weights of the terms")
    limits: QualityLimits = Field(QualityLimits(), description="Limits of pass, warn and fail")
    frame_limits: FrameLimits = Field(FrameLimits(), description="The same for single frames")
    floor_m: float | None = Field(
        None, description="Height of toe joints that stand, metres; found from everybody's feet where not given"
    )
    touch_m: Annotated[tuple[float, float], AfterValidator(_check_fade)] = Field(
        TOUCH_M, description="Distance of surfaces in contact: full weight up to, none from; metres"
    )
    solver: Literal["bulk", "polished"] = Field(
        "bulk", description="bulk, or polished (every variant ends with guaranteed descent)"
    )
    num_iterations: int = Field(
        300, ge=1, description="Most iterations of the bulk solver; settled variants end sooner"
    )
    window_s: float = Field(
        30.0,
        gt=2.0 * OVERLAP_S,
        description="Longer takes are solved in overlapping windows of this length, seconds, at most 1,200 frames",
    )
