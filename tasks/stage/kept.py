"""A worker's cache between shards."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

_KEPT: list[Callable[[], None]] = []


def kept(count: int = 1) -> Callable[[F], F]:
    """Return a decorator: a worker caches results of the last `count` different calls between shards of a stage.

    Use it for data that many shards prepare in the same way. `forget_kept` empties it.
    """

    def decorated(function: F) -> F:
        cached = lru_cache(maxsize=count)(function)
        _KEPT.append(cached.cache_clear)
        return cast(F, cached)

    return decorated


def forget_kept() -> None:
    """Free the memory of everything that is kept."""
    for forget in _KEPT:
        forget()
    with suppress(AttributeError, OSError):  # other C libraries return memory by themselves, or have no such function
        ctypes.CDLL(None).malloc_trim(0)
