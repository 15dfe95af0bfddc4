"""The bulk solver of augmentation, compared with guaranteed descent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.benchmark import BenchmarkResult, measure_rate
from pasdedeux.arrays import Array
from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.augmentation.window_solver import POLISH
from pasdedeux.choreography.duets import make_duet
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.skeletons import BODY22

_FRAMES = 120
_VARIANTS = 64
_RATE_HZ = 30.0
_COMPARED = (0, 31, 63)
"""Variants of the batch that descent continues, to measure their distance from the optimum."""


def _scales(count: int) -> Array:
    scales = np.linspace(0.75, 1.25, count).tolist()
    return np.stack([variation.bone_scale for variation in uniform_variations(scales)])


def _bulk() -> BenchmarkResult:
    """Measure frames and variants per second of the bulk solver, without mesh and factor, and of descent."""
    duet = make_duet("waltz", duration_s=_FRAMES / _RATE_HZ, rate_hz=_RATE_HZ)
    problem = build_problem(Source(duet.positions_m(), _RATE_HZ, "waltz"))
    solver = BulkSolver(problem)
    scales, targets_of_two = _scales(_VARIANTS), build_targets(problem, _scales(2))
    settings = FitSettings(max_iterations=12, tolerance=1e-3)
    targets = build_targets(problem, scales)
    solved = solver.solve(targets).positions
    ends = [descend(targets, at, fit_terms(problem, targets, at), solved[at], POLISH).positions_m for at in _COMPARED]
    off_mm = 1e3 * np.linalg.norm(np.stack(ends) - solved[list(_COMPARED)], axis=-1)
    return BenchmarkResult(
        "augmentation: batch of variants",
        "frames of a variant",
        *measure_rate(
            f"ADMM, {_VARIANTS} variants at once",
            lambda: solver.solve(build_targets(problem, scales)),
            count=_FRAMES * _VARIANTS,
        ),
        *measure_rate(
            "guaranteed descent, one at a time",
            lambda: descend(targets_of_two, 0, fit_terms(problem, targets_of_two, 0), settings=settings),
            count=_FRAMES,
            repeats=1,
        ),
        f"{_FRAMES} frames of 2 x {BODY22.num_joints} joints, scales 0.75 to 1.25; {len(_COMPARED)} variants are "
        f"{off_mm.mean():.2f} mm from where descent from there ends, 95 % within {np.quantile(off_mm, 0.95):.2f} mm",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"bulk": _bulk}
