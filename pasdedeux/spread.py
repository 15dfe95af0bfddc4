"""Evenly spread samples of frames, annotations or rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T")


def evenly_spread(total: int, count: int, *, has_ends: bool = True) -> npt.NDArray[np.int64]:
    """Return at most `count` indices below `total`, evenly spread and rising; two or more include the first and last.

    Returns all indices if there are no more than `count`. Without ends, all gaps have one width.

    >>> evenly_spread(10, 4).tolist()
    [0, 3, 6, 9]
    >>> evenly_spread(10, 2, has_ends=False).tolist()
    [3, 6]
    """
    if total < 1 or count < 1:
        return np.zeros(0, dtype=np.int64)
    places = np.linspace(0, total - 1, min(count, total)) if has_ends else np.linspace(0, total - 1, count + 2)[1:-1]
    return np.unique(places.round().astype(np.int64))


def some_of(items: Sequence[T], count: int, *, has_ends: bool = True) -> list[T]:
    """Return at most `count` of these, evenly spread and in order; see `evenly_spread`.

    >>> some_of("abcde", 3)
    ['a', 'c', 'e']
    """
    return [items[at] for at in evenly_spread(len(items), count, has_ends=has_ends)]
