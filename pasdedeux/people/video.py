"""Whether frame numbers are those of a video, and its rate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

__all__ = ["rate_from_times", "why_no_video"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_SHORT_SPAN = 1000
"""Up to so many frames gaps cost nothing, so any are bridged."""
_MIN_SHARE_SEEN = 0.05
"""Of a longer sequence at least this share of the frames has people in it, or it is no video."""


def why_no_video(frame: Integers) -> str:
    """Say why frame numbers are not those of a video: single images, numbered by their ids or the time; else nothing.

    The gaps of such a sequence have no motion to bridge them, and there may be millions of frames of them.
    """
    numbers = np.unique(frame)
    span = int(numbers[-1] - numbers[0]) + 1 if len(numbers) else 0
    if span <= _SHORT_SPAN or len(numbers) >= _MIN_SHARE_SEEN * span:
        return ""
    return f"{len(numbers):,} frames spread over {span:,} are single images, not a video"


def rate_from_times(frame: Integers, time_s: Array) -> float:
    """Return the frames per second of rows with these frame numbers and times; gaps in the numbers do not matter.

    Raises:
        InputError: The times do not grow with the frames, so there is no rate.
    """
    numbers, first = np.unique(frame, return_index=True)
    if len(numbers) < 2:
        return 1.0
    steps = np.diff(time_s[first]) / np.diff(numbers)
    step = float(np.median(steps))
    if not (np.isfinite(step) and step > 0):
        raise InputError(f"the times of the annotations do not grow with the frames (median step {step} s)")
    return 1.0 / step
