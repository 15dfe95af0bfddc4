"""Every registered proposal keeps detailed balance: it samples what it is told to.

Targets are known: positions of the roots skewed, truncated and normal, bones normal.  As in the tests of the chain
itself, comparisons are gated on the effective sample size.  A proposal that states a wrong ratio is caught.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic import standing_pair
from pasdedeux.sampling.chain import ChainState, Context, Correction, Propose, Proposed, run_segment
from pasdedeux.sampling.densities.density import Evaluation
from pasdedeux.sampling.diagnostics import effective_sample_size
from pasdedeux.sampling.parameters import POSITION_INDICES, ROTATION_INDICES, PairChart, gauge_fix
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.proposals.blocks import StepSizes
from pasdedeux.sampling.proposals.proposal import Proposal, ProposalInputs
from pasdedeux.sampling.speeds import Speeds
from pasdedeux.sampling.warm_up import TARGET_ACCEPTANCE, warm_up
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import block_indices

NUM_ERRORS = 4.5
MIN_ESS = 90.0
CHART = PairChart(gauge_fix(standing_pair()))
X, Y, Z = POSITION_INDICES[0]
KNEE = block_indices(PAIR17.index("left_knee"))[0]
SHOULDER = block_indices(17 + PAIR17.index("right_shoulder"))[1]
BONES = np.array([index for block in range(34) if block % 17 for index in block_indices(block)[:2]])


def log_target(parameters: np.ndarray, at_least: float) -> Evaluation:
    """x of root A is Gamma(3, 1) (skewed), y a standard normal cut to [-0.5, 2], z standard normal, root B wider.

    Bones are normal with deviation 0.5.
    """
    x, y, z = parameters[[X, Y, Z]]
    if x <= 0.0 or abs(y - 0.75) > 1.25:
        return Evaluation(-np.inf)
    value = 2.0 * np.log(x) - x - 0.5 * (y * y + z * z + (parameters[POSITION_INDICES[1]] ** 2).sum() / 9.0)
    return Evaluation(float(value - 0.5 * (parameters[BONES] ** 2).sum() / 0.25))


def moments_of_y() -> tuple[float, float]:
    y = np.linspace(-0.5, 2.0, 100_001)
    weight = np.exp(-0.5 * y * y)
    return float((weight * y).sum() / weight.sum()), float((weight * y * y).sum() / weight.sum())


KNOWN = {X: (3.0, 12.0), Y: moments_of_y(), Z: (0.0, 1.0)}
KNOWN_BONES = {KNEE: (0.0, 0.25), SHOULDER: (0.0, 0.25)}


KNEE_TO_NECK = np.linalg.norm(CHART.seed_m[0, PAIR17.index("left_knee")] - CHART.seed_m[0, PAIR17.index("neck")])


def speeds() -> Speeds:
    """Speeds that differ strongly between annotations."""
    turn, shift = np.zeros((8, 34)), np.zeros((8, 2))
    shift[1] = [3.0, 0.0]
    shift[4] = [0.3, 0.0]
    turn[2] = 0.1
    return Speeds(turn, shift)


def nearest(pair_m: np.ndarray) -> Context:
    """The nearest annotations depend strongly on where the chain is: on x and z of root A, and on a knee."""
    x, _, z = pair_m[0, PAIR17.root]
    knee = np.linalg.norm(pair_m[0, PAIR17.index("left_knee")] - pair_m[0, PAIR17.index("neck")])
    return np.array([int(x > 2.5), 4 if z > 0.3 else 6, 2 if knee > KNEE_TO_NECK else 7, -1])


def proposal(name: str, **steps: float) -> Proposal:
    """A registered proposal with large steps of many blocks, as far as it has such."""
    large = {"root_rotation_rad": 0.2, "root_position_m": 0.7, "joint_rotation_rad": 0.12, "max_blocks": 34}
    built = PROPOSALS[name].init(ProposalInputs(CHART, nearest, speeds()))
    return replace(built, steps=StepSizes(**{**large, **steps})) if hasattr(built, "steps") else built


def without_ratio(right: Proposal) -> Propose:
    """The velocity-biased proposal as one would write it who forgets that its densities differ."""

    def propose(rng: np.random.Generator, state: ChainState) -> Proposed:
        proposed = right.propose(rng, state)
        assert proposed.correct is not None
        there = proposed.correct().context
        return replace(proposed, log_ratio=0.0, correct=lambda: Correction(0.0, there))

    return propose


def started(proposal: Proposal) -> ChainState:
    start = CHART.seed_parameters()
    start[[X, Y, Z]] = [3.0, 0.5, 0.0]
    return ChainState(start, log_target(start, -np.inf), proposal.init(start))


def sample(propose: Propose, begun: ChainState, *, num_draws: int, thin: int, num_chains: int = 3) -> np.ndarray:
    chains = []
    for chain in range(num_chains):
        rng = np.random.default_rng([17, chain])
        state, _ = run_segment(rng, begun, log_target, propose, num_draws=20, thin=thin)
        _, segment = run_segment(rng, state, log_target, propose, num_draws=num_draws, thin=thin)
        chains.append(segment.parameters)
    return np.stack(chains)


def worst_error(draws: np.ndarray, known: dict[int, tuple[float, float]]) -> float:
    worst = 0.0
    for index, moments in known.items():
        for power, expected in zip((1, 2), moments, strict=True):
            values = draws[..., index] ** power
            ess = effective_sample_size(values[..., None])[0]
            assert ess > MIN_ESS, f"only {ess:.0f} independent draws of parameter {index}"
            worst = max(worst, abs(values.mean() - expected) / (values.std() / np.sqrt(ess)))
    return worst


@pytest.mark.parametrize("name", PROPOSALS)
def test_draws_have_the_moments_of_a_skewed_and_a_truncated_target(name: str) -> None:
    built = proposal(name)
    draws = sample(built.propose, started(built), num_draws=260, thin=90)
    assert worst_error(draws, {**KNOWN, **KNOWN_BONES}) < NUM_ERRORS


def test_steps_as_wide_as_annotations_move_keep_a_skewed_target_and_without_their_ratio_they_do_not() -> None:
    """Where speeds decide how wide steps are, the ratio decides where draws lie."""
    right = proposal("velocity", root_position_m=0.3, joint_rotation_rad=1e-3)
    errors = [
        worst_error(sample(propose, started(right), num_draws=num_draws, thin=25), KNOWN)
        for propose, num_draws in ((right.propose, 220), (without_ratio(right), 150))
    ]
    assert errors[0] < NUM_ERRORS
    assert errors[1] > 2 * NUM_ERRORS


@pytest.mark.parametrize("learned", [1.0, 2.0])
def test_the_ratio_of_a_step_is_that_of_its_density_back_and_forth(learned: float) -> None:
    """Of a root, whose shift is plain to see: a normal density of the deviations, scaled as warm-up learns it."""
    built = proposal("velocity", max_blocks=1)
    rng = np.random.default_rng(3)
    start, ratios = CHART.seed_parameters(), []
    here, log_scales = built.init(start), np.full(34, np.log(learned))
    while len(ratios) < 30:
        proposed = built.propose(rng, ChainState(start, log_target(start, -np.inf), here, log_scales))
        if proposed.blocks is None or proposed.blocks.tolist() != [0] or proposed.correct is None:
            continue
        correction = proposed.correct()
        turned = np.linalg.norm(proposed.parameters[ROTATION_INDICES[0]])
        shifted = np.linalg.norm(proposed.parameters[POSITION_INDICES[0]] - start[POSITION_INDICES[0]])
        logs = []
        for context in (correction.context, here):
            turn, shift = (values[0] for values in speeds().mean(context))
            for length, least, speed in ((turned, 0.2, turn), (shifted, 0.7, shift)):
                deviation = learned * np.hypot(least, np.sqrt(speed))
                logs.append(-3.0 * np.log(deviation) - 0.5 * (length / deviation) ** 2)
        ratios.append(logs[0] + logs[1] - logs[2] - logs[3])
        assert correction.log_ratio == pytest.approx(ratios[-1], abs=1e-9)
        assert proposed.log_ratio >= correction.log_ratio
    assert np.ptp(ratios) > 0.5


@pytest.mark.parametrize("name", PROPOSALS)
def test_giving_up_early_changes_nothing(name: str) -> None:
    """A bound on the ratio only saves work: a target that never stops early gives the same draws."""
    built = proposal(name)

    def impatient(parameters: np.ndarray, at_least: float) -> Evaluation:
        evaluation = log_target(parameters, at_least)
        return evaluation if evaluation.log_density >= at_least else Evaluation(-np.inf)

    runs = [
        run_segment(np.random.default_rng(3), started(built), target, built.propose, num_draws=60, thin=5)[1]
        for target in (log_target, impatient)
    ]
    np.testing.assert_array_equal(runs[0].parameters, runs[1].parameters)
    assert 0 < runs[0].num_accepted.sum() < 300


def test_warm_up_finds_scales_with_the_acceptance_aimed_at() -> None:
    built = proposal("velocity", joint_rotation_rad=3.0, root_position_m=12.0)
    begun = started(built)
    learned = warm_up(np.random.default_rng(5), begun, log_target, built.propose, num_steps=4000)
    before, after = (
        run_segment(np.random.default_rng(6), state, log_target, built.propose, num_draws=200, thin=5)[1]
        for state in (replace(learned, log_scales=begun.log_scales), learned)
    )
    assert before.num_accepted.sum() / 1000 < 0.1
    assert after.num_accepted.sum() / 1000 == pytest.approx(TARGET_ACCEPTANCE, abs=0.08)
