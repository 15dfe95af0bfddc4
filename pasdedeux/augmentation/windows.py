"""Windows: long takes are solved in overlapping parts, so that memory does not grow with them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array

LONGEST_S = 30.0
"""Longer takes are solved in overlapping windows of this length, seconds."""
OVERLAP_S = 3.0
"""Overlap of neighbouring windows, seconds.

Its first and last third are discarded, because the ends of a window have an effect there (fading weights reach 0.9 s, a
stance foot about a second); over the middle third one window is blended into the next.
"""


def plan_windows(num_frames: int, rate_hz: float, longest_s: float, *, overlap_s: float = OVERLAP_S) -> list[slice]:
    """Cut a take into as few windows of about equal length as there can be; one if it is short.

    >>> [(w.start, w.stop) for w in plan_windows(100, 1.0, 40.0, overlap_s=9.0)]
    [(0, 40), (30, 70), (60, 100)]
    """
    longest = max(int(longest_s * rate_hz), 4)
    overlap = max(int(overlap_s * rate_hz), 1)
    if num_frames <= longest:
        return [slice(0, num_frames)]
    count = -(-(num_frames - overlap) // (longest - overlap))
    size = -(-(num_frames + (count - 1) * overlap) // count)
    starts = np.linspace(0, num_frames - size, count).round().astype(int)
    return [slice(int(start), int(start) + size) for start in starts]


def blend_weights(windows: list[slice]) -> list[Array]:
    """Return the share of each window in each of its frames; over all windows they add up to 1 in every frame.

    Shares rise by 6t^5 - 15t^4 + 10t^3, from 0 at 0 to 1 at 1, where velocity and acceleration are 0.
    """
    shares = [np.ones(window.stop - window.start) for window in windows]
    for index, (before, after) in enumerate(pairwise(windows)):
        overlap = before.stop - after.start
        t = np.clip((np.arange(overlap) + 0.5) / overlap * 3.0 - 1.0, 0.0, 1.0)
        rise = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
        shares[index][-overlap:] *= 1.0 - rise
        shares[index + 1][:overlap] *= rise
    return shares
