"""The interface of terms of the scene estimate: residuals in standard deviations, and their Jacobian."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.reconstruction.terms.placed import PlacedPeople, SeenPeople


class Jacobian(NamedTuple):
    """Derivatives of residuals, each by a few unknowns.

    Args:
        columns: Indices of the unknowns of each residual (n, k).
        slopes: Its derivatives by them (n, k).
    """

    columns: Integers
    slopes: Array


class SceneTerm(ABC):
    """Residuals of one kind.

    Attributes:
        is_robust: Whether outliers have less weight.
        is_certain: Whether the term counts in the deviation of places; terms that may be wrong all the time do not.
        alike_s: Errors of frames within this time are alike, so that they count as one.
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
        """Tell which residuals (n,) have less weight if they are outliers."""
        return np.full(residual.shape, self.is_robust)

    def share(self, seen: SeenPeople) -> float:
        """Return the weight of each residual."""
        return 1.0 / max(1.0, self.alike_s * seen.rate_hz)
