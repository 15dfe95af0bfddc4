"""What every term of the scene estimate gives: residuals in standard deviations, and their Jacobian."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.reconstruction.terms.placed import PlacedPeople, SeenPeople


class Jacobian(NamedTuple):
    """Derivatives of residuals, each by a few unknowns.

    Args:
        columns: Unknowns that each residual depends on (n, k).
        slopes: Its derivatives by these (n, k).
    """

    columns: Integers
    slopes: Array


class SceneTerm(ABC):
    """Residuals of one kind.

    Attributes:
        is_robust: Outliers count less.
        is_certain: Counts in the deviation of places: what may be wrong all the time makes no place well known.
        alike_s: Frames within this time err alike and count as one.
    """

    is_robust: ClassVar[bool] = False
    is_certain: ClassVar[bool] = True
    alike_s: ClassVar[float] = 0.0

    @abstractmethod
    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (n,), in standard deviations."""

    @abstractmethod
    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives by the unknowns."""

    def robust(self, residual: Array) -> Flags:
        """Tell which residuals (n,) count less if they are outliers."""
        return np.full(residual.shape, self.is_robust)

    def share(self, seen: SeenPeople) -> float:
        """Return how much each residual counts."""
        return 1.0 / max(1.0, self.alike_s * seen.rate_hz)
