"""The result of a benchmark: work per second of the fast form and of its plain baseline, measured in the same run.

A module offers benchmarks as `BENCHMARKS: dict[str, Callable[[], BenchmarkResult]]`, each of the form
`BenchmarkResult(name, unit, *measure_rate(fast form), *measure_rate(plain form), note)`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

T = TypeVar("T")

_MIN_S = 0.3
"""Shortest repeat, seconds."""


@dataclass(frozen=True)
class BenchmarkResult:
    """Throughput of a fast form and of its plain baseline.

    Args:
        name: Name of the benchmark.
        unit: Unit of the work: `pose pairs`, `frames`, `likelihoods`.
        fast_name: The form that ships.
        fast_per_s: Its work per second.
        plain_name: The baseline.
        plain_per_s: The baseline's work per second.
        note: Sizes of the problem, in words.
    """

    name: str
    unit: str
    fast_name: str
    fast_per_s: float
    plain_name: str
    plain_per_s: float
    note: str = ""

    @property
    def ratio(self) -> float:
        """Return the speed of the fast form relative to the plain one."""
        return self.fast_per_s / self.plain_per_s


class Rate(NamedTuple):
    """A form of the work, and its rate per second."""

    name: str
    per_s: float


def measure_rate(name: str, work: Callable[[], object], *, count: int = 1, repeats: int = 3) -> Rate:
    """Return the rate of the work per second of processor time, the best of several repeats of 0.3 s or more.

    The first call, which may compile, is not timed.  Waiting for a busy machine does not count.

    Args:
        name: Name of the form.
        work: Does `count` pieces of work per call.
        count: Pieces of work in a call.
        repeats: Repeats, of which the best counts: what else the machine does only slows work down.
    """
    work()
    best = 0.0
    for _ in range(repeats):
        calls = 0
        started = time.process_time()
        while (elapsed := time.process_time() - started) < _MIN_S or calls == 0:
            work()
            calls += 1
        elapsed = time.process_time() - started
        best = max(best, calls * count / elapsed)
    return Rate(name, best)


def in_turn(work: Callable[[T], object], inputs: Iterable[T], *, count: int = 1) -> Callable[[], object]:
    """Return a function that does the work on the next `count` inputs, in a cycle."""
    turns = itertools.cycle(inputs)
    return lambda: [work(next(turns)) for _ in range(count)]
