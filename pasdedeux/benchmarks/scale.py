"""How cost grows with size: work per second at the largest size beside the smallest, and the exponent between all.

An exponent of 1 is cost in proportion to size, and a ratio of 1; of 0, cost that does not grow.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from pasdedeux.augmentation.bulk import BulkSolver
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.benchmarks.benchmark import BenchmarkResult, Rate
from pasdedeux.benchmarks.projections import made_up_database
from pasdedeux.benchmarks.synthetic import random_annotations, random_bank, random_pairs
from pasdedeux.choreography.duets import make_duet
from pasdedeux.interaction.coverage import coverage_curve
from pasdedeux.projections.search import build_index
from pasdedeux.sampling.densities.interaction import InteractionLikelihood

Work = Callable[[], object]

_NUM_QUERIES = 200


def grown(
    name: str, unit: str, sizes: Sequence[int], prepare: Callable[[int], Work], *, count: int = 0
) -> BenchmarkResult:
    """Measure work at several sizes, smallest first; that of the smallest is done once before, which may compile.

    Args:
        name: What was measured.
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
    exponents = [np.polyfit(np.log(sizes), np.log(values), 1)[0] for values in (spent_s, peaks)]
    shown = ", ".join(
        f"{size:,}: {seconds:.2g} s and {peak:.0f} MB"
        for size, seconds, peak in zip(sizes, spent_s, peaks, strict=True)
    )
    return BenchmarkResult(
        name,
        unit,
        *Rate(f"{sizes[-1]:,}", (count or sizes[-1]) / spent_s[-1]),
        *Rate(f"{sizes[0]:,}", (count or sizes[0]) / spent_s[0]),
        f"{shown}; exponents: time {exponents[0]:.2f}, memory {exponents[1]:.2f}",
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
    targets = build_targets(problem, np.stack([one.bone_scale for one in uniform_variations(scales)]))
    return lambda: solver.solve(targets)


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "database": partial(grown, "index of a database", "projections", (20_000, 200_000, 2_000_000), _index),
    "query": partial(grown, "query of a database", "queries", (20_000, 200_000, 2_000_000), _query, count=_NUM_QUERIES),
    "annotations": partial(
        grown, "likelihood among annotations", "evaluations", (500, 4_000, 32_000), _likelihood, count=_NUM_QUERIES
    ),
    "coverage": partial(grown, "coverage of 100 pairs", "draws", (500, 2_000, 8_000), _coverage),
    "variants": partial(grown, "variants of a take of 2 s", "variants", (16, 64, 256), _variants),
}
