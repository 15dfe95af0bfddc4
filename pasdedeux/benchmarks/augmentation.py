"""Benchmarks of augmentation: bulk solver beside guaranteed descent, shared factor beside LAPACK's banded solve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_solve_banded, cholesky_banded

from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.factor import factorise, solve
from pasdedeux.augmentation.mesh import build_mesh
from pasdedeux.augmentation.problem import Problem, Targets
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.augmentation.window_solver import POLISH
from pasdedeux.benchmarks.benchmark import BenchmarkResult, measure_rate
from pasdedeux.fitting import FitSettings
from pasdedeux.kinematics import place_bones
from pasdedeux.skeletons import BODY22

__all__ = ["BENCHMARKS", "benchmark_source"]

Array = npt.NDArray[np.float64]

_FRAMES = 120
_VARIANTS = 64
_RATE_HZ = 30.0


def benchmark_source(num_frames: int = _FRAMES) -> Source:
    """Return two invented people, half a metre apart, whose bones all swing; a benchmark needs no beauty."""
    generator = np.random.default_rng(0)
    time_s = np.arange(num_frames) / _RATE_HZ
    people = []
    for person in (0, 1):
        directions = generator.normal(size=(BODY22.num_joints, 3)) + np.array([0.0, 1.0, 0.0])
        legs = [i for i, name in enumerate(BODY22.joint_names) if name.split("_")[-1] in ("knee", "ankle")]
        directions[legs] = np.array([0.0, -1.0, 0.0])
        swing = generator.normal(0.0, 0.3, (BODY22.num_joints, 3))
        moved = directions + np.sin(2.0 * np.pi * time_s[:, None, None] / 3.0) * swing
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        lengths = generator.uniform(0.1, 0.35, BODY22.num_joints)
        root = np.repeat(np.array([[0.5 * person, 0.9, 0.0]]), num_frames, axis=0)
        people.append(place_bones(BODY22, root, moved, lengths))
    return Source(np.stack(people, axis=1), _RATE_HZ, "benchmark")


def _scales(count: int) -> Array:
    scales = np.linspace(0.75, 1.25, count).tolist()
    return np.stack([variation.bone_scale for variation in uniform_variations(scales)])


def _descend(problem: Problem, targets: Targets) -> None:
    settings = FitSettings(max_iterations=12, tolerance=1e-3)
    descend(targets, 0, fit_terms(problem, targets, 0), settings=settings)


def bulk_solver() -> BenchmarkResult:
    """Frames and variants a second of a batch in the bulk solver, without mesh and factor, beside descent."""
    problem = build_problem(benchmark_source())
    solver = BulkSolver(problem)
    scales, few = _scales(_VARIANTS), _scales(2)
    one = build_targets(problem, few)
    fast = measure_rate(lambda: solver.solve(build_targets(problem, scales)), count=_FRAMES * _VARIANTS)
    plain = measure_rate(lambda: _descend(problem, one), count=_FRAMES, repeats=1)
    return BenchmarkResult(
        name="augmentation: batch of variants",
        unit="frames of a variant",
        fast_name=f"ADMM, {_VARIANTS} variants at once",
        fast_per_s=fast,
        plain_name="guaranteed descent, one at a time",
        plain_per_s=plain,
        note=f"{_FRAMES} frames of 2 x {BODY22.num_joints} joints, scales 0.75 to 1.25",
    )


def single_clip() -> BenchmarkResult:
    """Frames a second of one variant of a clip from the mesh on, factor included, beside descent."""
    source = benchmark_source()
    mesh = build_mesh(source)
    scales = _scales(1)

    def bulk() -> None:
        problem = build_problem(source, mesh=mesh)
        BulkSolver(problem).solve(build_targets(problem, scales))

    def descent() -> None:
        problem = build_problem(source, mesh=mesh)
        _descend(problem, build_targets(problem, scales))

    return BenchmarkResult(
        name="augmentation: one variant of one clip",
        unit="frames",
        fast_name="ADMM, factor included",
        fast_per_s=measure_rate(bulk, count=_FRAMES),
        plain_name="guaranteed descent",
        plain_per_s=measure_rate(descent, count=_FRAMES, repeats=1),
        note=f"{_FRAMES} frames after the mesh",
    )


def guaranteed() -> BenchmarkResult:
    """Frames a second of one variant by descent from where bulk ends, bulk included, beside descent from plain FK."""
    problem = build_problem(benchmark_source())
    solver, targets = BulkSolver(problem), build_targets(problem, _scales(1))

    def solve(start: Array | None) -> None:
        descend(targets, 0, fit_terms(problem, targets, 0), start, POLISH)

    return BenchmarkResult(
        name="augmentation: guaranteed solve of one variant",
        unit="frames",
        fast_name="descent from bulk's end",
        fast_per_s=measure_rate(lambda: solve(solver.solve(targets).positions[0]), count=_FRAMES),
        plain_name="descent from plain FK",
        plain_per_s=measure_rate(lambda: solve(None), count=_FRAMES),
        note=f"{_FRAMES} frames, energy falls at every step, until it falls by less than {POLISH.tolerance:g}",
    )


def shared_factor() -> BenchmarkResult:
    """Right-hand sides a second of the block factor beside LAPACK's banded Cholesky."""
    problem = build_problem(benchmark_source())
    factor = factorise(problem.matrix[0], problem.lag1[0], problem.lag2[0]).astype(np.float64)
    n = problem.source.num_points
    rhs = np.random.default_rng(1).normal(size=(factor.num_blocks, 2 * n, 1, _VARIANTS))
    banded = cholesky_banded(banded_matrix(problem), lower=True)
    flat = rhs.reshape(-1, _VARIANTS)[: _FRAMES * n]
    return BenchmarkResult(
        name="augmentation: solves with the shared factor",
        unit="right-hand sides",
        fast_name="block form",
        fast_per_s=measure_rate(lambda: solve(factor, rhs.copy(), np.array([0])), count=_VARIANTS),
        plain_name="LAPACK banded",
        plain_per_s=measure_rate(lambda: cho_solve_banded((banded, True), flat), count=_VARIANTS),
        note=f"{_FRAMES} frames of {n} unknowns, {_VARIANTS} right-hand sides, 64 bits",
    )


def banded_matrix(problem: Problem) -> Array:
    """Return the horizontal matrix in LAPACK's lower banded form (2 n + 1, T n)."""
    frames, n = problem.num_frames, problem.source.num_points
    banded = np.zeros((2 * n + 1, frames * n))
    for shift in range(n):
        rows = np.arange(n - shift)
        values = problem.matrix[0][:, rows + shift, rows]
        banded[shift].reshape(frames, n)[:, : n - shift] = values
    banded[n].reshape(frames, n)[:-1] += problem.lag1[0]
    banded[2 * n].reshape(frames, n)[:-2] += problem.lag2[0]
    return banded


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "bulk": bulk_solver,
    "single_clip": single_clip,
    "guaranteed": guaranteed,
    "factor": shared_factor,
}
"""Benchmarks of this room by name."""
