"""One window of a take: variants solved in bulk, the bad ones again by guaranteed descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms, laplacian_residual, total_energy
from pasdedeux.augmentation.problem import Targets
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.windows import quintic
from pasdedeux.fitting import FitSettings, PointTerm, Term
from pasdedeux.interaction.contacts import UserContact

__all__ = ["FALLBACK", "POLISH", "SOLVERS", "SolvedWindow", "WindowSolver"]

Array = npt.NDArray[np.float64]

SOLVERS = ("bulk", "bulk+descent", "plain_fk")
"""Names of what may have given a variant; of several windows the last of these is told."""

_FALLBACK_RESIDUAL_M = 5e-4
"""A variant whose bones the bulk solver leaves further than this from their lengths (root mean square) goes to the
guaranteed solver, started from where bulk ended."""
FALLBACK = FitSettings(max_iterations=12, tolerance=5e-3)
POLISH = FitSettings(max_iterations=40, tolerance=1e-4)
"""Descent after bulk that comes to within a thousandth of the smallest energy; the fallback's own stops earlier."""
_SEAM_M = 0.01
"""Windows whose bulk solutions are further apart than this ended in different minima and are not blended."""
_SEAM_WEIGHT = 30.0
"""Pull of a descent towards what the window before gave, per square metre, joint and frame."""


@dataclass(frozen=True)
class SolvedWindow:
    """A batch of variants over one window.

    Args:
        positions: (variant, T, 44, 3), metres; always finite.
        energy: Energy (variant,).
        energy_fk: Energy of plain forward kinematics (variant,), which is never lower.
        squared_residual: Mean squared Laplacian residual of each frame (variant, T), square metres.
        solvers: One of `SOLVERS` for each variant.
        num_iterations: Iterations of each variant.
    """

    positions: Array
    energy: Array
    energy_fk: Array
    squared_residual: Array
    solvers: list[str]
    num_iterations: list[int]


class WindowSolver:
    """A window that is ready for any number of variants."""

    def __init__(self, source: Source, settings: AugmentationSettings, user_contacts: Sequence[UserContact]) -> None:
        self.settings = settings
        self.problem = build_problem(source, settings, user_contacts=user_contacts)
        self._bulk = BulkSolver(self.problem)

    def solve(self, bone_scale: Array, before: Array | None = None) -> SolvedWindow:
        """Solve variants (variant, 2, 22); what one gets does not depend on the others, to the last bit.

        Args:
            bone_scale: Scales (variant, 2, 22).
            before: What the window before gave for the frames it shares with this one (variant, n, 44, 3), metres.
                Where bulk comes to something else there, a variant is solved by descent and held to it.
        """
        problem, settings = self.problem, self.settings
        targets = build_targets(problem, bone_scale)
        count = targets.num_variants
        terms = [fit_terms(problem, targets, variant) for variant in range(count)]
        positions = np.array(targets.reference)
        energy_fk, squared_residual = self._measure(terms, targets, positions)
        energy = np.array(energy_fk)
        result = self._bulk.solve(targets)
        with np.errstate(invalid="ignore", over="ignore"):
            found_energy, found_residual = self._measure(terms, targets, result.positions)
        is_better = np.isfinite(found_energy) & (found_energy <= energy_fk)
        for mine, found in (
            (positions, result.positions),
            (energy, found_energy),
            (squared_residual, found_residual),
        ):
            mine[is_better] = found[is_better]
        is_done = is_better & (result.residual_m <= _FALLBACK_RESIDUAL_M) & (settings.solver != "polished")
        if before is not None:
            is_done &= _farthest(positions, before) <= _SEAM_M
        solvers = ["bulk" if good else "bulk+descent" for good in is_done]
        iterations = [settings.num_iterations] * count
        fit = POLISH if settings.solver == "polished" else FALLBACK
        for index in map(int, np.flatnonzero(~is_done)):
            start, held = positions[index], list[Term]()
            if before is not None:
                start, held = _tied(positions[index], before[index])
            descent = descend(targets, index, [*terms[index], *held], start, fit)
            if np.isfinite(descent.positions_m).all():
                positions[index] = descent.positions_m
                one = targets.select([index])
                energy[index : index + 1], squared_residual[index : index + 1] = self._measure(
                    terms[index : index + 1], one, descent.positions_m[None]
                )
                iterations[index] += descent.num_iterations
            elif energy[index] == energy_fk[index]:
                solvers[index] = "plain_fk"
        return SolvedWindow(
            positions=positions,
            energy=energy,
            energy_fk=energy_fk,
            squared_residual=squared_residual,
            solvers=solvers,
            num_iterations=iterations,
        )

    def _measure(self, terms: list[list[Term]], targets: Targets, positions: Array) -> tuple[Array, Array]:
        """Return energies (variant,) and squared residuals (variant, T), one by one so that sums round alike."""
        energies, residuals = [], []
        for variant, points in enumerate(positions):
            one = targets.select([variant])
            energies.append(total_energy(terms[variant], points))
            missed = laplacian_residual(self.problem, one, points[None] - one.reference)[0]
            residuals.append((missed**2).sum(axis=-1).mean(axis=-1))
        return np.array(energies), np.array(residuals)


def _farthest(positions: Array, before: Array) -> Array:
    """Return how far the middle third of the shared frames is apart at most (variant,), metres."""
    third = before.shape[1] // 3
    middle = slice(third, before.shape[1] - third)
    return np.asarray(np.linalg.norm(positions[:, middle] - before[:, middle], axis=-1).max(axis=(1, 2)))


def _tied(points: Array, before: Array) -> tuple[Array, list[Term]]:
    """Return a start that leaves what the window before gave over the last third of the shared frames, and its pull."""
    shared = len(before)
    t = np.clip((np.arange(shared) + 0.5) / shared * 3.0 - 2.0, 0.0, 1.0)
    hold = np.zeros((len(points), 1, 1))
    hold[:shared, 0, 0] = 1.0 - quintic(t)
    aims = np.array(points)
    aims[:shared] = before
    return points + hold * (aims - points), [PointTerm(aims, _SEAM_WEIGHT * hold)]
