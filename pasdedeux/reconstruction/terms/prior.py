"""Priors of single unknowns: statures, the lens, the height of the camera, the tilt of the floor, offsets of ankles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.reconstruction.terms.placed import PlacedPeople, SeenPeople
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm

KNOWN_DEVIATION = 0.01
"""Standard deviation of the log of a stated stature, height or lens."""
_STATURE_M = 1.68
"""Mean of the statures of women (1.61 m) and men (1.75 m; Fryar et al. 2021)."""
STATURE_DEVIATION = 0.06
"""Standard deviation of the log of a stature that is not stated."""


@dataclass(frozen=True)
class PriorTerm(SceneTerm):
    """(x_i - wanted_i) / deviation_i.

    Args:
        unknowns: Indices of the unknowns i (n,).
        wanted: Their most likely values (n,), or one for all.
        deviations: Their standard deviations (n,), or one for all.
    """

    unknowns: npt.ArrayLike
    wanted: npt.ArrayLike
    deviations: npt.ArrayLike

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (n,)."""
        return np.asarray((scene.x[np.atleast_1d(self.unknowns)] - self.wanted) / self.deviations)

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        columns = np.atleast_1d(self.unknowns)[:, None]
        return Jacobian(columns, np.ones(columns.shape) / np.reshape(self.deviations, (-1, 1)))


def stature_term(seen: SeenPeople, statures_m: Mapping[int, float]) -> PriorTerm:
    """Return the term (log size - log(stature / initial stature)) / deviation of every person.

    Args:
        seen: The people.
        statures_m: Known statures by person id.
    """
    stated = [statures_m.get(person.track.person_id) for person in seen.people]
    wanted = [stature_m or _STATURE_M for stature_m in stated] / np.array([person.stature_m for person in seen.people])
    deviations = [STATURE_DEVIATION if stature_m is None else KNOWN_DEVIATION for stature_m in stated]
    return PriorTerm(seen.sizes, np.log(wanted), np.array(deviations))
