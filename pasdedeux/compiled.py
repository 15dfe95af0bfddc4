"""Kernels, which numba compiles on their first call. Numba is imported then too, so planning need not wait for it."""

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

from pasdedeux.garbage import uncollected

_ONE_AT_A_TIME = RLock()
"""Held while kernels replace their declarations, so that no thread calls a kernel before those that it calls."""
_LOCKED: set[str] = set()
"""Names of the kernels that this process compiles alone, by the one thread that holds numba's lock."""
_SYMBOL_NUMBERS = iter(lambda: secrets.randbits(64), -1)
"""Numbers that make symbols of compiled code unique.

Numba counts from 1 in every process.  Two processes can then give different code the same symbol, and a third one that
loads both from the cache runs the wrong code or crashes (numba's issue 10486).
"""
_PATIENCE_S = 10.0
"""A process that waits longer for another logs a message; few kernels take so long to compile."""
_LOG = logging.getLogger(__name__)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of kernels: `numba.njit` with these options, cached on disk and without the GIL.

    Division by zero gives infinity or NaN, as numpy's does.  A kernel may call itself, but with arguments of the same
    types: numba crashes when it loads another from the cache.
    """
    return lambda function: _Kernel(function, options)


def inner_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of functions that only kernels call; small ones compile three times as fast.

    Never call them from Python: the process would crash.
    """
    return compiled(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def intrinsic(function: Callable[..., Any]) -> _Kernel:
    """Declare an intrinsic, written in LLVM IR, that kernels may call: `numba.extending.intrinsic`."""
    return _Intrinsic(function, {})


class _Kernel:
    """A function that is compiled on its first call, after the kernels that it calls.

    Kernels named only inside a comprehension are not found.
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
        """Hand the function to numba, and put compiled kernels in place of those that it calls."""
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
    """An intrinsic: only kernels can call it."""

    def _make(self) -> Any:
        if self._begun is None:
            from numba.extending import intrinsic

            self._begun = intrinsic(self._function)
        return self._begun


def _compiled_once(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return a function that numba compiles once for each signature.

    Left alone, numba compiles again for each constant that a kernel passes, and in every process that asks at the same
    time. Here one process compiles; the others wait and load. Without a writable cache, each process compiles.
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
        dispatcher = njit(cache=True, **options)(function)
        base, stamp = dispatcher._cache._impl.filename_base, dispatcher._cache._cache_file._source_stamp
        # Each version of numba has its own files; with shared ones, two versions would recompile in turns, for minutes.
        # `unique`: symbols in older files were not unique.
        name = f"{base}-{__version__}-unique"
        files = dispatcher._cache._cache_file = IndexDataCacheFile(dispatcher.stats.cache_path, name, stamp)
    except RuntimeError:  # there is no writable folder
        dispatcher, files = njit(**options)(function), None
    compile_anew = dispatcher.compile

    def compile_once(signature: tuple[Any, ...]) -> Any:
        arguments = tuple(unliteral(argument) for argument in signature)
        if arguments in dispatcher.overloads:
            return dispatcher.overloads[arguments].entry_point
        # Take numba's lock first, so that no thread waits for a file while another holds it and waits for numba.
        with (
            global_compiler_lock,
            _alone(dispatcher.stats.cache_path, f"{function.__module__}.{function.__qualname__}"),
            uncollected(),
        ):
            if files is not None:
                _drop_old_code(files)
            try:
                return compile_anew(arguments)
            except OSError:  # the cache's disk is full or gone
                if arguments not in dispatcher.overloads:
                    raise
                return dispatcher.overloads[arguments].entry_point

    dispatcher.compile = compile_once
    return dispatcher


@contextmanager
def _alone(folder: str | None, name: str) -> Iterator[None]:
    """Hold this machine's lock on the kernel of this name, if the file system has locks.

    There are no deadlocks, since kernels call each other in one direction. A kernel that calls itself with other types
    holds its lock already.
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
    """Lock a file. After a long wait, log once which process holds it: if that one is stopped, the wait never ends."""
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
            patience.join()  # it may still be reading the file, which is closed next
    with suppress(OSError):  # the disk is full
        os.ftruncate(handle, 0)
        os.pwrite(handle, str(os.getpid()).encode(), 0)


def _say_who(handle: int, name: str) -> None:
    number = os.pread(handle, 20, 0).decode()
    _LOG.warning(
        "waiting for %s, which compiles %s; if it is stopped, continue it (`fg`, or `kill -CONT`) or end it",
        *(f"process {number}" if number else "another process", name),
    )


def _drop_old_code(files: Any) -> None:
    """Remove code that was compiled from older sources of a kernel.

    Numba replaces its index before the code that it names. A kill between the two, or a full disk, would leave an index
    that names old code. A truncated index, or one that names a type that no longer exists, is removed too.
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
