"""Signals that end a process: Ctrl-C, SIGTERM and SIGHUP."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGTERM, signal.SIGHUP)
"""Signals by which job schedulers, containers, services and closed terminals end a process."""


_is_ending = threading.Event()
"""Set when one of these came. Handlers alone do not tell, because Prefect restores those from before its flow."""


@contextmanager
def ended_as_by_ctrl_c() -> Iterator[None]:
    """Treat SIGTERM and SIGHUP like Ctrl-C in this block, unless one is ignored, as under `nohup`.

    They often come together, so further ones are ignored, also after this block: a second one must not interrupt the
    clean-up of the first.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in ENDING}
    taken = [number for number, handler in before.items() if handler == signal.SIG_DFL]

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in taken:
            signal.signal(number, signal.SIG_IGN)
        if not _is_ending.is_set():
            _is_ending.set()
            raise KeyboardInterrupt

    _is_ending.clear()
    for number in taken:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_IGN if _is_ending.is_set() else before[number])


@contextmanager
def remembered_ctrl_c(*, is_passed_on: bool) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C, SIGTERM or SIGHUP came in this block.

    A second Ctrl-C acts as without this block; after one of the other signals they are ignored, also after this block.

    Args:
        is_passed_on: Whether the first one also raises KeyboardInterrupt. It is lost if it arrives in a finalizer, such
            as that of a future of Dask, so it alone would not end the work.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDING)}
    # An ignored signal, such as Ctrl-C in the background of a shell, stays ignored. SIGTERM and SIGHUP are handled
    # only below the command line, which has handlers for them.
    taken = [number for number, handler in before.items() if callable(handler)]
    if not is_passed_on and signal.SIGINT not in taken:
        taken.append(signal.SIGINT)
    is_asked = threading.Event()

    def remember(number: int, _frame: FrameType | None) -> None:
        is_asked.set()
        if number != signal.SIGINT:
            _is_ending.set()
        for other in taken:
            signal.signal(other, before[other] if number == signal.SIGINT else signal.SIG_IGN)
        if number != signal.SIGINT and signal.SIGINT in taken:
            signal.signal(signal.SIGINT, before[signal.SIGINT])
        if is_passed_on:
            raise KeyboardInterrupt

    for number in taken:
        signal.signal(number, remember)
    try:
        yield is_asked.is_set
    finally:
        for number in taken:
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, before[number])
