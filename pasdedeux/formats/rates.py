"""True frame rates for rates and frame times that files state rounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_USUAL_HZ = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 150, 180, 200, 240, 250, 300, 360, 480, 500)
"""Usual whole rates of cameras and capture systems."""
_SAME = 2e-4
"""Largest relative difference of equal rates, such as 30 and 30.0003 Hz; that of 30 and 29.97 is 1e-3."""
_ROUGH = 0.01
"""Largest relative uncertainty of the rate of a frame time without a doubt."""
_RESOLUTION = 1e-12
"""Relative resolution of a time in a float."""


def is_one_rate(first_hz: float, second_hz: float) -> bool:
    """Return whether two rates differ only by rounding."""
    return abs(first_hz - second_hz) <= _SAME * second_hz


def one_rate(rates_hz: Sequence[float]) -> list[float]:
    """Return rates in which equal ones, up to rounding, are replaced by the first.

    >>> one_rate([30.0, 30.0003, 29.97])
    [30.0, 30.0, 29.97]
    """
    kept: list[float] = []
    for rate_hz in rates_hz:
        kept.append(next((kept_hz for kept_hz in kept if is_one_rate(kept_hz, rate_hz)), rate_hz))
    return kept


def plain_rate(rate_hz: float) -> float:
    """Round a rate that is whole up to rounding, such as 30.0003; others, such as 29.97, stay.

    >>> plain_rate(30.0003), plain_rate(29.97)
    (30.0, 29.97)
    """
    whole = round(rate_hz) if abs(rate_hz) < 1e6 else 0
    return float(whole) if whole and is_one_rate(rate_hz, whole) else rate_hz


def rate_from_frame_time(token: str) -> tuple[float, str]:
    """Return the frame rate of a frame time as written, and a note if it is uncertain.

    Files cut the time to a few digits: 0.0333 is 30 Hz and 0.008333 is 120 Hz.  If exactly one whole rate rounds or
    cuts to these digits, it is taken; of several the usual one (0.033 is 30 Hz); else the inverse (0.033367 is 29.97).
    """
    time = float(token)
    mantissa, _, exponent = token.lower().partition("e")
    step = 10.0 ** -(len(mantissa.partition(".")[2]) - (int(exponent) if exponent else 0))
    step = max(step, time * _RESOLUTION)
    lowest, highest = 1.0 / (time + step), 1.0 / max(time - step, time * 1e-3)
    first, last = np.ceil(lowest), np.floor(highest)
    if first == last and first > 0:
        return float(first), ""
    rate_hz = plain_rate(1.0 / time)
    if rate_hz in _USUAL_HZ:
        return rate_hz, ""
    # Rounding moves a time by half a step either way, cutting by up to a step down.
    usual = [rate for rate in _USUAL_HZ if -0.5 * step <= 1.0 / rate - time < step and lowest < rate < highest]
    if len(usual) == 1:
        return float(usual[0]), f"its frame time {token} is rounded: {usual[0]} Hz is taken, not {1.0 / time:.4g}"
    is_rough = len(usual) > 1 and highest - lowest > _ROUGH * rate_hz
    doubt = f"its frame time {token} has few digits: {rate_hz:.4g} Hz may be off, compare with the length of the take"
    return rate_hz, doubt if is_rough else ""
