"""The 1-euro filter is that of the paper, written out plainly here."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.kinematics.rotations import rotvec_from_unitquat, unitquat_from_rotvec
from pasdedeux.reconstruction.smoothing import OneEuro, OneEuroFilter


def published_filter(values: np.ndarray, rate: float, least: float, beta: float, derivative: float) -> np.ndarray:
    """Casiez, Roussel and Vogel (2012), algorithm 1, for numbers."""

    def alpha(cutoff: float) -> float:
        tau = 1.0 / (2.0 * np.pi * cutoff)
        return 1.0 / (1.0 + tau * rate)

    out, slope = [values[0]], 0.0
    for value in values[1:]:
        raw = (value - out[-1]) * rate
        slope = alpha(derivative) * raw + (1.0 - alpha(derivative)) * slope
        share = alpha(least + beta * abs(slope))
        out.append(share * value + (1.0 - share) * out[-1])
    return np.array(out)


def filtered(unitquat: np.ndarray, settings: OneEuro) -> np.ndarray:
    """Return rotations (frame, n, 4) at 30 Hz after the filter, a frame at a time as live video has them."""
    filter_ = OneEuroFilter(settings, 30.0)
    return np.stack([filter_.step(frame, rotations) for frame, rotations in enumerate(unitquat)])


@pytest.mark.parametrize(("least", "beta"), [(1.0, 0.0), (0.5, 0.7), (3.0, 0.1)])
def test_the_filter_of_rotations_about_one_axis_is_the_published_one_of_the_angle(least: float, beta: float) -> None:
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.1, 80)) + rng.normal(0, 0.05, 80)
    axis = np.array([0.6, 0.0, -0.8])
    settings = OneEuro(min_cutoff_hz=least, beta=beta, derivative_cutoff_hz=1.3)
    smooth = filtered(unitquat_from_rotvec(angle[:, None, None] * axis), settings)[:, 0]
    expected = unitquat_from_rotvec(published_filter(angle, 30.0, least, beta, 1.3)[:, None] * axis)
    np.testing.assert_allclose(np.abs(np.sum(smooth * expected, axis=-1)), 1.0, atol=1e-12)
    with pytest.raises(ValidationError, match="min_cutoff_hz"):
        OneEuro(min_cutoff_hz=0.0)


def test_noise_at_rest_does_not_open_the_filter() -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (400, 1, 3))
    still, shut = (filtered(unitquat_from_rotvec(noise), OneEuro(min_cutoff_hz=0.5, beta=beta)) for beta in (0.2, 0.0))
    left = [np.std(rotvec_from_unitquat(one)[50:]) for one in (still, shut)]
    assert left[0] < 1.5 * left[1]
