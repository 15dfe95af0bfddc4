"""One window of a take: variants solved in bulk and, with solver `polished`, polished by guaranteed descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms, laplacian_residual
from pasdedeux.augmentation.problem import Targets
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.fitting.terms import Term, total_energy
from pasdedeux.interaction.known_contacts import UserContact

SOLVERS = ("bulk", "polished", "plain_fk")
"""Solvers of a variant; of several windows the last of these is stated."""

_ROUNDING = 1e-6
"""Energy per frame caused by single precision: a micrometre in all terms."""
POLISH = FitSettings(max_iterations=40, tolerance=1e-4)
"""Descent after bulk."""


@dataclass(frozen=True)
class SolvedWindow:
    """A batch of variants over one window.

    Args:
        positions: (variant, T, n, 3), metres; always finite.
        energy: Energy (variant,).
        energy_fk: Energy of plain forward kinematics (variant,), which is never lower.
        squared_residual: Mean squared Laplacian residual of each frame (variant, T), square metres.
        estimated_gap_m: Estimate of bulk's mean joint distance from the optimum (variant,), metres.
        solvers: One of `SOLVERS` for each variant.
        num_iterations: Iterations of each variant.
    """

    positions: Array
    energy: Array
    energy_fk: Array
    squared_residual: Array
    estimated_gap_m: Array
    solvers: list[str]
    num_iterations: list[int]


class WindowSolver:
    """A window prepared for any number of variants."""

    def __init__(self, source: Source, settings: AugmentationSettings, user_contacts: Sequence[UserContact]) -> None:
        self.settings = settings
        self.problem = build_problem(source, settings, user_contacts=user_contacts)
        self._bulk = BulkSolver(self.problem)

    def solve(self, bone_scale: Array) -> SolvedWindow:
        """Solve variants (variant, P, 22); the result of each does not depend on the others, to the last bit.

        Plain forward kinematics is kept if it is as good (everybody has the source's size) or if bulk fails: its result
        is not finite, or worse.
        """
        problem = self.problem
        targets = build_targets(problem, bone_scale)
        count = targets.num_variants
        terms = [fit_terms(problem, targets, variant) for variant in range(count)]
        energy_fk = np.array([total_energy(terms[index], targets.reference[index]) for index in range(count)])
        result = self._bulk.solve(targets)
        with np.errstate(invalid="ignore", over="ignore"):
            energy, squared_residual = self._measure(terms, targets, result.positions)
        positions, iterations = result.positions, result.num_iterations.tolist()
        is_bad = ~(energy <= energy_fk + _ROUNDING * problem.num_frames)
        solvers = ["plain_fk" if failed else "bulk" for failed in is_bad]
        is_worse = ~(energy <= energy_fk)
        positions[is_worse] = targets.reference[is_worse]
        if self.settings.solver == "polished":
            for index in range(count):
                descent = descend(targets, index, terms[index], positions[index], POLISH)
                solvers[index], positions[index] = "polished", descent.positions_m
                iterations[index] += descent.num_iterations
        if is_worse.any() or self.settings.solver == "polished":
            energy, squared_residual = self._measure(terms, targets, positions)
        return SolvedWindow(
            positions=positions,
            energy=energy,
            energy_fk=energy_fk,
            squared_residual=squared_residual,
            estimated_gap_m=result.estimated_gap_m,
            solvers=solvers,
            num_iterations=iterations,
        )

    def _measure(self, terms: list[list[Term]], targets: Targets, positions: Array) -> tuple[Array, Array]:
        """Return energies (variant,) and squared residuals (variant, T), one by one so that sums round equally."""
        energies, residuals = [], []
        for variant, points in enumerate(positions):
            single = targets.select([variant])
            energies.append(total_energy(terms[variant], points))
            missed = laplacian_residual(self.problem, single, points[None] - single.reference)[0]
            residuals.append((missed**2).sum(axis=-1).mean(axis=-1))
        return np.array(energies), np.array(residuals)
