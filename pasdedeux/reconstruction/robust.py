"""Robust least squares over many unknowns, of which each residual depends on a few."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers

_NUM_STEPS, _NUM_DAMPINGS = 25, 8
_WIDE, _NUM_WIDE = 4.0, 8
"""How much wider the robust terms are in the first step than in the last, and the steps until they are as stated."""
_DAMPING, _MIN_DAMPING = 1e-3, 1e-6
_TOLERANCE = 1e-5
"""Steps that lower the cost by less than this part of it are the last."""


@dataclass(frozen=True)
class Term:
    """Residuals of one kind.

    Args:
        value: In deviations (n,).
        stencil: The unknowns each depends on (n, k).
        slopes: Its derivatives by these (n, k).
        is_robust: Whether outliers count less (n,), or of all.
        weight: How much each counts.
    """

    value: Array
    stencil: Integers
    slopes: Array
    is_robust: Flags | bool = False
    weight: float = 1.0


class Problem(Protocol):
    """Residuals as a function of unknowns; `start` is where the search begins."""

    start: Array

    def terms(self, x: Array) -> list[Term]:
        """Return the residuals at these unknowns."""


@dataclass(frozen=True)
class Solution:
    """The unknowns of least cost, that cost, and by its curvature the variance of a sum of them with given weights."""

    x: Array
    cost: float
    variance_of: Callable[[Array], float]


def solve(problem: Problem, *, robust: float) -> Solution:
    """Return the unknowns of least cost.

    Steps of Gauss and Newton with Levenberg's damping; robust residuals count by the weights of Geman and McClure
    (1985), a quarter at `robust` deviations, anew in each step, and wider at first.

    Args:
        problem: Residuals as a function of the unknowns.
        robust: Deviations at which a robust residual counts a quarter.
    """
    from scipy.sparse import eye_array  # here: 0.2 s that planning does not need
    from scipy.sparse.linalg import splu

    x, damping = problem.start, _DAMPING
    made = _joined(problem.terms(x))
    for number in range(_NUM_STEPS):
        # First nearly everything counts: whose size is wrong seems to fly, all the time.
        scale = robust * max(1.0, _WIDE * (1.0 - number / _NUM_WIDE))
        jacobian = made.jacobian(len(x))
        weight = made.weights(scale)
        normal = jacobian.T @ jacobian.multiply(weight[:, None]).tocsr()
        gradient = jacobian.T @ (weight * made.value)
        cost = made.cost(scale)
        for _ in range(_NUM_DAMPINGS):
            step = -splu((normal + damping * eye_array(len(x))).tocsc()).solve(gradient)
            new = _joined(problem.terms(x + step))
            if new.cost(scale) < cost:
                break
            damping *= 10.0
        else:
            damping = _DAMPING
            if number > _NUM_WIDE:
                break
            continue
        x, made, damping = x + step, new, max(0.1 * damping, _MIN_DAMPING)
        if number > _NUM_WIDE and cost - made.cost(scale) < _TOLERANCE * cost:
            break
    curvature = splu((normal + _MIN_DAMPING * eye_array(len(x))).tocsc())
    return Solution(x, made.cost(robust), lambda weights: float(weights @ curvature.solve(weights)))


@dataclass(frozen=True)
class _Joined:
    """All terms in a row: values, robustness and weights (n,)."""

    terms: Sequence[Term]
    value: Array
    is_robust: Flags
    weight: Array

    def weights(self, scale: float) -> Array:
        return self.weight * np.where(self.is_robust, 1.0 / (1.0 + (self.value / scale) ** 2) ** 2, 1.0)

    def cost(self, scale: float) -> float:
        bounded = self.value**2 / (1.0 + (self.value / scale) ** 2)
        return float((self.weight * np.where(self.is_robust, bounded, self.value**2)).sum())

    def jacobian(self, num_unknowns: int) -> Any:
        """Return the derivatives (residual, unknown), sparse."""
        from scipy.sparse import csr_array

        counts = np.concatenate([np.full(len(one.value), one.stencil.shape[1]) for one in self.terms])
        columns, slopes = (
            np.concatenate([getattr(one, name).ravel() for one in self.terms]) for name in ("stencil", "slopes")
        )
        ends = np.concatenate([[0], np.cumsum(counts)])
        return csr_array((slopes, columns, ends), shape=(len(counts), num_unknowns))


def _joined(terms: Sequence[Term]) -> _Joined:
    return _Joined(
        terms,
        np.concatenate([one.value for one in terms]),
        np.concatenate([np.broadcast_to(one.is_robust, one.value.shape) for one in terms]),
        np.concatenate([np.full(len(one.value), one.weight) for one in terms]),
    )
