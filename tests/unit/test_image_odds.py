"""Other lifts of an image show nothing in it, and the true one is mostly told from them."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.experiments.agreement import Agreement
from pasdedeux.experiments.image_odds import LiftDensity, other_lifts
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility import JointLimits, Occupancy
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import dancers

_RNG = np.random.default_rng(0)
_KNOWN = dancers(0, 20)
GROWN = np.concatenate([_KNOWN] * 5) + _RNG.normal(scale=0.015, size=(100, 2, 17, 3))
NEAR = _KNOWN + _RNG.normal(scale=0.005, size=_KNOWN.shape)
DENSITY = LiftDensity(Agreement(GROWN), JointLimits.published(), Occupancy.empty().extended(_KNOWN))


def test_other_lifts_have_the_image_and_the_bones_and_all_differ() -> None:
    lifts = other_lifts(NEAR[0])
    np.testing.assert_array_equal(lifts[..., :2], np.broadcast_to(NEAR[0, ..., :2], lifts[..., :2].shape))
    lengths = bone_lengths(PAIR17, NEAR[0])
    np.testing.assert_allclose(bone_lengths(PAIR17, lifts), np.broadcast_to(lengths, (len(lifts), *lengths.shape)))
    every = np.concatenate([NEAR[:1], lifts]).reshape(len(lifts) + 1, -1)
    apart = np.abs(every[:, None] - every[None]).max(axis=-1)
    assert apart[~np.eye(len(every), dtype=bool)].min() > 1e-6


def test_mirroring_a_lift_again_gives_the_pair_back() -> None:
    lifts = other_lifts(NEAR[0])
    for index in range(27):
        np.testing.assert_allclose(other_lifts(lifts[index])[index], NEAR[0], atol=1e-12)


def test_the_odds_are_the_share_among_all_lifts_and_prefer_what_grew() -> None:
    for pair in NEAR[:4]:
        lifts = np.concatenate([pair[None], other_lifts(pair)])
        odds = DENSITY.odds(np.concatenate([pair[None], lifts[[1, 5, 30]]]))
        logs = DENSITY.logs(lifts)
        assert odds[0] == pytest.approx(logs[0] - np.logaddexp.reduce(logs))
        assert odds[0] <= 0.0
        assert (odds[0] > odds[1:]).all()
