"""Settings of augmentation: how variants are solved and judged."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pasdedeux.augmentation.quality import LIMITS
from pasdedeux.interaction.known_contacts import Letter
from pasdedeux.settings import Settings

__all__ = ["AugmentationSettings"]


def _check_limit(limit: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= limit[0] <= limit[1]:
        raise ValueError(f"warn {limit[0]:g}, fail {limit[1]:g}: allowed is 0 <= warn <= fail")
    return limit


def _completed(given: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return the limits with those that are not given as they are known."""
    for name in given:
        if name not in LIMITS:
            raise ValueError(f"'{name}' is no figure that is judged; there are: {', '.join(LIMITS)}")
    return {**LIMITS, **given}


Limit = Annotated[tuple[float, float], AfterValidator(_check_limit)]


class AugmentationSettings(Settings):
    """Everything that decides how a variant is solved and judged."""

    fixed_person: Letter | None = Field(
        None, description="Person who keeps the source's motion, in takes that have this person"
    )
    limits: Annotated[dict[str, Limit], AfterValidator(_completed)] = Field(
        dict(LIMITS),
        description="By figure (a column of `variant_quality`): above the first a warning, above the second a failure",
    )
    floor_m: float | None = Field(
        None, description="Height of toe joints that stand, metres; found from everybody's feet where not given"
    )
    solver: Literal["bulk", "polished"] = Field(
        "bulk", description="bulk, or polished (every variant ends with guaranteed descent)"
    )
