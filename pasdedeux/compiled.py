"""Functions that numba compiles when they are first called: until then, numba is not even imported.

So what plans, or shows what is there, need not wait for it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, update_wrapper
from types import ModuleType
from typing import Any

__all__ = ["compiled"]


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of kernels: `numba.njit` with these options, cached on disk and without the GIL."""
    return lambda function: _Kernel(function, options)


class _Kernel:
    """A function to be compiled; numba sees what it would see if all kernels had been made by `numba.njit` at once."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options = function, options
        update_wrapper(self, function)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the compiled function."""
        return self._made(*arguments, **named)

    @cached_property
    def _made(self) -> Any:
        """What numba makes of the function; the kernels that it calls are put in their places before."""
        from numba import njit

        made = self.__dict__["_made"] = njit(cache=True, nogil=True, **self._options)(self._function)  # may call itself
        used, names = self._function.__globals__, self._function.__code__.co_names
        modules = [found.__dict__ for name in names if isinstance(found := used.get(name), ModuleType)]
        for place in (used, *modules):
            place.update({name: found._made for name in names if isinstance(found := place.get(name), _Kernel)})
        return made
