"""Shape contexts: laws, a case worked by hand, and the streaming form against the plain one."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.interaction.shape_context import NUM_BANDS, NUM_SECTORS, NUM_SHELLS, ShapeCoverage, shape_bins
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat

PAIRS = random_pairs(np.random.default_rng(0), 40)


def pair_shape_dissimilarity(first_m: np.ndarray, second_m: np.ndarray) -> np.ndarray:
    """Return D_S (*batch,) between pairs (*batch, 2, 17, 3): the mean chi-squared cost of all joints' histograms."""
    ids = np.arange(NUM_SHELLS * NUM_SECTORS * NUM_BANDS)
    first, second = ((shape_bins(pairs)[..., None] == ids).mean(axis=-2) for pairs in (first_m, second_m))
    total = first + second
    return (0.5 * np.sum((first - second) ** 2 / np.where(total > 0.0, total, 1.0), axis=-1)).mean(axis=-1)


def test_rigid_motion_changes_no_shape_context() -> None:
    rng = np.random.default_rng(1)
    turn = rotmat_from_unitquat(normalise(rng.normal(size=(40, 4))))
    moved = np.einsum("nij,npkj->npki", turn, PAIRS) + rng.normal(size=(40, 1, 1, 3))
    # A joint exactly on the edge of a bin may change sides by rounding.
    assert pair_shape_dissimilarity(moved, PAIRS).max() < 1e-3


def test_shape_contexts_are_symmetric_between_0_and_1_and_see_reflection() -> None:
    forth, back = pair_shape_dissimilarity(PAIRS[:20], PAIRS[20:]), pair_shape_dissimilarity(PAIRS[20:], PAIRS[:20])
    np.testing.assert_allclose(forth, back, atol=1e-12)
    assert ((forth > 0.0) & (forth < 1.0)).all()
    assert pair_shape_dissimilarity(PAIRS * [-1.0, 1.0, 1.0], PAIRS).min() > 0.05


def test_the_streaming_form_agrees_with_the_plain_one_whatever_the_batches() -> None:
    truth, draws = PAIRS[:9], PAIRS[9:]
    every = pair_shape_dissimilarity(draws[None], truth[:, None])
    coverage = ShapeCoverage(truth)
    assert np.isinf(coverage.shape).all()
    for part in (draws[:1], draws[1:20], draws[20:]):
        coverage.add(shape_bins(part))
    np.testing.assert_allclose(coverage.shape, every.min(axis=1), atol=1e-12)


def test_joints_in_one_place_have_bins_and_missing_ones_are_refused() -> None:
    assert shape_bins(np.zeros((2, 17, 3))).shape == (34, 33)
    with pytest.raises(InputError, match="finite"):
        shape_bins(PAIRS[:1] * np.nan)
    with pytest.raises(InputError, match="at least one"):
        ShapeCoverage(PAIRS[:0])
