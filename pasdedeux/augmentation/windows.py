"""Windows: long takes are solved in overlapping parts, so that memory does not grow with them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

__all__ = ["Window", "WindowSettings", "blend_weights", "plan_windows"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class WindowSettings:
    """How long takes are cut.

    Args:
        longest_s: Takes up to this long are solved whole; longer ones in windows of at most this length.
        overlap_s: Overlap of neighbouring windows.  Its first and last third are thrown away, as every window feels its
            own ends there (fading weights look 0.9 s around, what a stance foot does is felt for about a second); over
            the middle third one window is blended into the next.

    Raises:
        InputError: The overlap is not shorter than half a window, or not above 0.
    """

    longest_s: float = 30.0
    overlap_s: float = 3.0

    def __post_init__(self) -> None:
        """Check the lengths."""
        if not 0 < self.overlap_s < 0.5 * self.longest_s:
            raise InputError(
                f"windows of {self.longest_s:g} s overlapping by {self.overlap_s:g} s: allowed is an overlap above 0 "
                "and shorter than half a window"
            )


@dataclass(frozen=True)
class Window:
    """Frames `start` to `stop` (exclusive) of a take."""

    start: int
    stop: int


def plan_windows(num_frames: int, rate_hz: float, settings: WindowSettings) -> list[Window]:
    """Cut a take into as few windows of about equal length as there can be; one if it is short.

    >>> [(w.start, w.stop) for w in plan_windows(100, 1.0, WindowSettings(longest_s=40.0, overlap_s=9.0))]
    [(0, 40), (30, 70), (60, 100)]
    """
    longest = max(int(settings.longest_s * rate_hz), 4)
    overlap = max(int(settings.overlap_s * rate_hz), 1)
    if num_frames <= longest:
        return [Window(0, num_frames)]
    count = -(-(num_frames - overlap) // (longest - overlap))
    size = -(-(num_frames + (count - 1) * overlap) // count)
    starts = np.linspace(0, num_frames - size, count).round().astype(int)
    return [Window(int(start), int(start) + size) for start in starts]


def blend_weights(windows: list[Window]) -> list[Array]:
    """Return the share of each window in each of its frames; over all windows they add up to 1 in every frame.

    Shares rise by a quintic (6t^5 - 15t^4 + 10t^3), whose velocity and acceleration start and end at 0.
    """
    shares = [np.ones(window.stop - window.start) for window in windows]
    for index, (before, after) in enumerate(pairwise(windows)):
        overlap = before.stop - after.start
        t = np.clip((np.arange(overlap) + 0.5) / overlap * 3.0 - 1.0, 0.0, 1.0)
        rise = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
        shares[index][-overlap:] *= 1.0 - rise
        shares[index + 1][:overlap] *= rise
    return shares
