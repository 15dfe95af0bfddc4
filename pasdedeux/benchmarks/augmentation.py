"""The bulk solver of augmentation beside guaranteed descent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.problem import Problem, Targets
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.benchmarks.benchmark import BenchmarkResult, rate
from pasdedeux.fitting import FitSettings
from pasdedeux.kinematics import place_bones
from pasdedeux.skeletons import BODY22

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
    return BenchmarkResult(
        "augmentation: batch of variants",
        "frames of a variant",
        *rate(
            f"ADMM, {_VARIANTS} variants at once",
            lambda: solver.solve(build_targets(problem, scales)),
            count=_FRAMES * _VARIANTS,
        ),
        *rate("guaranteed descent, one at a time", lambda: _descend(problem, one), count=_FRAMES, repeats=1),
        f"{_FRAMES} frames of 2 x {BODY22.num_joints} joints, scales 0.75 to 1.25",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"bulk": bulk_solver}
"""Benchmarks of this room by name."""
