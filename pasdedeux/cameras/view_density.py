"""The density of camera views over a set of annotations: lift eq. 5 (Yin et al. 2018)."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.orthographic import view_rotmat
from pasdedeux.kinematics.rotations import normalise

VIEW_DEVIATION_RAD = 0.5
"""sigma_v of lift eq. 5, radians."""


def draw_views(rng: np.random.Generator, directions: Array, weights: Array, count: int) -> Array:
    """Draw views (count, 3) from the smoothed density over given ones: choose a view by weight, then draw around it.

    The kernel is von Mises-Fisher with concentration 1 / deviation^2.  Near its centre it is normal with that
    deviation, and it has neither seam nor poles.  The paper uses a normal in (psi, phi).

    Args:
        rng: Source of randomness.
        directions: Views in the local frame, (n, 3).
        weights: Weight of each view, (n,), such as hypothesis weight x trust; at least one is positive.
        count: Number of draws.
    """
    centres = normalise(directions[rng.choice(len(directions), size=count, p=weights / weights.sum())])
    kappa = 1.0 / VIEW_DEVIATION_RAD**2
    # The cosine to the centre has a closed inverse distribution in three dimensions (Ulrich 1984).
    cosine = 1.0 + np.log1p(rng.random(count) * np.expm1(-2.0 * kappa)) / kappa
    turn = rng.uniform(0.0, 2.0 * np.pi, size=count)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    local = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
    axes = view_rotmat(centres, np.array([0.0, 1.0, 0.0]))
    return np.asarray(np.einsum("nij,ni->nj", axes, local))
