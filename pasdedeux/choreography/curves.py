"""Smooth functions of time: blends, bumps, curves through keys; all have two continuous derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

__all__ = ["blend", "bump", "curve_through", "mix", "moves", "saturate", "soft_minimum", "window"]

Array = npt.NDArray[np.float64]


def blend(time_s: Array, start_s: float, stop_s: float) -> Array:
    """Rise from 0 before `start_s` to 1 after `stop_s` with least jerk (Flash and Hogan 1985): 6x^5 - 15x^4 + 10x^3."""
    x = np.clip((time_s - start_s) / (stop_s - start_s), 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


def window(time_s: Array, start_s: float, full_s: float, fade_s: float, stop_s: float) -> Array:
    """Rise from 0 at `start_s` to 1 at `full_s`, stay, and fall from `fade_s` to 0 at `stop_s`."""
    return blend(time_s, start_s, full_s) - blend(time_s, fade_s, stop_s)


def bump(fraction: Array, *, rise: int = 3, fall: int = 3) -> Array:
    """Go from 0 at 0 over 1 at rise / (rise + fall) back to 0 at 1: x^rise (1-x)^fall, scaled; 0 outside."""
    x = np.clip(fraction, 0.0, 1.0)
    peak = rise / (rise + fall)
    return np.asarray(x**rise * (1.0 - x) ** fall / (peak**rise * (1.0 - peak) ** fall))


def mix(first: Array, second: Array, weight: Array) -> Array:
    """Mix values (frame, ...) by a weight (frame,): 0 gives `first`, 1 gives `second`."""
    w = weight.reshape(weight.shape + (1,) * (np.ndim(second) - 1)) if np.ndim(second) > 1 else weight
    return np.asarray(first + w * (second - first))


def curve_through(time_s: Array, key_times_s: Sequence[float] | Array, keys: Array) -> Array:
    """Pass through keys (key, ...) as a quintic spline that is evaluated at `time_s` (frame,); for steady travel."""
    spline = make_interp_spline(np.asarray(key_times_s, dtype=np.float64), np.asarray(keys, dtype=np.float64), k=5)
    return np.asarray(spline(time_s))


def moves(time_s: Array, start: Array | float, steps: Sequence[tuple[float, float, Array | float]]) -> Array:
    """Rest at `start` and go to a new value from one time to another, as often as told: (start_s, stop_s, value)."""
    at = np.asarray(start, dtype=np.float64)
    value = np.broadcast_to(at, (*time_s.shape, *at.shape)).copy()
    for start_s, stop_s, goal in steps:
        weight = blend(time_s, start_s, stop_s)
        value += weight.reshape(weight.shape + (1,) * at.ndim) * (np.asarray(goal, dtype=np.float64) - at)
        at = np.asarray(goal, dtype=np.float64)
    return value


def saturate(value: Array, knee: float | Array, width: float | Array) -> Array:
    """Keep values up to `knee` exactly, and bend larger ones so that they stay under `knee + width`."""
    return np.asarray(np.where(value <= knee, value, knee + width * np.tanh((value - knee) / width)))


def soft_minimum(values: Sequence[Array], softness: float) -> Array:
    """Give a smooth value below the least of several arrays: -s log sum exp(-v / s)."""
    stack = np.stack(np.broadcast_arrays(*values))
    least = stack.min(axis=0)
    return np.asarray(least - softness * np.log(np.exp(-(stack - least) / softness).sum(axis=0)))
