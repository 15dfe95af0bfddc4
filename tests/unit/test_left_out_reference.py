"""How likely a real pair is that is not annotated, from annotations left out in turn."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.benchmarks.synthetic import random_annotations, random_pairs
from pasdedeux.cameras import angle_between_directions
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity
from pasdedeux.sampling.reference import left_out_dissimilarity, left_out_log_likelihood


def test_left_out_annotations_are_compared_with_all_others_seen_alike() -> None:
    rng = np.random.default_rng(15)
    pairs = random_annotations(rng, random_pairs(rng, 6, spread_rad=0.1), 12)
    expected = []
    for row in range(12):
        is_near = angle_between_directions(pairs.directions[row], pairs.directions) <= 0.9
        points = pairs.points_m.reshape(12, 34, 2)
        own = [interaction_dissimilarity(points[row], points[one]) for one in np.flatnonzero(is_near) if one != row]
        expected += [min(own)] if own else []
    assert len(expected) > 6
    np.testing.assert_allclose(left_out_dissimilarity(pairs, view_bandwidth_rad=0.9), expected)


def test_the_log_likelihood_of_a_left_out_pair_is_that_of_its_views() -> None:
    rng = np.random.default_rng(16)
    assert left_out_log_likelihood(np.full(5, 0.02), 20, rng) == pytest.approx(-0.02 / 2e-4)
    spread = np.array([0.01, 0.03])
    low, high = (left_out_log_likelihood(spread, 3, rng, quantile=q) for q in (0.0, 1.0))
    assert low == pytest.approx(-0.03 / 2e-4)
    assert high == pytest.approx(-0.01 / 2e-4)
    with pytest.raises(InputError, match="no two annotations have similar views"):
        left_out_log_likelihood(np.empty(0), 3, rng)
