"""Settings of augmentation: how variants are solved and judged."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pasdedeux.augmentation.quality import FIGURES
from pasdedeux.figure import complete_limits, limits_of
from pasdedeux.interaction.known_contacts import Letter
from pasdedeux.settings import Settings


class AugmentationSettings(Settings):
    """Everything that decides how a variant is solved and judged."""

    fixed_person: Letter | None = Field(
        None, description="Person who keeps the source's motion, in takes that have this person"
    )
    limits: Annotated[dict[str, tuple[float, float]], AfterValidator(partial(complete_limits, FIGURES))] = Field(
        limits_of(FIGURES),
        description="By figure (a column of `variant_quality`): above the first a warning, above the second a failure",
    )
    floor_m: float | None = Field(
        None, description="Height of toe joints that stand, metres; found from everybody's feet where not given"
    )
    solver: Literal["bulk", "polished"] = Field(
        "bulk", description="bulk, or polished (every variant ends with guaranteed descent)"
    )
