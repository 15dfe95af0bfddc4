"""Chains sample their target: known moments, detailed balance, and broken proposals that are caught.

Every comparison is gated on the effective sample size: the tolerance is a number of standard errors of that size.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import standing_pair
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import NUM_ANGLES
from pasdedeux.sampling.chain import (
    ChainState,
    LogDensity,
    Propose,
    Proposed,
    generator_from_json,
    generator_to_json,
    run_segment,
    step,
)
from pasdedeux.sampling.densities.density import Evaluation, PairDensity, PriorOnly
from pasdedeux.sampling.diagnostics import effective_sample_size, rhat
from pasdedeux.sampling.parameters import NUM_PER_PERSON, POSITION_INDICES, ROTATION_INDICES, PairChart
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings
from pasdedeux.sampling.proposals.blocks import GaussianBlocks, StepSizes
from pasdedeux.skeletons import PAIR17

MIN_ESS = 400.0
NUM_ERRORS = 4.5
"""Standard errors allowed: about one false alarm in 150,000 comparisons."""


def log_normal(x: np.ndarray, at_least: float) -> Evaluation:
    return Evaluation(float(-0.5 * (x**2).sum()))


def log_exponential(x: np.ndarray, at_least: float) -> Evaluation:
    """Skewed: rate 1 on the positive axis; mean 1, variance 1."""
    return Evaluation(float(-x.sum()) if (x >= 0).all() else -np.inf)


def log_truncated(x: np.ndarray, at_least: float) -> Evaluation:
    """Standard normal cut to [-0.5, 2]."""
    return Evaluation(float(-0.5 * (x**2).sum()) if (np.abs(x - 0.75) <= 1.25).all() else -np.inf)


def log_flat_top(x: np.ndarray, at_least: float) -> Evaluation:
    """Truncated above and below as eq. 11 does: min(N(x), ceiling) where N(x) is above the floor."""
    value = float(-0.5 * (x**2).sum())
    return Evaluation(min(value, -0.5) if value >= -2.0 else -np.inf)


def log_gamma(x: np.ndarray, at_least: float) -> Evaluation:
    """Gamma of shape 3 and rate 1: mean 3, variance 3."""
    return Evaluation(float((2 * np.log(x) - x).sum()) if (x > 0).all() else -np.inf)


def symmetric(scale: float) -> Propose:
    def propose(rng: np.random.Generator, state: ChainState) -> Proposed:
        x = state.parameters
        return Proposed(x + scale * rng.standard_normal(x.shape))

    return propose


def multiplicative(scale: float) -> Propose:
    """An asymmetric proposal: a step of log x; the ratio of the two densities is x' / x."""

    def propose(rng: np.random.Generator, state: ChainState) -> Proposed:
        x = state.parameters
        there = x * np.exp(scale * rng.standard_normal(x.shape))
        return Proposed(there, log_ratio=float(np.log(there).sum() - np.log(x).sum()))

    return propose


def sample(
    log_density: LogDensity,
    propose: Propose,
    start: np.ndarray,
    *,
    num_chains: int = 4,
    num_draws: int = 4000,
    num_first: int = 133,
    thin: int = 3,
    seed: int = 7,
) -> np.ndarray:
    """Return draws (chain, draw, parameter); the first ones are dropped."""
    chains = []
    for chain in range(num_chains):
        rng = np.random.default_rng([seed, chain])
        state = ChainState(start, log_density(start, -np.inf))
        state, _ = run_segment(rng, state, log_density, propose, num_draws=num_first, thin=thin)
        _, segment = run_segment(rng, state, log_density, propose, num_draws=num_draws, thin=thin)
        chains.append(segment.parameters)
    return np.stack(chains)


def worst_error(values: np.ndarray, moments: tuple[float, float]) -> float:
    """Return the largest error of the first two moments, in standard errors; there must be enough independent draws."""
    worst = 0.0
    for power, expected in zip((1, 2), moments, strict=True):
        powered = values**power
        ess = effective_sample_size(powered)[0]
        assert ess > MIN_ESS, f"only {ess:.0f} independent draws: the comparison would say nothing"
        worst = max(worst, abs(powered.mean() - expected) / (powered.std() / np.sqrt(ess)))
    return worst


def moments_by_quadrature(log_density: LogDensity, low: float, high: float) -> tuple[float, float]:
    x = np.linspace(low, high, 200_001)
    weight = np.array([np.exp(log_density(np.array([value]), -np.inf).log_density) for value in x])
    weight /= weight.sum()
    return float((weight * x).sum()), float((weight * x**2).sum())


@pytest.mark.parametrize(
    ("log_density", "propose", "start", "moments"),
    [
        (log_normal, symmetric(2.4), 0.0, (0.0, 1.0)),
        (log_exponential, symmetric(2.0), 1.0, (1.0, 2.0)),
        (log_gamma, symmetric(3.0), 3.0, (3.0, 12.0)),
        (log_gamma, multiplicative(1.0), 3.0, (3.0, 12.0)),
        (log_truncated, symmetric(1.0), 0.5, None),
        (log_flat_top, symmetric(1.5), 0.5, None),
    ],
    ids=["normal", "exponential", "gamma", "gamma_asymmetric_proposal", "truncated", "flat_top"],
)
def test_moments_of_analytic_targets(
    log_density: LogDensity, propose: Propose, start: float, moments: tuple[float, float] | None
) -> None:
    expected = moments or moments_by_quadrature(log_density, -3.0, 3.0)
    values = sample(log_density, propose, np.full(1, start))
    assert worst_error(values, expected) < NUM_ERRORS
    assert rhat(values)[0] < 1.02


def test_an_asymmetric_proposal_without_its_correction_is_caught() -> None:
    right = multiplicative(1.0)

    def broken(rng: np.random.Generator, state: ChainState) -> Proposed:
        return Proposed(right(rng, state).parameters)

    assert worst_error(sample(log_gamma, broken, np.full(1, 3.0)), (3.0, 12.0)) > 2 * NUM_ERRORS


def test_a_drifting_proposal_is_caught() -> None:
    def drifting(rng: np.random.Generator, state: ChainState) -> Proposed:
        x = state.parameters
        return Proposed(x + 0.3 + 2.4 * rng.standard_normal(x.shape))

    assert worst_error(sample(log_normal, drifting, np.zeros(1)), (0.0, 1.0)) > 2 * NUM_ERRORS


def test_flow_between_states_is_in_detailed_balance() -> None:
    """On a ring of 5 states the steps i -> j and j -> i must be equally frequent, though a state's mass is not."""
    weights = np.log([1.0, 2.0, 4.0, 3.0, 0.5])

    def log_density(x: np.ndarray, at_least: float) -> Evaluation:
        return Evaluation(float(weights[int(x[0])]))

    def propose(rng: np.random.Generator, state: ChainState) -> Proposed:
        x = state.parameters
        return Proposed((x + rng.choice([-1, 1])) % 5)

    rng = np.random.default_rng(3)
    state = ChainState(np.zeros(1), log_density(np.zeros(1), -np.inf))
    flow = np.zeros((5, 5))
    for _ in range(40_000):
        following, _ = step(rng, state, log_density, propose)
        flow[int(state.parameters[0]), int(following.parameters[0])] += 1
        state = following
    for i in range(5):
        j = (i + 1) % 5
        # Passages back and forth alternate, except for loops round the ring, so their difference is far below Poisson.
        assert abs(flow[i, j] - flow[j, i]) < NUM_ERRORS * np.sqrt(flow[i, j] + flow[j, i])
    np.testing.assert_allclose(flow.sum(axis=1) / flow.sum(), np.exp(weights) / np.exp(weights).sum(), atol=0.02)


def test_a_resumed_chain_is_the_uninterrupted_one_bit_for_bit() -> None:
    propose = symmetric(1.0)
    start = ChainState(np.zeros(3), log_normal(np.zeros(3), -np.inf))
    _, whole = run_segment(np.random.default_rng(5), start, log_normal, propose, num_draws=40, thin=3)
    rng = np.random.default_rng(5)
    state, first = run_segment(rng, start, log_normal, propose, num_draws=15, thin=3)
    resumed = generator_from_json(generator_to_json(rng))
    _, second = run_segment(resumed, state, log_normal, propose, num_draws=25, thin=3)
    np.testing.assert_array_equal(np.concatenate([first.parameters, second.parameters]), whole.parameters)
    np.testing.assert_array_equal(np.concatenate([first.log_density, second.log_density]), whole.log_density)


def test_pair_proposals_sample_a_known_target_and_turn_roots_evenly() -> None:
    """Positions under a Gaussian target, root rotations under none: the turns must be uniform on the rotations.

    The angle of a uniform rotation has density (1 - cos t) / pi, so its mean is pi / 2 + 2 / pi.
    """
    chart = PairChart(standing_pair())
    propose = GaussianBlocks(StepSizes(root_rotation_rad=1.5, root_position_m=0.2, max_blocks=34)).propose

    def log_density(parameters: np.ndarray, at_least: float) -> Evaluation:
        return Evaluation(float(-0.5 * (parameters[POSITION_INDICES] ** 2).sum() / 0.2**2))

    draws = sample(log_density, propose, chart.seed_parameters(), num_chains=3, num_draws=1500, num_first=50, thin=10)
    angle = np.linalg.norm(draws[..., ROTATION_INDICES[0]], axis=-1)
    position = draws[..., POSITION_INDICES[0, 0]]
    for values, expected in ((angle, np.pi / 2 + 2 / np.pi), (position, 0.0), (position**2, 0.04)):
        ess = effective_sample_size(values[..., None])[0]
        assert ess > 200
        assert abs(values.mean() - expected) < NUM_ERRORS * values.std() / np.sqrt(ess)


def test_a_flat_target_gives_uniform_directions_of_bones_and_a_ball_of_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cosines between bones and the seed's bones are uniform on -1..1, and cubes of the distance on 0..bound."""
    chart, bound_m = PairChart(standing_pair()), 1.5
    monkeypatch.setattr("pasdedeux.sampling.densities.density.MAX_APART_M", bound_m)
    anything = PriorSettings(alpha=0.0, sigma_p_m=1e6, max_invalid_angles=2 * NUM_ANGLES)
    prior = PhysicalPrior(chart, JointLimits.published(), anything)
    target = PairDensity(chart, prior, PriorOnly())
    propose = GaussianBlocks(StepSizes(root_position_m=0.6, joint_rotation_rad=1.2, max_blocks=4)).propose
    start = chart.seed_parameters()
    draws = sample(target, propose, start, num_chains=3, num_draws=500, num_first=40, thin=20, seed=13)
    turns = draws.reshape(*draws.shape[:-1], 2, NUM_PER_PERSON)[..., 6:].reshape(*draws.shape[:-1], 32, 3)
    apart = np.linalg.norm(np.diff(draws[..., POSITION_INDICES], axis=-2), axis=-1) / bound_m
    shares = np.concatenate([0.5 + 0.5 * np.cos(np.linalg.norm(turns[..., :2], axis=-1)), apart**3], axis=-1)
    for share in np.moveaxis(shares, -1, 0):
        for low in (0.0, 0.25, 0.5, 0.75):
            inside = ((share >= low) & (share < low + 0.25)).astype(float)
            ess = effective_sample_size(inside[..., None])[0]
            assert ess > 100
            assert abs(inside.mean() - 0.25) < NUM_ERRORS * np.sqrt(0.25 * 0.75 / ess)


def test_the_measure_is_the_area_that_two_rotations_of_a_bone_sweep() -> None:
    chart, step_rad = PairChart(standing_pair()), 1e-5
    at = NUM_PER_PERSON + 6 + 3 * 4
    joint = 5
    for turn in ([0.0, 0.0], [0.3, -0.2], [1.5, 1.0], [-2.2, 2.0]):
        parameters = chart.seed_parameters()
        parameters[at : at + 2] = turn
        sides = []
        for axis in (0, 1):
            moved = np.stack([parameters, parameters])
            moved[:, at + axis] += [-step_rad, step_rad]
            bones = chart.positions(moved)[:, 1]
            before, after = bones[:, joint] - bones[:, PAIR17.parents[joint]]
            sides.append((after - before) / (2 * step_rad * chart.lengths_m[1, joint]))
        area = np.linalg.norm(np.cross(*sides))
        assert np.exp(chart.log_measure(parameters)) == pytest.approx(area, rel=1e-6)
    parameters[at : at + 2] = [np.pi, 0.0]
    assert chart.log_measure(parameters) == -np.inf
