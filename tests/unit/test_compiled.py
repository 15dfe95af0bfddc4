"""Kernels: numba compiles them when they are first called, and sees the kernels that they call."""

from __future__ import annotations

import fcntl
import gc
import importlib.util
import os
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from threading import Barrier, Event
from typing import Any

import numba
import numpy as np
import pytest
from numba import config
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import TypingError

from pasdedeux import compiled as compiling
from pasdedeux.compiled import compiled
from tests.builders.toy_runs import wait_until


@compiled()
def twice(value: float) -> float:
    """Return twice the value."""
    return 2.0 * value


@compiled(inline="always")
def one_more(value: float) -> float:
    return value + 1.0


@compiled()
def total(values: np.ndarray) -> float:
    total_value = 0.0
    for value in values:
        total_value += one_more(twice(value))
    return total_value


@compiled()
def half(value: float) -> float:
    return 0.5 * value


@compiled()
def quarter(value: float) -> float:
    return half(half(value))


@compiled()
def third(value: float) -> float:
    return value / 3.0


@compiled()
def ninth(value: float) -> float:
    return third(third(value))


@compiled()
def factorial(number: int) -> int:
    return 1 if number < 2 else number * factorial(number - 1)


@compiled()
def halvings(number: float) -> int:
    if number <= 1:
        return 0
    return 1 + halvings(number / 2)


@compiled()
def power(base: int, exponent: int) -> int:
    return base**exponent


@compiled()
def powers(base: int) -> int:
    return power(base, 1) + power(base, 2) + power(3, 3) + power(base, base)


def test_a_kernel_calls_kernels_inlines_them_and_calls_itself() -> None:
    values = np.linspace(-1.0, 1.0, 5)
    assert total(values) == total(values=values) == 5.0
    assert factorial(10) == 3628800
    assert twice(3) == 6.0  # also once it is known to have been called by another


@pytest.mark.usefixtures("_new_cache")  # loaded from a cache, it crashes
def test_a_kernel_that_calls_itself_with_another_type_does_not_wait_for_itself() -> None:
    assert halvings(8) == 3


def test_a_kernel_is_compiled_once_whatever_constants_others_pass() -> None:
    assert powers(2) == 2 + 4 + 27 + 4
    powers._made.recompile()  # what was loaded from the cache asked for nothing
    assert len(power.overloads) == 1  # its place was taken by what numba made


def test_kernels_run_as_python_where_numba_is_told_not_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "DISABLE_JIT", 1)
    assert compiled()(lambda value: value / 3.0)(9.0) == 3.0


def test_a_kernel_keeps_its_name_and_docstring() -> None:
    assert (twice.__name__, twice.__doc__) == ("twice", "Return twice the value.")


def test_kernels_may_be_called_first_by_many_threads_at_once() -> None:
    barrier = Barrier(4)

    def call(number: float) -> float:
        barrier.wait()
        return float(quarter(number))

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(call, [4.0, 8.0, 12.0, 16.0])) == [1.0, 2.0, 3.0, 4.0]


def test_a_first_call_that_is_interrupted_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(type(third), "_make", interrupted(type(third)._make))
        with pytest.raises(KeyboardInterrupt):
            ninth(9.0)
    assert ninth(9.0) == pytest.approx(1.0)


def interrupted(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def made(kernel: Any) -> Any:
        if kernel is third:
            raise KeyboardInterrupt
        return make(kernel)

    return made


def kernel(folder: Path, factor: float = 2.0) -> Any:
    """Return a kernel, not compiled in this process, that multiplies by a factor."""
    path = folder / "scaling.py"
    path.write_text(f"from pasdedeux.compiled import compiled\n\n@compiled()\ndef scale(x):\n    return {factor} * x\n")
    spec = importlib.util.spec_from_file_location("scaling", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.scale


@pytest.fixture
def _new_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let numba keep its code in a folder of the test."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))


def num_hits(scale: Any) -> int:
    return sum(scale._made.stats.cache_hits.values())


@pytest.mark.usefixtures("_new_cache")
@pytest.mark.parametrize("is_killed", [False, True])
def test_old_code_is_never_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_killed: bool) -> None:
    """Numba renews its index before the code: a full disk, or a kill, may leave one without the other."""
    assert kernel(tmp_path)(3.0) == 6.0
    with monkeypatch.context() as broken:
        broken.setattr(IndexDataCacheFile, "_save_data", (lambda *_: None) if is_killed else refuse)
        assert kernel(tmp_path, 20.0)(3.0) == 60.0
    for hits in (0, 1):
        again = kernel(tmp_path, 20.0)
        assert (again(3.0), num_hits(again)) == (60.0, hits)


@pytest.mark.parametrize("is_on", [True, False])
def test_the_garbage_collector_pauses_while_a_kernel_compiles_and_is_then_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_on: bool
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    scale, seen = kernel(tmp_path), list[bool]()
    monkeypatch.setattr(compiling, "_drop_old_code", lambda _: seen.append(gc.isenabled()))
    try:
        gc.enable() if is_on else gc.disable()
        for argument in (3.0, "three"):  # text cannot be multiplied by a number: compiling fails
            with suppress(TypingError):
                scale(argument)
        assert gc.isenabled() == is_on
    finally:
        gc.enable()
    assert seen == [False, False]


def refuse(*_: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.usefixtures("_new_cache")
@pytest.mark.parametrize(
    "overloads", [b"cpasdedeux.compiled\nRenamed\n.", b"cpasdedeux.removed\nGone\n.", b"", b"\x80\x04K"]
)
def test_an_index_that_is_cut_off_or_names_a_type_that_is_gone_is_made_anew(tmp_path: Path, overloads: bytes) -> None:
    scale = kernel(tmp_path)
    assert scale(3.0) == 6.0
    files = scale._made._cache._cache_file
    Path(files._index_path).write_bytes(pickle.dumps(files._version) + overloads)
    for hits in (0, 1):
        again = kernel(tmp_path)
        assert (again(3.0), num_hits(again)) == (6.0, hits)


@pytest.mark.usefixtures("_new_cache")
def test_two_versions_of_numba_share_a_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = numba.__version__
    for version, hits in ((here, 0), ("0.1", 0), (here, 1), ("0.1", 1)):
        monkeypatch.setattr(numba, "__version__", version)
        scale = kernel(tmp_path)
        assert (scale(3.0), num_hits(scale)) == (6.0, hits)


@pytest.mark.usefixtures("_new_cache")
@pytest.mark.parametrize(("holder", "named"), [("4711", "process 4711"), ("", "another process")])
def test_who_waits_long_for_another_process_says_for_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, holder: str, named: str
) -> None:
    monkeypatch.setattr(compiling, "_PATIENCE_S", 0.02)
    assert kernel(tmp_path)(3.0) == 6.0
    (lock,) = (tmp_path / "cache").rglob("*.lock")
    assert lock.read_text() == str(os.getpid())
    with lock.open("r+") as held, ThreadPoolExecutor(1) as pool:
        fcntl.flock(held, fcntl.LOCK_EX)
        lock.write_text(holder)
        answer = pool.submit(kernel(tmp_path), 4.0)
        try:
            wait_until(lambda: bool(caplog.messages), "a message")
        finally:
            fcntl.flock(held, fcntl.LOCK_UN)
        assert answer.result() == 8.0
    assert caplog.messages == [
        f"waiting for {named}, which compiles scaling.scale; if it is stopped, continue it (`fg`, or `kill -CONT`) or "
        "end it"
    ]


def test_a_lock_stays_open_until_its_holder_was_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the number of a process would be read from whatever file was opened next."""
    begun, may_read, sizes = Event(), Event(), list[int]()

    def say(handle: int, _: str) -> None:
        begun.set()
        may_read.wait()
        sizes.append(os.fstat(handle).st_size)

    monkeypatch.setattr(compiling, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(compiling, "_say_who", say)
    with (tmp_path / "scale.lock").open("w") as held, ThreadPoolExecutor(1) as pool:
        fcntl.flock(held, fcntl.LOCK_EX)
        closed = pool.submit(lock_once, tmp_path)
        assert begun.wait(60.0)
        fcntl.flock(held, fcntl.LOCK_UN)
        wait([closed], 0.1)
        may_read.set()
        closed.result()
    assert len(sizes) == 1


def lock_once(folder: Path) -> None:
    with compiling._alone(str(folder), "scale"):
        pass
