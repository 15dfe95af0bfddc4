"""Match people and clocks of two cameras by the vertical speeds of joints.

The upward speed of a joint relative to the mid-hip is the same for every camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Flags, interpolate
from pasdedeux.errors import InputError
from pasdedeux.projections.retarget import mid_hip

_MIN_SHARED_S = 1.0
"""Smallest time for which both cameras must see a person to compare clocks, or half of the shorter film."""
_MIN_CORRELATION = 0.25
"""Smallest mean correlation of speeds of the same people: 0.32 or more for built-in duets whose poses the database
lacks, at most 0.21 at wrong times or with people exchanged."""
_SMOOTHING_S = 0.1
"""Standard deviation of the Gaussian that smooths speeds, because errors of single frames are no motion."""


@dataclass(frozen=True)
class Rising:
    """The upward motion of a person's joints, as one camera sees it.

    Args:
        first_s: Time of the first frame by the camera's clock.
        speed_m_s: (frame, 14), upwards, about the mid-hip; frames follow each other at the common rate.
        is_known: Frames that were seen (frame,).
    """

    first_s: float
    speed_m_s: Array
    is_known: Flags

    @classmethod
    def of(cls, times_s: Array, upright_m: Array, is_known: Flags, rate_hz: float) -> Rising:
        """Return the upward motion of upright positions (frame, 14, 3) at times (frame,), resampled to a rate."""
        height_m = upright_m[..., 1] - mid_hip(upright_m)[:, None, 1]
        from scipy.ndimage import gaussian_filter1d  # here: planning does not need it

        grid_s = np.arange(times_s[0], times_s[-1] + 1e-9, 1.0 / rate_hz)
        even_m = interpolate(grid_s, times_s, height_m)
        known = np.interp(grid_s, times_s, is_known.astype(np.float64)) > 0.99
        speed_m_s = np.gradient(even_m, axis=0) * rate_hz if len(even_m) > 1 else 0.0 * even_m
        return cls(float(times_s[0]), gaussian_filter1d(speed_m_s, _SMOOTHING_S * rate_hz, axis=0), known)


@dataclass(frozen=True)
class SameTake:
    """The match of two cameras.

    Args:
        offset_s: Offset of the second camera's clock from the first.
        person_ids: Person of the first camera by person of the second.
    """

    offset_s: float
    person_ids: Mapping[int, int]


def match_cameras(first: Mapping[int, Rising], second: Mapping[int, Rising], rate_hz: float) -> SameTake:
    """Return the offset and the people at which the speeds of two cameras correlate most.

    Args:
        first: The people of the first camera, by person id.
        second: Those of the second.
        rate_hz: Rate of both.

    Raises:
        InputError: Nobody moves alike in both, or they share too little time.
    """
    from scipy.optimize import linear_sum_assignment  # here: planning does not need it

    ends_s = [
        [(person.first_s, person.first_s + len(person.speed_m_s) / rate_hz) for person in side.values()]
        for side in (first, second)
    ]
    (low, high), (other_low, other_high) = ((min(min(ends)), max(max(ends))) for ends in ends_s)
    lags = np.arange(np.floor((other_low - high) * rate_hz), np.ceil((other_high - low) * rate_hz) + 1)
    table = np.stack([[_correlations(a, b, lags, rate_hz) for b in second.values()] for a in first.values()])
    chosen = [linear_sum_assignment(-table[..., at]) for at in range(len(lags))]
    sums = np.array([table[*pairs, at].sum() for at, pairs in enumerate(chosen)])
    if not table.any():
        if not all(
            any(person.speed_m_s[person.is_known].any() for person in side.values()) for side in (first, second)
        ):
            raise InputError("nobody moves, so that their clocks cannot be found; choose a part with motion")
        raise InputError(
            f"they show nobody for {_MIN_SHARED_S:.0f} s together, or for half of the shorter film, whatever their "
            "clocks show"
        )
    best = int(np.argmax(sums))
    rows, columns = chosen[best]
    alike = [(row, column) for row, column in zip(rows, columns, strict=True) if table[row, column, best] > 0]
    mean = float(np.mean([table[row, column, best] for row, column in alike])) if alike else 0.0
    if mean < _MIN_CORRELATION:
        raise InputError(
            "they do not show the same people at the same time: nobody's joints move alike "
            f"(correlation {mean:.2f}, at least {_MIN_CORRELATION} is needed)"
        )
    names = list(first), list(second)
    people = {names[1][column]: names[0][row] for row, column in alike}
    return SameTake(float((lags[best] + _peak(sums, best)) / rate_hz), people)


def _correlations(first: Rising, second: Rising, lags: Array, rate_hz: float) -> Array:
    """Return the correlation of the speeds at every lag between the clocks, in frames (lag,).

    0 where they share too little time.
    """
    start = (second.first_s - first.first_s) * rate_hz
    needed = min(_MIN_SHARED_S * rate_hz, 0.5 * min(len(first.speed_m_s), len(second.speed_m_s)))
    correlations = np.zeros(len(lags))
    for at, lag in enumerate(lags):
        # Frame i of the first is frame i + shift of the second.
        shift = round(lag - start)
        low, high = max(0, -shift), min(len(first.speed_m_s), len(second.speed_m_s) - shift)
        if high - low < needed:
            continue
        both = first.is_known[low:high] & second.is_known[low + shift : high + shift]
        if both.sum() < needed:
            continue
        a, b = first.speed_m_s[low:high][both], second.speed_m_s[low + shift : high + shift][both]
        correlations[at] = float((a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-12))
    return correlations


def _peak(values: Array, at: int) -> float:
    """Return the offset of the top of the parabola through a value and its neighbours, in steps."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
