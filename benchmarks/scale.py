"""Growth of cost with size: work per second at the largest and the smallest size, and the exponent over all sizes.

An exponent of 1 is cost in proportion to size, and a ratio of 1; an exponent of 0 is constant cost.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.benchmark import BenchmarkResult, Rate
from benchmarks.projections import made_up_database
from benchmarks.synthetic import random_annotations, random_bank, random_pairs
from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.choreography.duets import make_duet
from pasdedeux.interaction.coverage import coverage_curve
from pasdedeux.projections.search import build_index
from pasdedeux.sampling.densities.interaction import InteractionLikelihood

Work = Callable[[], object]

_NUM_QUERIES = 200
_BATCH = 32
"""Variants per batch, as in the stage."""


def grown(
    name: str, unit: str, sizes: Sequence[int], prepare: Callable[[int], Work], *, count: int = 0
) -> BenchmarkResult:
    """Measure work at several sizes, smallest first; that of the smallest is done once before, which may compile.

    Args:
        name: Name of the measurement.
        unit: What its size counts.
        sizes: Sizes, rising.
        prepare: Returns the work at a size.
        count: Pieces of work in a call where their number is not the size.
    """
    spent_s, peaks = [], []
    prepare(sizes[0])()
    for size in sizes:
        work = prepare(size)
        started = time.process_time()
        work()
        spent_s.append(max(time.process_time() - started, 1e-6))
        tracemalloc.start()
        work()
        peaks.append(tracemalloc.get_traced_memory()[1] / 1e6)
        tracemalloc.stop()
    return growth(name, unit, sizes, spent_s, {"memory": peaks}, count=count)


def growth(
    name: str,
    unit: str,
    sizes: Sequence[int],
    spent_s: Sequence[float],
    megabytes: Mapping[str, Sequence[float]],
    *,
    count: int = 0,
) -> BenchmarkResult:
    """Return the cost of the work at several sizes, and the exponents; arguments as for `grown`, megabytes by name.

    A megabyte is added to each before the exponent is fitted, so that small amounts beside the process do not grow.
    """
    shown = (
        f"{size:,}: {spent_s[at]:.2g} s"
        + "".join(f", {values[at]:.1f} MB {what}" for what, values in megabytes.items())
        for at, size in enumerate(sizes)
    )
    grew = {"time": list(spent_s)} | {what: [value + 1.0 for value in values] for what, values in megabytes.items()}
    exponents = (f"{what} {np.polyfit(np.log(sizes), np.log(values), 1)[0]:.2f}" for what, values in grew.items())
    return BenchmarkResult(
        name,
        unit,
        *Rate(f"{sizes[-1]:,}", (count or sizes[-1]) / spent_s[-1]),
        *Rate(f"{sizes[0]:,}", (count or sizes[0]) / spent_s[0]),
        f"{'; '.join(shown)}; exponents: {', '.join(exponents)}",
    )


def _index(num_projections: int) -> Work:
    database = made_up_database(num_projections // 30)
    return lambda: build_index(database)


def _query(num_projections: int) -> Work:
    index = build_index(made_up_database(num_projections // 30))
    poses = made_up_database(_NUM_QUERIES * 24, seed=1).poses_m[::24]
    queries = poses[..., :2] + np.random.default_rng(1).normal(0.0, 0.01, (_NUM_QUERIES, *poses.shape[1:-1], 2))
    return lambda: index.search(queries)


def _likelihood(num_annotations: int) -> Work:
    rng = np.random.default_rng(1)
    annotations = random_annotations(
        rng, random_pairs(rng, max(num_annotations // 2, 1), spread_rad=0.2), num_annotations
    )
    likelihood = InteractionLikelihood(
        annotations, random_bank(rng, annotations, 20, num_candidates=num_annotations // 16)
    )
    samples = random_pairs(np.random.default_rng(2), _NUM_QUERIES, spread_rad=0.2)
    return lambda: [likelihood.log_likelihood(pair) for pair in samples]


def _coverage(num_draws: int) -> Work:
    rng = np.random.default_rng(1)
    truth, draws = random_pairs(rng, 100, spread_rad=0.2), random_pairs(rng, num_draws, spread_rad=0.2)
    return lambda: coverage_curve(truth, draws, [num_draws])


def _variants(num_variants: int) -> Work:
    duet = make_duet("waltz", duration_s=2.0, rate_hz=30.0)
    problem = build_problem(Source(duet.positions_m(), 30.0, "waltz"))
    solver, scales = BulkSolver(problem), np.linspace(0.75, 1.25, num_variants).tolist()
    bodies = np.stack([variation.bone_scale for variation in uniform_variations(scales)])

    def solve() -> None:
        for start in range(0, num_variants, _BATCH):
            solver.solve(build_targets(problem, bodies[start : start + _BATCH]))

    return solve


def _benchmarks(*, is_full: bool) -> dict[str, Callable[[], BenchmarkResult]]:
    """Return the benchmarks of growth, up to sizes that take a minute, or many minutes in full."""
    projections = (100_000, 1_000_000, 10_000_000) if is_full else (20_000, 200_000, 2_000_000)
    annotations = (1_000, 32_000, 1_000_000) if is_full else (500, 4_000, 32_000)
    draws = (1_000, 10_000, 100_000) if is_full else (500, 2_000, 8_000)
    variants = (100, 1_000, 10_000) if is_full else (16, 64, 256)
    likelihoods = "likelihood among annotations", "evaluations", annotations, _likelihood
    return {
        "database": partial(grown, "index of a database", "projections", projections, _index),
        "query": partial(grown, "query of a database", "queries", projections, _query, count=_NUM_QUERIES),
        "annotations": partial(grown, *likelihoods, count=_NUM_QUERIES),
        "coverage": partial(grown, "coverage of 100 pairs", "draws", draws, _coverage),
        "variants": partial(grown, "variants of a take of 2 s", "variants", variants, _variants),
    }


BENCHMARKS = _benchmarks(is_full=False)
FULL_BENCHMARKS = _benchmarks(is_full=True)
