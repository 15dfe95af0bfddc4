"""A cache of a worker, from shard to shard."""

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

    For what many shards make ready alike; until `forget_kept`.
    """

    def decorated(function: F) -> F:
        cached = lru_cache(maxsize=count)(function)
        _KEPT.append(cached.cache_clear)
        return cast(F, cached)

    return decorated


def forget_kept() -> None:
    """Give back the memory of all that is kept."""
    for forget in _KEPT:
        forget()
    with suppress(AttributeError, OSError):  # another C library gives it back by itself, or has no name for that
        ctypes.CDLL(None).malloc_trim(0)
