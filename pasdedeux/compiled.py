"""Functions that numba compiles when they are first called: until then, numba is not even imported.

So what plans, or shows what is there, need not wait for it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from threading import RLock
from types import ModuleType
from typing import Any

_ONE_AT_A_TIME = RLock()
"""Held while kernels are put in their places, so that no thread calls one whose own kernels are not."""


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of kernels: `numba.njit` with these options, cached on disk and without the GIL."""
    return lambda function: _Kernel(function, options)


def intrinsic(function: Callable[..., Any]) -> _Kernel:
    """Return a part of kernels that is written in LLVM's own language: `numba.extending.intrinsic`."""
    return _Intrinsic(function, {})


class _Kernel:
    """A function to be compiled; numba sees what it would see if all kernels had been made by `numba.njit` at once.

    But for kernels that it names in a comprehension alone.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options = function, options
        self._begun: Any = None
        self._made: Any = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the compiled function."""
        if self._made is None:
            with _ONE_AT_A_TIME:
                self._made = self._make()
        return self._made(*arguments, **named)

    def _make(self) -> Any:
        """Hand the function to numba; the kernels that it calls, itself perhaps, are put in their places."""
        if self._begun is None:
            from numba import njit

            self._begun = njit(cache=True, nogil=True, **self._options)(self._function)
            used, names = self._function.__globals__, self._function.__code__.co_names
            modules = [found.__dict__ for name in names if isinstance(found := used.get(name), ModuleType)]
            try:
                for place in (used, *modules):
                    kernels = {name: found for name in names if isinstance(found := place.get(name), _Kernel)}
                    place.update({name: kernel._make() for name, kernel in kernels.items()})
            except BaseException:  # Ctrl-C between two: the next call begins anew
                self._begun = None
                raise
        return self._begun


class _Intrinsic(_Kernel):
    """What kernels may call; from Python, nobody can."""

    def _make(self) -> Any:
        if self._begun is None:
            from numba.extending import intrinsic

            self._begun = intrinsic(self._function)
        return self._begun
