"""What the sampling room measures: `pasdedeux bench chains` shows these beside their plain baselines."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from pasdedeux.benchmark import BenchmarkResult, measure_rate
from pasdedeux.cameras.view_density import ViewDensity
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.kernels import edge_table
from pasdedeux.interaction.triangulation import delaunay_edges_fast
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.chain import ChainState, run_segment
from pasdedeux.sampling.coverage import Coverage, plain_coverage
from pasdedeux.sampling.density import PairDensity
from pasdedeux.sampling.likelihood import (
    AnnotatedPairs,
    InteractionLikelihood,
    ViewBank,
    build_bank,
    plain_log_likelihood,
)
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.sampling.proposals import GaussianBlocks
from pasdedeux.sampling.synthetic import random_annotations, random_pairs

__all__ = ["BENCHMARKS"]

NUM_ANNOTATIONS, NUM_VIEWS, NUM_CANDIDATES = 8000, 20, 500
_SIZE = f"34 joints, {NUM_ANNOTATIONS} annotations, {NUM_VIEWS} views, {NUM_CANDIDATES} candidates a view"


def _problem() -> tuple[np.ndarray, AnnotatedPairs, ViewBank]:
    rng = np.random.default_rng(1)
    pairs = random_pairs(rng, 4000, spread_rad=0.2)
    annotations = random_annotations(rng, pairs, NUM_ANNOTATIONS)
    views = ViewDensity(annotations.directions, np.ones(NUM_ANNOTATIONS), 0.5).sample(rng, NUM_VIEWS)
    return pairs, annotations, build_bank(views, annotations, num_candidates=NUM_CANDIDATES)


def _likelihood() -> BenchmarkResult:
    """Likelihood evaluations, none cut short by the prior or by a level to reach."""
    _, annotations, bank = _problem()
    fast = InteractionLikelihood(annotations, bank)
    table = edge_table(annotations.points_m.reshape(NUM_ANNOTATIONS, -1, 2))
    samples = random_pairs(np.random.default_rng(2), 200, spread_rad=0.2)
    exact = InteractionLikelihood(annotations, bank, is_exact=True)
    same = [abs(fast.log_likelihood(pair) - exact.log_likelihood(pair)) < 1e-6 for pair in samples]
    turns, slow_turns = itertools.cycle(samples), itertools.cycle(samples)
    return BenchmarkResult(
        name="likelihood",
        unit="evaluations",
        fast_name="ranked kernel",
        fast_per_s=measure_rate(lambda: [fast.log_likelihood(next(turns)) for _ in range(50)], count=50),
        plain_name="numpy, vectorised over candidates",
        plain_per_s=measure_rate(lambda: plain_log_likelihood(next(slow_turns), annotations, bank, table=table)),
        note=f"{_SIZE}; exact best found in {np.mean(same):.1%} of {len(same)}",
    )


def _chain() -> BenchmarkResult:
    """Steps of a chain of the full density; the plain form has no early end and no compiled likelihood."""
    pairs, annotations, bank = _problem()
    chart = PairChart(gauge_fix(pairs[0]))
    prior = PhysicalPrior(chart, JointLimits.published(), most_invalid=29)
    target = PairDensity(chart, prior, InteractionLikelihood(annotations, bank))
    table = edge_table(annotations.points_m.reshape(NUM_ANNOTATIONS, -1, 2))
    propose, rng = GaussianBlocks(), np.random.default_rng(3)
    state = ChainState(chart.seed_parameters(), target.seed_evaluation)

    def plain_step() -> None:
        parameters = propose(state.parameters, None, rng).parameters
        pair = chart.positions(parameters)
        prior.terms(parameters, pair)
        plain_log_likelihood(pair, annotations, bank, table=table)

    return BenchmarkResult(
        name="chain",
        unit="steps",
        fast_name="ranked kernel, level drawn first",
        fast_per_s=measure_rate(
            lambda: run_segment(rng, state, target, propose, num_draws=10, thin=10, settle=chart.gauge_fixed),
            count=100,
        ),
        plain_name="numpy",
        plain_per_s=measure_rate(plain_step),
        note=_SIZE,
    )


def _triangulation() -> BenchmarkResult:
    """Planar Delaunay triangulations of 34 joints."""
    points = random_pairs(np.random.default_rng(4), 200)[..., :2].reshape(200, 34, 2)
    return BenchmarkResult(
        name="triangulation",
        unit="triangulations",
        fast_name="numba, incremental",
        fast_per_s=measure_rate(lambda: delaunay_edges_fast(points), count=len(points)),
        plain_name="scipy (Qhull)",
        plain_per_s=measure_rate(lambda: [delaunay_edges(one) for one in points], count=len(points)),
        note="34 points",
    )


def _coverage() -> BenchmarkResult:
    """Pairs of a real pair and a draw compared in D_I and D_C."""
    truth = random_pairs(np.random.default_rng(5), 200)
    draws = random_pairs(np.random.default_rng(6), 100)
    return BenchmarkResult(
        name="coverage",
        unit="comparisons",
        fast_name="numba, both measures at once",
        fast_per_s=measure_rate(lambda: Coverage(truth).add(draws), count=len(truth) * len(draws)),
        plain_name="numpy",
        plain_per_s=measure_rate(lambda: plain_coverage(truth[:4], draws[:4]), count=16),
        note="200 real pairs, 100 draws, tetrahedra of the draws and of the real pairs included",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "likelihood": _likelihood,
    "chain": _chain,
    "triangulation": _triangulation,
    "coverage": _coverage,
}
