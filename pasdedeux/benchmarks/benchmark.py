"""What a benchmark reports: work per second of the fast form and of its plain baseline, measured in the same run.

A module here offers `BENCHMARKS` by name: functions that make inputs and return a `BenchmarkResult` of a name, what is
counted, the fast form, the plain form, each with its rate as `rate` gives it, and the sizes of the inputs in words.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

from pasdedeux.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class BenchmarkResult:
    """Throughput of a fast form beside its plain one.

    Args:
        name: What was measured.
        unit: What is counted: `pose pairs`, `frames`, `likelihoods`.
        fast_name: The form that ships.
        fast_per_s: Its work per second.
        plain_name: The baseline.
        plain_per_s: The baseline's work per second.
        note: Sizes of the problem, in words.

    Raises:
        InputError: A rate is not positive.
    """

    name: str
    unit: str
    fast_name: str
    fast_per_s: float
    plain_name: str
    plain_per_s: float
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse rates that are not positive."""
        if not (self.fast_per_s > 0 and self.plain_per_s > 0):
            raise InputError(f"benchmark {self.name}: rates are {self.fast_per_s} and {self.plain_per_s}, not positive")

    @property
    def ratio(self) -> float:
        """How many times faster the fast form is."""
        return self.fast_per_s / self.plain_per_s


def measure_rate(work: Callable[[], object], *, count: int = 1, min_s: float = 0.3, repeats: int = 3) -> float:
    """Return the work done per second of processor time, the best of some repeats.

    The first call, which may compile, is not timed.  Time that the process waited for a busy machine does not count.

    Args:
        work: Does `count` pieces of work per call.
        count: Pieces of work in a call.
        min_s: Least time of one repeat, seconds.
        repeats: Repeats, of which the best counts: what else the machine does only slows work down.
    """
    work()
    best = 0.0
    for _ in range(repeats):
        calls = 0
        started = time.process_time()
        while (elapsed := time.process_time() - started) < min_s or calls == 0:
            work()
            calls += 1
        elapsed = time.process_time() - started
        best = max(best, calls * count / elapsed)
    return best


def rate(name: str, work: Callable[[], object], *, count: int = 1, repeats: int = 3) -> tuple[str, float]:
    """Return the name of a form and its rate, of `count` pieces of work a call."""
    return name, measure_rate(work, count=count, repeats=repeats)


def in_turn(work: Callable[[T], object], inputs: Iterable[T]) -> Callable[[], object]:
    """Return work on one input after another, from the first again after the last."""
    turns = itertools.cycle(inputs)
    return lambda: work(next(turns))
