"""Every registered density keeps its promises: finite on real pairs, at most 1, invariant, equal to its plain form."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.chains import default_target
from benchmarks.synthetic import random_annotations
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import GatheredPairs
from pasdedeux.sampling.densities import DENSITIES
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import Likelihood, PairDensity, TargetSettings
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings
from tasks.chains import ChainsParameters
from tests.builders.poses import dancers

KNOWN = dancers(6, 120)
NEAR = [*(KNOWN[:3] + np.random.default_rng(2).normal(scale=0.01, size=KNOWN[:3].shape)), *dancers(5, 2)]


def annotations() -> GatheredPairs:
    annotated = random_annotations(np.random.default_rng(1), KNOWN, 150)
    return GatheredPairs(annotated, np.ones(150), 0, np.full((150, 2), 0.01))


def likelihood_of(name: str) -> Likelihood:
    density = DENSITIES[name]
    settings = AnnotationSettings(num_views=4, sigma_l=0.05, num_candidates=60)
    return density.init(settings, np.random.default_rng(3), annotations())


def target_of(likelihood: Likelihood, settings: TargetSettings) -> PairDensity:
    chart = PairChart(gauge_fix(KNOWN[0]))
    return PairDensity(chart, PhysicalPrior(chart, JointLimits.published(), settings), likelihood, settings)


@pytest.mark.parametrize("name", DENSITIES)
def test_a_likelihood_is_finite_and_at_most_one_and_equal_to_its_plain_form(name: str) -> None:
    likelihood = likelihood_of(name)
    for pair in NEAR:
        value = likelihood.log_likelihood(pair)
        assert np.isfinite(value)
        assert value <= 1e-9
        assert value == pytest.approx(likelihood.plain(pair), rel=1e-9, abs=1e-9)
        assert likelihood.log_likelihood(pair, at_least=value - 1e-6) == pytest.approx(value, rel=1e-12)
        # Below the level asked for it may say so at once.
        assert likelihood.log_likelihood(pair, at_least=value + 1e-6) in (value, -np.inf)


@pytest.mark.parametrize("name", DENSITIES)
def test_a_density_does_not_change_when_the_pair_moves_rigidly_and_has_a_likelier_seed_than_a_twisted_one(
    name: str,
) -> None:
    likelihood = likelihood_of(name)
    turn = rotmat_from_unitquat(normalise(np.array([0.2, -0.5, 0.1, 0.8])))
    for pair in NEAR:
        there = likelihood.log_likelihood(pair @ turn.T + [1.0, -2.0, 3.0])
        assert there == pytest.approx(likelihood.log_likelihood(pair), rel=1e-9, abs=1e-9)
    target = target_of(likelihood, TargetSettings(truncation=1e9))
    seed = target.chart.seed_parameters()
    assert np.isfinite(target(seed).log_density)
    twisted = seed.copy()
    twisted[30:36] = 2.0
    assert target(twisted).log_density < target(seed).log_density


@pytest.mark.parametrize("name", DENSITIES)
def test_a_density_of_annotations_says_which_are_nearest_and_another_none(name: str) -> None:
    likelihood = likelihood_of(name)
    num_views = 4 if DENSITIES[name].reads_annotations else 0
    assert (likelihood.sigma_l is not None) == (num_views > 0)
    assert likelihood.directions.shape == (num_views, 3)
    for pair in NEAR[:3]:
        nearest = likelihood.nearest(pair)
        assert nearest.entry.shape == nearest.dissimilarity_m.shape == (num_views,)
        assert ((nearest.entry >= -1) & (nearest.entry < 150)).all()
        assert np.isfinite(nearest.dissimilarity_m[nearest.entry >= 0]).all()


def test_the_benchmark_times_what_a_study_samples_that_sets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    given = annotations()
    monkeypatch.setattr("benchmarks.chains._problem", lambda: (KNOWN, given.pairs, None))
    timed, _, likelihood = default_target(gauge_fix(KNOWN[0]), max_invalid_angles=PriorSettings().max_invalid_angles)
    section = ChainsParameters()
    sampled = target_of(likelihood, section.part(TargetSettings))
    seed = timed.chart.seed_parameters()
    assert timed(seed) == sampled(seed)
    assert (timed.log_floor, timed.log_ceiling) == (sampled.log_floor, sampled.log_ceiling)
    assert (likelihood.sigma_l, len(likelihood.directions)) == (given.leave_one_out.sigma_l, section.num_views)
