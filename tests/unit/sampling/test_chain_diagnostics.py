"""Diagnostics of chains: effective sample size, R-hat and verdicts."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs, standing_pair
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.densities.density import PairDensity, PriorOnly
from pasdedeux.sampling.diagnostics import MAX_AT_CEILING, diagnose, effective_sample_size, invariants, rhat
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.skeletons import PAIR17
from pasdedeux.verdict import Level
from tasks.chains.run import AnnotationEvidence

SEED = standing_pair()


def report(log_density: np.ndarray, *, num_accepted: int = 1) -> object:
    pairs = random_pairs(np.random.default_rng(1), len(log_density))
    accepted = np.full((1, len(log_density)), num_accepted)
    (found,) = diagnose(pairs[None], log_density[None], accepted, thin=4, log_ceiling=5.0)
    return found


@pytest.mark.parametrize("kept", [0.0, 0.5, -0.4], ids=lambda kept: f"correlation_{kept}")
def test_draws_that_follow_each_other_count_as_fewer_and_those_that_alternate_as_more(kept: float) -> None:
    values = np.random.default_rng(3).normal(size=(4, 5000, 2))
    for draw in range(1, values.shape[1]):
        values[:, draw] = kept * values[:, draw - 1] + np.sqrt(1.0 - kept**2) * values[:, draw]
    np.testing.assert_allclose(effective_sample_size(values), 20000 * (1.0 - kept) / (1.0 + kept), rtol=0.1)
    np.testing.assert_allclose(rhat(values), 1.0, atol=5e-3)
    np.testing.assert_allclose(rhat(values[:1]), 1.0, atol=2e-2)


def test_rhat_and_ess_find_chains_that_are_apart_and_are_nan_for_constant_or_short_ones() -> None:
    values = np.random.default_rng(4).normal(size=(2, 200, 3))
    values[1, :, 0] += 3.0
    values[..., 2] = 7.0
    apart, together, still = rhat(values)
    assert apart > 1.5
    assert together < 1.05
    assert np.isnan(still)
    sizes = effective_sample_size(values)
    assert sizes[0] < 10.0
    assert np.isnan(sizes[2])
    assert np.isnan(effective_sample_size(values[:, :3])).all()
    assert np.isnan(rhat(values[:1, :7])).all()


def test_each_figure_of_a_chain_is_that_of_its_own_draws_in_its_unit() -> None:
    """Each draw is larger than the one before by 1 % or 2 % of the first, about the middle: nothing turns."""
    first = standing_pair() - standing_pair().mean(axis=(0, 1))
    size_m = np.linalg.norm(first, axis=-1).mean()
    pairs = np.stack([[(1.0 + rate * draw) * first for draw in range(8)] for rate in (0.01, 0.02)])
    log_density = np.array([[0.0, 1, 2, 3, 4, 5, 6, 7], [-8.0] * 8])
    accepted = np.array([[1, 2, 3, 4, 4, 3, 2, 1], [1, 0, 0, 0, 0, 0, 0, 1]])
    found = diagnose(pairs, log_density, accepted, thin=4, log_ceiling=6.0, log_seed=-1.5, sigma_l=0.02)
    names = ("travelled_m", "acceptance_rate", "log_density_mean", "ceiling_share")
    figures = [[getattr(chain, name) for name in names] for chain in found]
    np.testing.assert_allclose(figures, [(0.07 * size_m, 20 / 32, 3.5, 0.25), (0.14 * size_m, 2 / 32, -8.0, 0.0)])
    assert {(chain.num_draws, chain.log_density_first, chain.sigma_l) for chain in found} == {(8, -1.5, 0.02)}


def test_a_chain_that_is_often_in_the_flat_top_is_warned_of() -> None:
    many = report(np.where(np.arange(200) < 200 * MAX_AT_CEILING + 1, 5.0, 0.0)).verdict
    assert many.level is Level.WARN
    assert "10% of the draws lie above the seed's density range" in many.reason
    few = report(np.where(np.arange(200) < 200 * MAX_AT_CEILING, 5.0, 0.0)).verdict
    assert (few.level, few.reason) == (Level.PASS, "")
    assert (few.figure, few.baseline, few.baseline_name) == ("effective sample size", 200.0, "draws kept")
    assert few.value > 100.0


def test_a_chain_of_which_one_hand_walks_away_does_not_mix_and_its_neighbour_has_a_size_of_its_own() -> None:
    """The hand moves farther away with every draw, so there is hardly one independent draw."""
    pairs = random_pairs(np.random.default_rng(3), 1000).reshape(2, 500, 2, 17, 3)
    wrist = PAIR17.index("left_wrist")
    pairs[1, :, 0, wrist] = pairs[1, :, 1, PAIR17.index("neck")] + np.linspace(0.1, 3.0, 500)[:, None] * [0.0, 0.0, 1.0]
    good, bad = diagnose(pairs, np.zeros((2, 500)), np.ones((2, 500)), thin=1, log_ceiling=5.0)
    assert good.ess_min > 100.0
    assert bad.ess_min == bad.verdict.value < 10.0
    assert good.rhat_max == bad.rhat_max > 1.1
    assert bad.verdict.level is Level.WARN
    assert re.match(r"not mixed: effective sample size \d of 500, R-hat \d\.\d+, \d+\.\d cm", bad.verdict.reason)


def test_chains_that_each_stay_in_a_place_of_their_own_do_not_mix() -> None:
    """Every draw is independent of the one before; chains are apart, or go nowhere."""
    pairs = random_pairs(np.random.default_rng(4), 800).reshape(2, 400, 2, 17, 3)
    apart = pairs + np.array([0.0, 0.8])[:, None, None, None, None] * np.array([[[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]])
    still = SEED + np.random.default_rng(5).normal(scale=1e-4, size=pairs.shape)
    for draws, level, has_rhat, has_way in (
        (pairs, Level.PASS, True, True),
        (apart, Level.WARN, False, True),
        (still, Level.WARN, True, False),
    ):
        for found in diagnose(draws, np.zeros((2, 400)), np.ones((2, 400)), thin=1, log_ceiling=5.0):
            assert found.ess_min >= 100.0
            assert (found.rhat_max < 1.1, found.travelled_m > 0.01) == (has_rhat, has_way)
            assert found.verdict.level is level


def test_a_chain_that_accepts_nothing_is_stuck_wherever_it_is() -> None:
    found = report(np.full(20, 5.0), num_accepted=0)
    assert found.verdict.level is Level.FAIL
    assert found.verdict.reason.startswith("stuck: 0.00% of the proposals were accepted")
    assert found.acceptance_rate == 0.0


def test_a_chain_that_never_moved_has_no_effective_sample_size() -> None:
    still = np.repeat(SEED[None], 8, axis=0)[None]
    (found,) = diagnose(still, np.zeros((1, 8)), np.zeros((1, 8)), thin=1, log_ceiling=1.0)
    assert np.isnan([found.ess_min, found.rhat_max]).all()
    assert found.travelled_m == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InputError, match="at least one chain with one draw"):
        diagnose(np.empty((0, 8, 2, 17, 3)), np.empty((0, 8)), np.empty((0, 8)), thin=1, log_ceiling=1.0)


def test_monitored_quantities_do_not_change_when_the_pair_moves_rigidly() -> None:
    pairs = random_pairs(np.random.default_rng(2), 5)
    np.testing.assert_allclose(invariants(pairs @ yaw_rotmat(0.7).T + 2.0), invariants(pairs), atol=1e-9)


def test_a_seed_that_no_annotation_resembles_is_named_with_its_likelihood() -> None:
    class Nothing(PriorOnly):
        def log_likelihood(self, pair_m: np.ndarray, *, at_least: float = -np.inf) -> float:
            return -np.inf

    chart = PairChart(SEED)
    with pytest.raises(InputError, match="density 0: the likelihood is 0, no view of the bank has an annotation"):
        PairDensity(chart, PhysicalPrior(chart, JointLimits.published()), Nothing())


def test_evidence_notes_what_was_skipped_and_what_is_few() -> None:
    likelihood = cast(Any, None)
    many = AnnotationEvidence(likelihood, num_annotations=100)
    assert many.note() == ""
    assert "2 of 102 annotations show too little or have no view" in replace(many, num_skipped=2).note()
    few = replace(many, num_annotations=1).note()
    assert few.startswith("1 annotation is fewer than the ")
    assert "see the pair from one side" in replace(many, view_spread_rad=0.1).note()
