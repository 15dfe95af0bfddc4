"""The density of camera views over a set of annotations: lift eq. 5 (Yin et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.frames import angles_of_direction, direction_of_angles
from pasdedeux.cameras.orthographic import view_rotmat
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise

__all__ = ["VIEW_DEVIATION_RAD", "ViewDensity"]

Array = npt.NDArray[np.float64]

VIEW_DEVIATION_RAD = 0.5
"""sigma_v of lift eq. 5, radians."""

_FORMS = ("sphere", "planar")


@dataclass(frozen=True)
class ViewDensity:
    """A kernel density over views.

    On the sphere the kernel is von Mises-Fisher with concentration 1 / deviation^2, which near its centre is the normal
    of that deviation, and which has no seam and no poles.  The published form, `planar`, is a normal in (psi, phi) that
    knows neither.

    Args:
        directions: Views in the local frame, (n, 3), unit.
        weights: Weight of each view, (n,), such as hypothesis weight x trust; scaled to sum to 1.
        deviation_rad: Width of the kernel.
        form: `sphere` (default) or `planar`.

    Raises:
        InputError: No view, a negative or zero total weight, a width that is not positive, or an unknown form.
    """

    directions: Array
    weights: Array
    deviation_rad: float = VIEW_DEVIATION_RAD
    form: str = "sphere"

    def __post_init__(self) -> None:
        """Check the values and scale the weights."""
        if self.form not in _FORMS:
            raise InputError(f"view density: the form is '{self.form}'; allowed: {', '.join(_FORMS)}")
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

    @property
    def concentration(self) -> float:
        """Concentration of the von Mises-Fisher kernel."""
        return 1.0 / self.deviation_rad**2

    def density(self, directions: Array) -> Array:
        """Return density at views (*batch, 3), per steradian; per square radian of (psi, phi) in the planar form."""
        queries = normalise(np.asarray(directions, dtype=np.float64))
        flat = queries.reshape(-1, 3)
        out = np.empty(len(flat))
        for start in range(0, len(flat), 1024):
            out[start : start + 1024] = self._kernel(flat[start : start + 1024]) @ self.weights
        return out.reshape(queries.shape[:-1])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw views (count, 3): one of the set by weight, then the kernel around it."""
        centres = self.directions[rng.choice(len(self.directions), size=count, p=self.weights)]
        if self.form == "planar":
            psi, phi = angles_of_direction(centres)
            psi = psi + rng.normal(scale=self.deviation_rad, size=count)
            phi = phi + rng.normal(scale=self.deviation_rad, size=count)
            return direction_of_angles(psi, phi)
        kappa = self.concentration
        # The cosine to the centre has a closed inverse distribution in three dimensions (Ulrich 1984).
        cosine = 1.0 + np.log1p(rng.random(count) * np.expm1(-2.0 * kappa)) / kappa
        turn = rng.uniform(0.0, 2.0 * np.pi, size=count)
        sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        local = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
        axes = view_rotmat(centres, np.array([0.0, 1.0, 0.0]))
        return np.asarray(np.einsum("nij,ni->nj", axes, local))

    def _kernel(self, queries: Array) -> Array:
        if self.form == "planar":
            psi, phi = angles_of_direction(queries)
            centre_psi, centre_phi = angles_of_direction(self.directions)
            squared = (psi[:, None] - centre_psi) ** 2 + (phi[:, None] - centre_phi) ** 2
            norm = 2.0 * np.pi * self.deviation_rad**2
            return np.asarray(np.exp(-0.5 * squared / self.deviation_rad**2) / norm)
        kappa = self.concentration
        norm = kappa / (2.0 * np.pi * -np.expm1(-2.0 * kappa))
        return np.asarray(norm * np.exp(kappa * (queries @ self.directions.T - 1.0)))
