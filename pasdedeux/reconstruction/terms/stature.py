"""How tall people are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pasdedeux.reconstruction.terms.placed import SeenPeople
from pasdedeux.reconstruction.terms.prior import KNOWN_DEVIATION, PriorTerm

_STATURE_M = 1.68
"""Mean of the statures of women (1.61 m) and men (1.75 m; Fryar et al. 2021)."""
STATURE_DEVIATION = 0.06
"""Standard deviation of the log of a stature."""


def stature_term(seen: SeenPeople, statures_m: Mapping[int, float]) -> PriorTerm:
    """Return the term (log size - log(stature / initial stature)) / deviation of every person.

    Args:
        seen: The people.
        statures_m: Stature by person id, where it is known.
    """
    stated = [statures_m.get(person.track.person_id) for person in seen.people]
    wanted = [stature_m or _STATURE_M for stature_m in stated] / np.array([person.stature_m for person in seen.people])
    deviations = [STATURE_DEVIATION if stature_m is None else KNOWN_DEVIATION for stature_m in stated]
    return PriorTerm(seen.sizes, np.log(wanted), np.array(deviations))
