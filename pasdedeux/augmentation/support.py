"""Who stands on the floor, and which joints are near it; every weight fades, nothing switches."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from pasdedeux.augmentation.source import Source
from pasdedeux.interaction.contacts import fade
from pasdedeux.skeletons import BODY22

__all__ = ["FEET", "floor_weights", "stance_weights"]

Array = npt.NDArray[np.float64]

FEET = BODY22.indices(["left_ankle", "left_toe", "right_ankle", "right_toe"])
"""Joints of the feet of one person."""

_STANCE_SPEED_M_S = (0.15, 0.45)
_STANCE_HEIGHT_M = (0.05, 0.12)
_FLOOR_HEIGHT_M = (0.04, 0.15)
"""Fades: a foot slower and lower than the first stands, one beyond the second does not; likewise for the floor."""
_SMOOTHING_S = 0.3
"""Standard deviation of the averaging of all weights over time."""


def stance_weights(source: Source) -> Array:
    """Return how much each joint of the feet stands (frame, 2, 4), 1 standing: slow and low in the source."""
    feet = source.positions_m[:, :, FEET]
    velocity = np.gradient(feet, axis=0) * source.rate_hz if source.num_frames > 1 else np.zeros(feet.shape)
    speed = np.linalg.norm(velocity[..., [0, 2]], axis=-1)
    standing = fade(speed, *_STANCE_SPEED_M_S) * fade(_height(source)[:, :, FEET], *_STANCE_HEIGHT_M)
    return _smooth(standing, source)


def floor_weights(source: Source) -> Array:
    """Return how near the floor each joint is in the source (frame, 2, 22), 1 on it."""
    return _smooth(fade(_height(source), *_FLOOR_HEIGHT_M), source)


def _height(source: Source) -> Array:
    """Height above the floor (frame, 2, 22); an ankle's is taken above its own height when standing flat."""
    height = source.positions_m[..., 1] - source.floor_m[:, None]
    ankles = BODY22.indices(["left_ankle", "right_ankle"])
    height[:, :, ankles] -= source.flat_ankle_m[:, None]
    return np.asarray(height)


def _smooth(weights: Array, source: Source) -> Array:
    if source.num_frames < 2:
        return weights
    sigma = _SMOOTHING_S * source.rate_hz
    return np.asarray(gaussian_filter1d(weights, sigma, axis=0, mode="nearest", truncate=3.0))
