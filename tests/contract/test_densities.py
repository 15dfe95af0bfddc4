"""Every registered density keeps its promises: finite on real pairs, at most 1, invariant, equal to its plain form."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.benchmarks.chains import default_target
from pasdedeux.benchmarks.synthetic import random_annotations
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import GatheredPairs
from pasdedeux.sampling.density import DensityInputs, ImageSettings, Likelihood, Reads, TargetSettings
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.prior import PriorSettings
from tasks.chains import DENSITIES, ChainsParameters
from tests.builders.poses import dancers

KNOWN = dancers(6, 120)
NEAR = [*(KNOWN[:6] + np.random.default_rng(2).normal(scale=0.01, size=KNOWN[:6].shape)), *dancers(5, 4)]


def inputs() -> DensityInputs:
    rng = np.random.default_rng(1)
    annotated = random_annotations(rng, KNOWN, 150)
    gathered = GatheredPairs(annotated, np.ones(150), 0, np.full((150, 2), 0.01))
    return DensityInputs(KNOWN[0], np.random.default_rng(3), annotated=gathered)


def likelihood_of(name: str) -> Likelihood | None:
    kind = DENSITIES[name]
    quick = {"num_views": 4, "sigma_l": 0.05, "num_candidates": 60}
    settings = kind.settings(**{key: value for key, value in quick.items() if key in kind.settings.model_fields})
    return kind.likelihood(settings, inputs())


@pytest.mark.parametrize("name", DENSITIES)
def test_a_likelihood_is_finite_and_at_most_one_and_equal_to_its_plain_form(name: str) -> None:
    likelihood = likelihood_of(name)
    if likelihood is None:
        assert DENSITIES[name].reads is Reads.NOTHING
        return
    for pair in NEAR:
        value = likelihood.log_likelihood(pair)
        assert np.isfinite(value)
        assert value <= 1e-9
        assert value == pytest.approx(likelihood.plain(pair), rel=1e-9, abs=1e-9)
        assert likelihood.log_likelihood(pair, at_least=value + 1e-6) == -np.inf
        assert likelihood.log_likelihood(pair, at_least=value - 1e-6) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("name", DENSITIES)
def test_a_density_does_not_change_when_the_pair_moves_rigidly_and_has_a_likelier_seed_than_a_twisted_one(
    name: str,
) -> None:
    kind, likelihood = DENSITIES[name], likelihood_of(name)
    turn = rotmat_from_unitquat(normalise(np.array([0.2, -0.5, 0.1, 0.8])))
    for pair in NEAR if likelihood is not None else ():
        there = likelihood.log_likelihood(pair @ turn.T + [1.0, -2.0, 3.0])
        assert there == pytest.approx(likelihood.log_likelihood(pair), rel=1e-9, abs=1e-9)
    chart = PairChart(gauge_fix(KNOWN[0]))
    target = kind.target(chart, JointLimits.published(), likelihood, TargetSettings(truncation=1e9))
    seed = chart.seed_parameters()
    assert np.isfinite(target(seed).log_density)
    twisted = seed.copy()
    twisted[30:36] = 2.0
    assert target(twisted).log_density < target(seed).log_density


@pytest.mark.parametrize("name", [name for name, kind in DENSITIES.items() if kind.reads is Reads.ANNOTATIONS])
def test_a_density_of_annotations_says_which_are_nearest(name: str) -> None:
    kind, likelihood = DENSITIES[name], likelihood_of(name)
    assert issubclass(kind.settings, ImageSettings)
    for pair in NEAR[:3]:
        nearest = likelihood.nearest(pair)
        assert nearest.shape == (4,)
        assert ((nearest >= -1) & (nearest < 150)).all()


def test_the_benchmark_times_what_a_study_samples_that_sets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    given = inputs()
    assert given.annotated is not None
    monkeypatch.setattr("pasdedeux.benchmarks.chains._problem", lambda: (KNOWN, given.annotated.pairs, None))
    timed, _, likelihood = default_target(gauge_fix(KNOWN[0]), max_invalid_angles=PriorSettings().max_invalid_angles)
    section = ChainsParameters()
    (kind,) = (DENSITIES[name] for name in section.densities if DENSITIES[name].reads is Reads.ANNOTATIONS)
    settings = section.part(kind.settings)
    assert isinstance(settings, ImageSettings)
    sampled = kind.target(timed.chart, JointLimits.published(), likelihood, section.part(TargetSettings))
    seed = timed.chart.seed_parameters()
    assert timed(seed) == sampled(seed)
    assert (timed.log_floor, timed.log_ceiling) == (sampled.log_floor, sampled.log_ceiling)
    assert (likelihood.sigma_l, len(likelihood.directions)) == (given.annotated.left_out.sigma_l, settings.num_views)


def test_the_section_has_the_settings_of_every_kind_with_one_meaning_each() -> None:
    section = ChainsParameters.model_fields
    for kind in DENSITIES.values():
        for name, field in kind.settings.model_fields.items():
            assert (section[name].default, section[name].description) == (field.default, field.description)
            assert field.description
