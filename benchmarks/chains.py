"""Benchmarks of chains, compared with plain baselines: `pasdedeux bench chains`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from benchmarks.benchmark import BenchmarkResult, in_turn, measure_rate
from benchmarks.synthetic import (
    random_annotations,
    random_bank,
    random_pairs,
    random_parameters,
    standing_pair,
)
from pasdedeux.arrays import Array
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity, interaction_dissimilarity
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.nearest import Coverage, pair_table
from pasdedeux.interaction.triangulation import delaunay_edges_fast
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import NUM_ANGLES
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs, ViewBank
from pasdedeux.sampling.chain import ChainState, run_segment
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import Likelihood, PairDensity, TargetSettings
from pasdedeux.sampling.densities.interaction import INTERACTION, InteractionLikelihood
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.sampling.proposals.blocks import GaussianBlocks

NUM_ANNOTATIONS, NUM_VIEWS, NUM_CANDIDATES = 8000, 20, 500
NUM_SAMPLES = 200
_SIZE = f"34 joints, {NUM_ANNOTATIONS} annotations, {NUM_VIEWS} views, {NUM_CANDIDATES} candidates a view"


@cache
def _problem() -> tuple[np.ndarray, AnnotatedPairs, ViewBank]:
    rng = np.random.default_rng(1)
    pairs = random_pairs(rng, 4000, spread_rad=0.2)
    annotations = random_annotations(rng, pairs, NUM_ANNOTATIONS)
    return pairs, annotations, random_bank(rng, annotations, NUM_VIEWS, num_candidates=NUM_CANDIDATES)


def default_target(seed_m: np.ndarray, *, max_invalid_angles: int) -> tuple[PairDensity, PhysicalPrior, Likelihood]:
    """Return what a study samples round a pair where it sets nothing, but for the limit of angles; made-up annotations.

    Joints of made-up pairs turn as they like.
    """
    _, annotations, _ = _problem()
    count = len(annotations.directions)
    gathered = GatheredPairs(annotations, np.ones(count), 0, np.ones((count, 2)))
    settings = TargetSettings(max_invalid_angles=max_invalid_angles)
    chart = PairChart(seed_m)
    prior = PhysicalPrior(chart, JointLimits.published(), settings)
    likelihood = INTERACTION.init(AnnotationSettings(), np.random.default_rng(1), gathered)
    return PairDensity(chart, prior, likelihood, settings), prior, likelihood


def _samples() -> np.ndarray:
    return random_pairs(np.random.default_rng(2), NUM_SAMPLES, spread_rad=0.2)


def _likelihood() -> BenchmarkResult:
    """Measure the published likelihood, without prior and without early termination."""
    likelihood = InteractionLikelihood(*_problem()[1:])
    same = [abs(likelihood.log_likelihood(pair) - likelihood.plain(pair)) < 1e-6 for pair in _samples()[:50]]
    return BenchmarkResult(
        "likelihood",
        "evaluations",
        *measure_rate("only who has a chance", in_turn(likelihood.log_likelihood, _samples(), count=50), count=50),
        *measure_rate("all candidates", in_turn(likelihood.plain, _samples())),
        f"{_SIZE}; exact best found in {np.mean(same):.1%} of {len(same)}",
    )


def _plain_density(target: PairDensity, prior: PhysicalPrior, likelihood: Likelihood, parameters: Array) -> None:
    pair = target.chart.positions(parameters)
    prior.terms(parameters, pair)
    likelihood.plain(pair)


def _density() -> BenchmarkResult:
    """Measure the default density of studies: prior and likelihood, without early termination."""
    parts = default_target(standing_pair(), max_invalid_angles=2 * NUM_ANGLES)
    parameters = random_parameters(np.random.default_rng(2), NUM_SAMPLES, spread_rad=0.2)
    return BenchmarkResult(
        "density, prior included",
        "evaluations",
        *measure_rate("compiled", in_turn(parts[0], parameters, count=50), count=50),
        *measure_rate("numpy, prior compiled", in_turn(partial(_plain_density, *parts), parameters)),
        f"{_SIZE}; no floor and no limit of invalid angles ends one early",
    )


def _chain() -> BenchmarkResult:
    """Measure steps of a chain on the default density of studies; the plain form has no early termination."""
    parts = default_target(gauge_fix(_problem()[0][0]), max_invalid_angles=NUM_ANGLES)
    target, chart = parts[0], parts[0].chart
    propose, rng = GaussianBlocks().propose, np.random.default_rng(3)
    state = ChainState(chart.seed_parameters(), target.seed_evaluation)
    return BenchmarkResult(
        "chain",
        "steps",
        *measure_rate(
            "compiled, level drawn first",
            lambda: run_segment(rng, state, target, propose, num_draws=10, thin=10, gauge=chart.gauge_fixed),
            count=100,
        ),
        *measure_rate("numpy", lambda: _plain_density(*parts, propose(rng, state).parameters)),
        _SIZE,
    )


def _triangulation() -> BenchmarkResult:
    """Measure planar Delaunay triangulations of 34 joints."""
    points = random_pairs(np.random.default_rng(4), 200)[..., :2].reshape(200, 34, 2)
    return BenchmarkResult(
        "triangulation",
        "triangulations",
        *measure_rate("numba, incremental", lambda: delaunay_edges_fast(points), count=len(points)),
        *measure_rate("scipy (Qhull)", lambda: [delaunay_edges(cloud) for cloud in points], count=len(points)),
        "34 points",
    )


def _coverage() -> BenchmarkResult:
    """Measure comparisons of real pairs and draws in D_I and D_C."""
    real = random_pairs(np.random.default_rng(5), 200)
    draws = random_pairs(np.random.default_rng(6), 100)
    return BenchmarkResult(
        "coverage",
        "comparisons",
        *measure_rate(
            "numba, both measures at once", lambda: Coverage(real).add(pair_table(draws)), count=len(real) * len(draws)
        ),
        *measure_rate("numpy", lambda: plain_coverage(real[:4], draws[:4]), count=16),
        "200 real pairs, 100 draws, tetrahedra of the draws and of the real pairs included",
    )


def plain_coverage(real_m: np.ndarray, draws_m: np.ndarray) -> tuple[float, float]:
    """Return C(G, S) in D_I and in D_C, metres, straight from the definition: the oracle of `Coverage`."""
    real, draws = _centred(real_m), _centred(draws_m)
    interaction = [min(interaction_dissimilarity(draw, pair) for draw in draws) for pair in real]
    cartesian = cartesian_dissimilarity(draws[None], real[:, None]).min(axis=1)
    return float(np.mean(interaction)), float(cartesian.mean())


def _centred(pairs_m: np.ndarray) -> np.ndarray:
    points = np.asarray(pairs_m, dtype=np.float64)
    points = points.reshape(len(points), -1, 3)
    return np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "likelihood": _likelihood,
    "density": _density,
    "chain": _chain,
    "triangulation": _triangulation,
    "coverage": _coverage,
}
