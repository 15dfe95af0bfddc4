"""Robust least squares: the unknowns of a scene that minimise the weighted squares of all terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.reconstruction.terms.placed import PlacedPeople, SeenPeople
from pasdedeux.reconstruction.terms.term import SceneTerm

_ROBUST = 3.0
"""Size of a robust residual, in deviations, at which its weight is a quarter (Geman and McClure 1985)."""
_NUM_STEPS, _NUM_DAMPINGS = 25, 8
_WIDE, _NUM_WIDE = 4.0, 8
"""Factor on the width of robust terms in the first step, and number of steps until it falls to 1."""
_DAMPING, _MIN_DAMPING = 1e-3, 1e-6
_TOLERANCE = 1e-5
"""The search ends after a step that lowers the cost by less than this share."""


@dataclass(frozen=True)
class Solution:
    """The scene of least cost, that cost, and the variance of a weighted sum of unknowns by its curvature."""

    scene: PlacedPeople
    cost: float
    variance_of: Callable[[Array], float]


def solve_scene(terms: Sequence[SceneTerm], seen: SeenPeople, start: Array, *, side: float) -> Solution:
    """Return the scene of least cost.

    Gauss-Newton steps with Levenberg's damping; robust residuals are reweighted in each step by the weights of Geman
    and McClure (1985), which start wide.

    Args:
        terms: Terms of the sum.
        seen: The people.
        start: First guess of the unknowns (n,).
        side: On which side of the camera the floor is, see `PlacedPeople`.
    """
    from scipy.sparse import eye_array  # here: 0.2 s that planning does not need
    from scipy.sparse.linalg import splu

    damping, damped = _DAMPING, eye_array(len(start))
    costs = _Costs.of(terms, PlacedPeople(seen, start, side))
    for step_number in range(_NUM_STEPS):
        # Start wide: with a wrong size, everybody seems to fly all the time.
        scale = _ROBUST * max(1.0, _WIDE * (1.0 - step_number / _NUM_WIDE))
        jacobian, weight = costs.jacobian(), costs.weights(scale)
        normal = jacobian.T @ jacobian.multiply(weight[:, None]).tocsr()
        gradient = jacobian.T @ (weight * costs.residual)
        cost = costs.cost(scale)
        for _ in range(_NUM_DAMPINGS):
            step = -splu((normal + damping * damped).tocsc()).solve(gradient)
            moved = _Costs.of(terms, PlacedPeople(seen, costs.scene.x + step, side))
            if moved.cost(scale) < cost:
                break
            damping *= 10.0
        else:
            damping = _DAMPING
            if step_number > _NUM_WIDE:
                break
            continue
        costs, damping = moved, max(0.1 * damping, _MIN_DAMPING)
        if step_number > _NUM_WIDE and cost - costs.cost(scale) < _TOLERANCE * cost:
            break
    curvature = splu((normal + _MIN_DAMPING * damped).tocsc())
    return Solution(costs.scene, costs.cost(_ROBUST), lambda weights: float(weights @ curvature.solve(weights)))


@dataclass(frozen=True)
class _Costs:
    """All residuals of a scene: values, weights (`share`), and whether they are robust (n,)."""

    terms: Sequence[SceneTerm]
    scene: PlacedPeople
    residual: Array
    share: Array
    is_robust: Array

    @classmethod
    def of(cls, terms: Sequence[SceneTerm], scene: PlacedPeople) -> _Costs:
        residuals = [term.residual(scene) for term in terms]
        return cls(
            terms,
            scene,
            np.concatenate(residuals),
            np.repeat([term.share(scene.seen) for term in terms], [len(residual) for residual in residuals]),
            np.concatenate([term.robust(residual) for term, residual in zip(terms, residuals, strict=True)]),
        )

    def weights(self, scale: float) -> Array:
        return self.share * np.where(self.is_robust, 1.0 / (1.0 + (self.residual / scale) ** 2) ** 2, 1.0)

    def cost(self, scale: float) -> float:
        bounded = self.residual**2 / (1.0 + (self.residual / scale) ** 2)
        return float((self.share * np.where(self.is_robust, bounded, self.residual**2)).sum())

    def jacobian(self) -> Any:
        """Return the derivatives (residual, unknown), sparse."""
        from scipy.sparse import csr_array

        parts = [term.jacobian(self.scene) for term in self.terms]
        counts = np.repeat([part.columns.shape[1] for part in parts], [len(part.columns) for part in parts])
        columns, slopes = (np.concatenate([values.ravel() for values in kind]) for kind in zip(*parts, strict=True))
        ends = np.concatenate([[0], np.cumsum(counts)])
        return csr_array((slopes, columns, ends), shape=(len(counts), len(self.scene.x)))
