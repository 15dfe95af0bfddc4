"""One measured figure, and small summaries of many."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

COLUMNS = ("metric", "method", "is_baseline", "split", "item", "at", "value", "unit", "count", "low", "high")
"""Columns of the `scores` table beside `topic`, the topic that measured."""

_NUM_DRAWS = 1000
FEWEST_UNITS = 5
"""Fewest takes, or other units of resampling, for an interval: two similar ones would give a false certainty."""


@dataclass(frozen=True)
class Score:
    """One figure of a topic: a metric of a method on some data.

    Args:
        metric: Name of the measure.
        method: Method or density measured.
        value: The figure.
        unit: Its unit; empty for a ratio or a count.
        is_baseline: The method is a baseline.
        split: Part of the data it is over.
        item: Take, sequence, variant or model it is of; `all` where it is over everything.
        at: Position on a curve; NaN for a single figure.
        count: Number of things the figure is over.
        low: Lower end of its interval; NaN where none was estimated.
        high: Upper end.
    """

    metric: str
    method: str
    value: float
    unit: str = ""
    is_baseline: bool = False
    split: str = "all"
    item: str = "all"
    at: float = float("nan")
    count: int = 1
    low: float = float("nan")
    high: float = float("nan")


def weighted_mean(values: Iterable[tuple[float, float]]) -> float:
    """Return the mean of values weighted by counts, without NaN; NaN if there is none.

    >>> weighted_mean([(1.0, 3), (5.0, 1)])
    2.0
    """
    known = [(value, count) for value, count in values if math.isfinite(value)]
    total = sum(count for _, count in known)
    return math.fsum(value * count for value, count in known) / total if total else math.nan


def columns_of(topic: str, scores: Iterable[Score], baselines: Collection[str] = ()) -> dict[str, list[object]]:
    """Return scores as columns of the `scores` table, sorted so that the same figures always give the same bytes.

    Methods among the baselines are marked as such.
    """
    marked = (replace(score, is_baseline=True) if score.method in baselines else score for score in scores)
    rows = sorted(marked, key=lambda s: (s.metric, s.method, s.split, s.item, np.nan_to_num(s.at, nan=-1.0)))
    return {"topic": [topic] * len(rows), **{name: [getattr(row, name) for row in rows] for name in COLUMNS}}


def bootstrap_interval(
    values: npt.NDArray[np.float64],
    over: npt.NDArray[np.float64] | None = None,
    *,
    units: Sequence[str] | None = None,
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean of values (n,), from 1000 resamples; NaN of fewer than two.

    With `over` (n,), values of the same items, it is the interval of the ratio of both means. With `units` (n,), such
    as takes, whole units are resampled, because values of one unit are alike; NaN of fewer than `FEWEST_UNITS`.

    The percentile bootstrap (Efron 1979), with draws that are always the same.

    >>> bootstrap_interval(np.array([1.0, 1.0, 1.0]))
    (1.0, 1.0)
    """
    unit = np.arange(len(values)) if units is None else np.unique(np.asarray(units), return_inverse=True)[1]
    count = np.bincount(unit)
    if len(count) < (2 if units is None else FEWEST_UNITS):
        return float("nan"), float("nan")
    drawn = np.random.default_rng(0).integers(len(count), size=(_NUM_DRAWS, len(count)))
    others = np.ones(len(values)) if over is None else over
    total, beside = (np.bincount(unit, weights)[drawn].sum(axis=1) for weights in (values, others))
    means = total / np.maximum(beside, 1e-12)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def scores_of(figures: Mapping[str, float], method: str, unit: str = "", **more: Any) -> list[Score]:
    """Return the figures of a method by metric, with further fields of a score (split, item, count)."""
    return [Score(metric, method, float(value), unit, **more) for metric, value in figures.items()]


def summarise(values: Mapping[str, npt.NDArray[np.float64]], metric: str, unit: str = "", **more: Any) -> list[Score]:
    """Return mean, median and 90th percentile of values (n,) by method, as scores `<metric>_mean`, `_median`, `_p90`.

    Values that are not finite do not count; a method without finite values has no score.  Further fields of a
    score, such as split and item, are passed on.
    """
    scores = []
    for method, measured in values.items():
        finite = np.asarray(measured, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        if finite.size:
            figures = {"mean": finite.mean(), "median": np.median(finite), "p90": np.percentile(finite, 90)}
            named = {f"{metric}_{name}": value for name, value in figures.items()}
            scores += scores_of(named, method, unit, count=int(finite.size), **more)
    return scores
