"""Functions that numba compiles when they are first called: until then, numba is not even imported.

So what plans, or shows what is there, need not wait for it.
"""

from __future__ import annotations

import fcntl
import logging
import os
import pickle
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import update_wrapper
from pathlib import Path
from threading import RLock, Timer
from types import ModuleType
from typing import Any

_ONE_AT_A_TIME = RLock()
"""Held while kernels are put in their places, so that no thread calls one whose own kernels are not."""
_LOCKED: set[str] = set()
"""Names of the kernels that this process compiles alone, by the one thread that holds numba's lock."""
_SYMBOL_NUMBERS = iter(lambda: secrets.randbits(64), -1)
"""Numbers that make symbols of compiled code unique.

Numba counts from 1 in every process.  Two processes can then give different code the same symbol, and a third one that
loads both from the cache runs the wrong code or crashes (numba's issue 10486).
"""
_PATIENCE_S = 10.0
"""How long a process waits for another before it says so: few kernels take that long."""
_LOG = logging.getLogger(__name__)


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
            modules = [used_value.__dict__ for name in names if isinstance(used_value := used.get(name), ModuleType)]
            try:
                for place in (used, *modules):
                    kernels = {name: used_value for name in names if isinstance(used_value := place.get(name), _Kernel)}
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
    from numba import __version__, config, njit
    from numba.core.bytecode import FunctionIdentity
    from numba.core.caching import IndexDataCacheFile
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.types import unliteral

    if config.DISABLE_JIT:  # type: ignore[attr-defined]  # set when numba reads the environment
        return function
    FunctionIdentity._unique_ids = _SYMBOL_NUMBERS  # type: ignore[assignment]  # only `next` is called
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        made = njit(cache=True, **options)(function)
        base, stamp = made._cache._impl.filename_base, made._cache._cache_file._source_stamp
        # Files of its own for each version of numba: each would replace those of the other, and compile for minutes.
        # `unique`: files of before had symbols that were not.
        name = f"{base}-{__version__}-unique"
        files = made._cache._cache_file = IndexDataCacheFile(made.stats.cache_path, name, stamp)
    except RuntimeError:  # no folder that it may write to
        made, files = njit(**options)(function), None
    compile_anew = made.compile

    def compile_once(signature: tuple[Any, ...]) -> Any:
        arguments = tuple(unliteral(argument) for argument in signature)
        if arguments in made.overloads:
            return made.overloads[arguments].entry_point
        # Numba's own lock first: who waits for a file here holds all files that other threads may wait for.
        with global_compiler_lock, _alone(made.stats.cache_path, f"{function.__module__}.{function.__qualname__}"):
            if files is not None:
                _drop_old_code(files)
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
                _wait_for(handle, name)
                _LOCKED.add(name)
        yield
    finally:
        if handle is not None:
            _LOCKED.discard(name)
            os.close(handle)


def _wait_for(handle: int, name: str) -> None:
    """Lock a file, and say once who has locked it where that takes long: if that process is stopped, for ever."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        patience = Timer(_PATIENCE_S, _say_who, (handle, name))
        patience.daemon = True
        patience.start()
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
        finally:
            patience.cancel()
            patience.join()  # it may be reading the file, which is closed soon
    with suppress(OSError):  # a disk that is full
        os.ftruncate(handle, 0)
        os.pwrite(handle, str(os.getpid()).encode(), 0)


def _say_who(handle: int, name: str) -> None:
    number = os.pread(handle, 20, 0).decode()
    _LOG.warning(
        "waiting for %s, which compiles %s; if it is stopped, continue it (`fg`, or `kill -CONT`) or end it",
        *(f"process {number}" if number else "another process", name),
    )


def _drop_old_code(files: Any) -> None:
    """Remove what was compiled from other sources of a kernel before it is compiled anew.

    Numba replaces its index first, then the code that it names: after a kill between the two, or on a full disk, the
    index would name the old code.  An index that was cut off, or names a type that no longer exists, goes too.
    """
    with suppress(OSError):
        index = Path(files._index_path)
        try:
            is_current = bool(files._load_index())
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            index.unlink(missing_ok=True)
            is_current = False
        if not is_current:
            for old in index.parent.glob(f"{index.stem}.*.nbc"):
                old.unlink(missing_ok=True)
