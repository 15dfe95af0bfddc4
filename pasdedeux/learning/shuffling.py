"""The order of windows in an epoch: shuffled over many clips, and computed on demand.

Clips are shuffled, and the windows of so many clips at a time among each other.  So any part of an epoch follows from a
few numbers per clip: a loader can distribute batches among workers and ranks, or resume in the middle, without reading
anything.  Windows of one group lie near each other on the disk.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Numbers = npt.NDArray[np.int64]

_MIXED = 1_000
"""Clips whose windows are shuffled among each other."""


class WindowOrder:
    """The order of an epoch.

    Args:
        counts: Windows of each clip (n,); windows are numbered through, clip after clip.
        generator: Gives the generator of the clips' order (0) and of each group of clips (1, 2, ...), always the same;
            None keeps the windows in their order.
    """

    def __init__(self, counts: Numbers, generator: Callable[[int], np.random.Generator] | None) -> None:
        self._generator = generator
        self._clips = np.arange(len(counts)) if generator is None else generator(0).permutation(len(counts))
        self._counts, self._first = counts[self._clips], (np.cumsum(counts) - counts)[self._clips]
        self._stops = np.cumsum(self._counts)
        self._group: tuple[int, Numbers] = (-1, self._clips[:0])

    def __len__(self) -> int:
        return int(self._stops[-1]) if len(self._stops) else 0

    def windows(self, start: int, stop: int) -> Numbers:
        """Return the numbers of the windows from place `start` of the epoch up to `stop`."""
        parts = [self._clips[:0]]
        while start < min(stop, len(self)):
            number = int(np.searchsorted(self._stops, start, side="right")) // _MIXED
            begins = int(self._stops[number * _MIXED - 1]) if number else 0
            parts.append(self._windows_of(number)[start - begins : stop - begins])
            start += len(parts[-1])
        return np.concatenate(parts)

    def _windows_of(self, number: int) -> Numbers:
        """Return the windows of a group of clips in their order; the last group that was asked for is kept."""
        if self._group[0] != number:
            group = slice(number * _MIXED, (number + 1) * _MIXED)
            counts, first = self._counts[group], self._first[group]
            windows = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
            if self._generator is not None:
                windows = self._generator(number + 1).permutation(windows)
            self._group = number, windows
        return self._group[1]
