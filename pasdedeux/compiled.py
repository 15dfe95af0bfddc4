"""Functions that numba compiles when they are first called: until then, numba is not even imported.

So what plans, or shows what is there, need not wait for it.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import update_wrapper
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import Any

_ONE_AT_A_TIME = RLock()
"""Held while kernels are put in their places, so that no thread calls one whose own kernels are not."""
_LOCKED: set[str] = set()
"""Names of the kernels that this process compiles alone, by the one thread that holds numba's lock."""


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of kernels: `numba.njit` with these options, cached on disk and without the GIL.

    Division by zero gives infinity or NaN, as numpy's does.  A kernel may call itself, but with arguments of the same
    types: numba crashes when it loads another from the cache.
    """
    return lambda function: _Kernel(function, options)


def inner_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of functions that only kernels call: small ones compile in a third of the time.

    Python must not call them: its process would crash.
    """
    return compiled(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


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
            self._begun = _compiled_once(self._function, self._options)
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


def _compiled_once(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return what numba makes of a function, compiled once for arguments of a type.

    Numba would compile it for each constant that a kernel passes, and in every process that asks at the same time: here
    one compiles, the others wait and load.  Where nothing can be kept, each process compiles for itself.
    """
    from numba import config, njit
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.types import unliteral

    if config.DISABLE_JIT:  # type: ignore[attr-defined]  # set when numba reads the environment
        return function
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        made = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that it may write to
        made = njit(**options)(function)
    compile_anew = made.compile

    def compile_once(signature: tuple[Any, ...]) -> Any:
        arguments = tuple(unliteral(one) for one in signature)
        if arguments in made.overloads:
            return made.overloads[arguments].entry_point
        # Numba's own lock first: who waits for a file here holds all files that other threads may wait for.
        with global_compiler_lock, _alone(made.stats.cache_path, f"{function.__module__}.{function.__qualname__}"):
            try:
                return compile_anew(arguments)
            except OSError:  # the disk of the cache is full, or was taken away
                if arguments not in made.overloads:
                    raise
                return made.overloads[arguments].entry_point

    made.compile = compile_once
    return made


@contextmanager
def _alone(folder: str | None, name: str) -> Iterator[None]:
    """Let no other process of this machine be in this block for the kernel of this name; where files can be locked.

    Kernels call each other in one direction, so processes never wait in a circle; one that calls itself with arguments
    of another type is in its own block already.
    """
    handle = None
    try:
        if folder is not None and name not in _LOCKED:
            with suppress(OSError):
                handle = os.open(Path(folder) / f"{name}.lock", os.O_CREAT | os.O_RDWR, 0o644)
                fcntl.flock(handle, fcntl.LOCK_EX)
                _LOCKED.add(name)
        yield
    finally:
        if handle is not None:
            _LOCKED.discard(name)
            os.close(handle)
