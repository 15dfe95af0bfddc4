"""The 1-euro filter agrees with the published algorithm, which is written out here."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.kinematics.rotations import unitquat_from_rotvec
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


@pytest.mark.parametrize(("least", "beta"), [(1.0, 0.0), (0.5, 0.7), (3.0, 0.1)])
def test_the_filter_of_rotations_about_one_axis_is_the_published_one_of_the_angle(least: float, beta: float) -> None:
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.1, 80)) + rng.normal(0, 0.05, 80)
    axis = np.array([0.6, 0.0, -0.8])
    live = OneEuroFilter(OneEuro(min_cutoff_hz=least, beta=beta, derivative_cutoff_hz=1.3), 30.0)
    unitquat = unitquat_from_rotvec(angle[:, None, None] * axis)
    smooth = np.stack([live.step(frame, rotations) for frame, rotations in enumerate(unitquat)])[:, 0]
    expected = unitquat_from_rotvec(published_filter(angle, 30.0, least, beta, 1.3)[:, None] * axis)
    np.testing.assert_allclose(np.abs(np.sum(smooth * expected, axis=-1)), 1.0, atol=1e-12)
    with pytest.raises(ValidationError, match="min_cutoff_hz"):
        OneEuro(min_cutoff_hz=0.0)
