"""Smooth functions of time: blends, bumps, curves through keys; all have two continuous derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array


def blend(time_s: Array, start_s: float, stop_s: float) -> Array:
    """Rise from 0 at `start_s` to 1 at `stop_s` with minimum jerk (Flash and Hogan 1985): 6x^5 - 15x^4 + 10x^3."""
    x = np.clip((time_s - start_s) / (stop_s - start_s), 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


def window(time_s: Array, start_s: float, full_s: float, fade_s: float, stop_s: float) -> Array:
    """Rise from 0 at `start_s` to 1 at `full_s`, stay, and fall from `fade_s` to 0 at `stop_s`."""
    return blend(time_s, start_s, full_s) - blend(time_s, fade_s, stop_s)


def bump(fraction: Array, *, fall: int = 3) -> Array:
    """Rise from 0 at 0 to 1 at 3 / (3 + fall) and return to 0 at 1: x^3 (1-x)^fall, scaled; 0 outside."""
    x = np.clip(fraction, 0.0, 1.0)
    peak = 3 / (3 + fall)
    return np.asarray(x**3 * (1.0 - x) ** fall / (peak**3 * (1.0 - peak) ** fall))


def halfway(weight: Array) -> Array:
    """Return 1 where a weight (frame,) is 0.5 and 0 where it is 0 or 1, as a column (frame, 1), for detours."""
    return np.asarray((4.0 * weight * (1.0 - weight))[:, None])


def mix(first: Array, second: Array, weight: Array) -> Array:
    """Mix vectors (frame, 3) by a weight (frame,): 0 gives `first`, 1 gives `second`."""
    return np.asarray(first + weight[:, None] * (second - first))


def curve_through(time_s: Array, start_s: float, step_s: float, keys: Array) -> Array:
    """Pass through equally spaced keys (key, ...) with two continuous derivatives; for steady travel.

    Quintic Hermite pieces whose slopes and bends at a key come from the four keys around it (five-point differences),
    so a value depends on six keys only.  The first two and the last two keys only shape the curve: `time_s` (frame,)
    must lie between the third and the last but two.
    """
    slope = (8.0 * (keys[3:-1] - keys[1:-3]) - (keys[4:] - keys[:-4])) / 12.0
    bend = (16.0 * (keys[3:-1] + keys[1:-3]) - (keys[4:] + keys[:-4]) - 30.0 * keys[2:-2]) / 12.0
    place = (time_s - start_s) / step_s - 2.0
    first = np.clip(np.floor(place).astype(int), 0, len(keys) - 6)
    x = (place - first).reshape(place.shape + (1,) * (keys.ndim - 1))
    p0, p1 = keys[2:-2][first], keys[2:-2][first + 1]
    v0, v1, a0, a1 = slope[first], slope[first + 1], bend[first], bend[first + 1]
    return np.asarray(
        p0
        + v0 * x
        + 0.5 * a0 * x**2
        + (10.0 * (p1 - p0) - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1) * x**3
        + (-15.0 * (p1 - p0) + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1) * x**4
        + (6.0 * (p1 - p0) - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)) * x**5
    )


def moves(time_s: Array, start: float, steps: Sequence[tuple[float, float, float]]) -> Array:
    """Rest at `start` and go to a new value from one time to another, for each (start_s, stop_s, value)."""
    value, at = np.full(len(time_s), start), start
    for start_s, stop_s, goal in steps:
        value += blend(time_s, start_s, stop_s) * (goal - at)
        at = goal
    return value


def saturate(value: Array, knee: float | Array, width: float | Array) -> Array:
    """Keep values up to `knee` exactly, and bend larger ones so that they stay under `knee + width`."""
    return np.asarray(np.where(value <= knee, value, knee + width * np.tanh((value - knee) / width)))


def soft_minimum(values: Sequence[Array], softness: float) -> Array:
    """Return a smooth value below the minimum of several arrays: -s log sum exp(-v / s)."""
    stack = np.stack(np.broadcast_arrays(*values))
    lowest = stack.min(axis=0)
    return np.asarray(lowest - softness * np.log(np.exp(-(stack - lowest) / softness).sum(axis=0)))
