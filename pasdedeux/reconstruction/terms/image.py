"""How large a person looks in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.reconstruction.terms.placed import PlacedPeople, Unknown, beside
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm


@dataclass(frozen=True)
class ImageTerm(SceneTerm):
    """(l(t) - log size - log lens) / deviation: the log distance l follows from size and lens, given the image.

    Args:
        person: Number of the person.
        deviation: Standard deviation of the log of the size in the image, due to errors of poses.
    """

    person: int
    deviation: float = 0.05
    is_robust = True
    alike_s = 1.0

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (shown frame,)."""
        distance, size, lens = scene.x[self._columns(scene)].T
        return np.asarray((distance - size - lens) / self.deviation)

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        columns = self._columns(scene)
        return Jacobian(columns, np.broadcast_to(np.array([1.0, -1.0, -1.0]) / self.deviation, columns.shape))

    def _columns(self, scene: PlacedPeople) -> Integers:
        seen = scene.seen
        shown = seen.distances(self.person)[seen.people[self.person].shown]
        return np.asarray(beside(shown, seen.sizes[self.person], Unknown.LENS))
