"""Robust least squares: a few common unknowns, and many of which each residual depends on three at most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers

_STEP = 1e-6
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
        stencil: The unknowns each depends on (n, k at most 3), beside the common ones.
        is_robust: Whether outliers count less (n,), or of all.
        weight: How much each counts.
    """

    value: Array
    stencil: Integers
    is_robust: Flags | bool = False
    weight: float = 1.0


class Problem(Protocol):
    """Residuals of unknowns of which the first `num_globals` are common to all.

    Unknowns of one `colour` (unknown,) share no residual, so that their derivatives are taken at once; every common one
    has a colour of its own.  `start` is where the search begins.
    """

    start: Array
    num_globals: int
    colour: Integers

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
        jacobian = _jacobian(problem, x, made)
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
    """All terms in a row: values, robustness and weights (n,), the stencils (n, at most 3), -1 where there is none."""

    value: Array
    is_robust: Flags
    weight: Array
    stencil: Integers

    def weights(self, scale: float) -> Array:
        return self.weight * np.where(self.is_robust, 1.0 / (1.0 + (self.value / scale) ** 2) ** 2, 1.0)

    def cost(self, scale: float) -> float:
        bounded = self.value**2 / (1.0 + (self.value / scale) ** 2)
        return float((self.weight * np.where(self.is_robust, bounded, self.value**2)).sum())


def _joined(terms: Sequence[Term]) -> _Joined:
    stencils = [np.pad(one.stencil, ((0, 0), (0, 3 - one.stencil.shape[1])), constant_values=-1) for one in terms]
    return _Joined(
        np.concatenate([one.value for one in terms]),
        np.concatenate([np.broadcast_to(one.is_robust, one.value.shape) for one in terms]),
        np.concatenate([np.full(len(one.value), one.weight) for one in terms]),
        np.concatenate(stencils),
    )


def _jacobian(problem: Problem, x: Array, made: _Joined) -> Any:
    """Return the derivatives (residual, unknown), sparse: unknowns of a colour are moved together."""
    from scipy.sparse import coo_array

    moved = np.stack(
        [
            (_joined(problem.terms(x + _STEP * (problem.colour == colour))).value - made.value) / _STEP
            for colour in range(problem.colour.max() + 1)
        ]
    )
    everywhere = np.arange(len(made.value))
    columns = [np.full(len(everywhere), index) for index in range(problem.num_globals)]
    entries = [moved[problem.colour[index]] for index in range(problem.num_globals)]
    for column in made.stencil.T:
        entries.append(np.where(column >= 0, moved[problem.colour[column], everywhere], 0.0))
        columns.append(np.maximum(column, 0))
    rows = np.tile(everywhere, len(columns))
    shape = (len(everywhere), len(x))
    return coo_array((np.concatenate(entries), (rows, np.concatenate(columns))), shape=shape).tocsr()
