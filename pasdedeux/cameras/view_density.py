"""The density of camera views over a set of annotations: lift eq. 5 (Yin et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.orthographic import view_rotmat
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise

VIEW_DEVIATION_RAD = 0.5
"""sigma_v of lift eq. 5, radians."""


@dataclass(frozen=True)
class ViewDensity:
    """A smoothed density over views.

    Von Mises-Fisher with concentration 1 / deviation^2, near its centre the normal of that deviation, which
    has no seam and no poles.  The paper takes a normal in (psi, phi).

    Args:
        directions: Views in the local frame, (n, 3), unit.
        weights: Weight of each view, (n,), such as hypothesis weight x trust; scaled to sum to 1.
        deviation_rad: Width of the density round each view.

    Raises:
        InputError: No view, a negative or zero total weight, or a width that is not positive.
    """

    directions: Array
    weights: Array
    deviation_rad: float = VIEW_DEVIATION_RAD

    def __post_init__(self) -> None:
        """Check the values and scale the weights."""
        if not self.deviation_rad > 0:
            raise InputError(f"view density: the width is {self.deviation_rad} rad, it must be positive")
        directions = np.asarray(self.directions, dtype=np.float64)
        weights = np.asarray(self.weights, dtype=np.float64)
        if directions.ndim != 2 or directions.shape[1] != 3 or weights.shape != directions.shape[:1]:
            raise InputError(f"view density: shapes {directions.shape} and {weights.shape} are not (n, 3) and (n,)")
        if not (weights >= 0).all() or not weights.sum() > 0:
            raise InputError("view density: there is no view with a positive weight")
        object.__setattr__(self, "directions", normalise(directions))
        object.__setattr__(self, "weights", weights / weights.sum())

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw views (count, 3): one of the set by weight, then round it."""
        centres = self.directions[rng.choice(len(self.directions), size=count, p=self.weights)]
        kappa = 1.0 / self.deviation_rad**2
        # The cosine to the centre has a closed inverse distribution in three dimensions (Ulrich 1984).
        cosine = 1.0 + np.log1p(rng.random(count) * np.expm1(-2.0 * kappa)) / kappa
        turn = rng.uniform(0.0, 2.0 * np.pi, size=count)
        sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        local = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
        axes = view_rotmat(centres, np.array([0.0, 1.0, 0.0]))
        return np.asarray(np.einsum("nij,ni->nj", axes, local))
