"""Priors of single unknowns: the lens, the height of the camera, the tilt of the floor and the offsets of ankles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.reconstruction.terms.placed import PlacedPeople
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm

KNOWN_DEVIATION = 0.01
"""Standard deviation of the log of a stated stature, height or lens."""


@dataclass(frozen=True)
class PriorTerm(SceneTerm):
    """(x_i - wanted_i) / deviation_i.

    Args:
        unknowns: Places of the unknowns i (n,).
        wanted: Their most likely values (n,), or one of all.
        deviations: Standard deviations of these (n,), or one of all.
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
