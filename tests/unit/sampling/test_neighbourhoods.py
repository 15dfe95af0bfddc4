"""Pairs filled in between grown pairs: bodies of their parents, plausible, and unlike each other."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.interaction.nearest import cartesian_distances
from pasdedeux.kinematics import align_rigid, bone_lengths
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.neighbourhoods import MIN_FILLED_LOG_PRIOR, NUM_PARENTS, pairs_between
from pasdedeux.sampling.parameters import LENGTH_INDICES, MIRRORED_LENGTH, PairChart
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import DUPLICATE_M
from pasdedeux.skeletons import PAIR17

LIMITS = JointLimits.published()
WIDE = JointLimits(np.full(29, -10.0), np.full(29, 10.0), ("anything",) * 29)


def test_parameters_of_a_pair_are_the_inverse_of_its_positions() -> None:
    rng = np.random.default_rng(3)
    pairs = random_pairs(rng, 20, spread_rad=0.5)
    chart = PairChart(pairs[0])
    parameters = chart.parameters_of(pairs[1:])
    # All people have one body here, so nothing is lost, whatever the pose and place.
    assert np.abs(chart.positions(parameters) - pairs[1:]).max() < 2e-4
    np.testing.assert_allclose(chart.parameters_of(pairs[0]), chart.seed_parameters(), atol=1e-9)
    moved = pairs[1] @ yaw_rotmat(2.0).T + np.array([3.0, 1.0, -2.0])
    assert np.abs(chart.positions(chart.parameters_of(moved)) - moved).max() < 2e-4


def test_lengths_of_another_body_are_tied_and_clipped() -> None:
    pair = random_pairs(np.random.default_rng(4), 1)[0]
    chart = PairChart(pair)
    parameters = chart.parameters_of(1.2 * pair)
    np.testing.assert_allclose(parameters[LENGTH_INDICES], 0.05)
    np.testing.assert_allclose(bone_lengths(PAIR17, chart.positions(parameters)), 1.05 * chart.lengths_m)
    lopsided = pair.copy()
    wrist, elbow = PAIR17.indices(("left_wrist", "left_elbow"))
    lopsided[0, wrist] = pair[0, elbow] + 1.04 * (pair[0, wrist] - pair[0, elbow])
    parameters = chart.parameters_of(lopsided)
    np.testing.assert_allclose(parameters[LENGTH_INDICES], parameters[MIRRORED_LENGTH])
    assert parameters[LENGTH_INDICES].max() == pytest.approx(0.02)


def test_filled_pairs_lie_between_their_parents_and_are_plausible_and_new() -> None:
    pairs = random_pairs(np.random.default_rng(5), 40, spread_rad=0.1)
    filling = pairs_between(pairs, 60, np.random.default_rng(1), LIMITS)
    assert len(filling.pairs_m) == 60
    parents = pairs[filling.parents[:, 0]]
    np.testing.assert_allclose(bone_lengths(PAIR17, filling.pairs_m), bone_lengths(PAIR17, parents))
    quality = seed_quality(filling.pairs_m, LIMITS)
    assert quality.is_possible.all()
    assert quality.log_prior.min() >= MIN_FILLED_LOG_PRIOR
    np.testing.assert_allclose(filling.log_prior, quality.log_prior)
    every = np.concatenate([pairs, filling.pairs_m])
    distance = cartesian_distances(filling.pairs_m, every)
    distance[np.arange(60), 40 + np.arange(60)] = np.inf
    assert distance.min() >= DUPLICATE_M
    # A filled pair is nearer to its main parent than pairs of the set are to each other on average.
    first = filling.parents[np.arange(60), filling.weights.argmax(axis=1)]
    near = cartesian_dissimilarity(filling.pairs_m.reshape(60, 34, 3), pairs[first].reshape(60, 34, 3))
    assert near.mean() < 0.6 * cartesian_distances(pairs, pairs)[~np.eye(40, dtype=bool)].mean()


def test_weight_on_one_parent_gives_that_pair_back(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = random_pairs(np.random.default_rng(6), 12, spread_rad=0.2)

    class OnTheThird(np.random.Generator):
        def dirichlet(self, alpha: np.ndarray, size: int) -> np.ndarray:  # type: ignore[override]
            return np.tile(np.eye(NUM_PARENTS)[2], (size, 1))

    monkeypatch.setattr(
        "pasdedeux.sampling.neighbourhoods.PairSelector.add", lambda self, given, *_: np.ones(len(given), bool)
    )
    monkeypatch.setattr("pasdedeux.sampling.neighbourhoods.MIN_FILLED_LOG_PRIOR", -np.inf)
    filling = pairs_between(pairs, 12, OnTheThird(np.random.PCG64(1)), WIDE)
    for pair, parents in zip(filling.pairs_m, filling.parents, strict=True):
        third, points = pairs[parents[2]].reshape(-1, 3), pair.reshape(-1, 3)
        np.testing.assert_allclose(align_rigid(points, third).apply(points), third, atol=2e-4)


def test_fewer_are_filled_in_where_means_are_refused_or_alike() -> None:
    same = np.repeat(random_pairs(np.random.default_rng(7), 1), 8, axis=0)
    filling = pairs_between(same, 3, np.random.default_rng(1), WIDE)
    assert filling.pairs_m.shape == (0, 2, 17, 3)
    assert filling.num_refused > 0
    assert pairs_between(same[:6], 3, np.random.default_rng(1), WIDE).parents.shape == (0, NUM_PARENTS)
