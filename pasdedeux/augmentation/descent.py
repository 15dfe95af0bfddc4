"""The guaranteed solver: Levenberg-Marquardt on bone directions, whose energy never rises and whose bones are exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.energy import energy_terms
from pasdedeux.augmentation.problem import AXIS_GROUP, GIRDLE_PAIRS, Problem, Targets
from pasdedeux.augmentation.spans import SpanTerm
from pasdedeux.augmentation.terms import contact_matrix, right_hand_side
from pasdedeux.fitting import BoneForest, DistanceTerm, FitSettings, HalfSpaceTerm, QuadraticTerm, Term, fit_bones
from pasdedeux.skeletons import BODY22

__all__ = ["DescentResult", "descend", "fit_terms"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DescentResult:
    """What the guaranteed solver gives for one variant.

    Args:
        positions: (T, 44, 3), metres.
        energies: Energy at the start and after every accepted step; never rises.
        num_iterations: Steps tried.
        is_converged: The energy no longer falls.
    """

    positions: Array
    energies: tuple[float, ...]
    num_iterations: int
    is_converged: bool


def fit_terms(problem: Problem, targets: Targets, variant: int) -> list[Term]:
    """State the energy of one variant as terms of a fit."""
    one = targets.select([variant])
    groups = list(AXIS_GROUP)
    zero = np.zeros((1, *one.difference.shape[1:]))
    # At x = 0, where p = r, the girdle's energy is 0, and those of clearance and spans are counted by their own terms.
    start = energy_terms(problem, one, zero)
    constant = float(sum(energy[0] for name, energy in start.items() if name not in ("clearance", "spans")))
    matrix = problem.matrix[groups]
    matrix -= contact_matrix(problem.contact - problem.directed)
    girdle = DistanceTerm(pairs=GIRDLE_PAIRS, lengths_m=one.girdle_m[0], weights=np.array(problem.weights.girdle))
    quadratic = QuadraticTerm(
        origin_m=one.reference[0],
        matrix=matrix,
        lag1=problem.lag1[groups],
        lag2=problem.lag2[groups],
        linear=np.moveaxis(right_hand_side(problem, one)[..., 0], 0, -1),
        constant=constant,
    )
    near = problem.clearance
    clearance = HalfSpaceTerm(
        origin_m=one.reference[0],
        points=near.points,
        shares=near.shares,
        normals=near.normals,
        limits_m=one.clearance_m[0],
        weights=near.weights,
    )
    return [quadratic, girdle, clearance, SpanTerm(problem.spans)]


def descend(
    problem: Problem,
    targets: Targets,
    variant: int,
    start: Array | None = None,
    settings: FitSettings | None = None,
    *,
    more: Sequence[Term] = (),
) -> DescentResult:
    """Solve one variant, from `start` (T, 44, 3) or from plain forward kinematics; `more` adds to its terms."""
    forest = BoneForest((BODY22, BODY22), targets.lengths_m[variant])
    first = forest.state_of(targets.reference[variant] if start is None else start)
    result = fit_bones(forest, first, [*fit_terms(problem, targets, variant), *more], settings)
    return DescentResult(
        positions=result.positions_m,
        energies=result.energies,
        num_iterations=result.num_iterations,
        is_converged=result.is_converged,
    )
