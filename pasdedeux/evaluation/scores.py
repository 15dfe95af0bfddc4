"""One measured figure, and small summaries of many."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Score", "columns_of", "summarise"]


@dataclass(frozen=True)
class Score:
    """One figure: what was measured, of which method, on what.

    Args:
        topic: coverage, density, lifting, views, chains, reconstruction, augmentation, models or takes.
        metric: Name of the measure.
        method: Method or density measured.
        value: The figure.
        unit: Its unit; empty for a ratio or a count.
        is_baseline: The method is a trivial baseline shown for comparison.
        split: Part of the data it is over.
        item: Take, sequence, variant or model it is of; `all` where it is over everything.
        at: Position on a curve; NaN for a single figure.
        count: Number of things the figure is over.
    """

    topic: str
    metric: str
    method: str
    value: float
    unit: str = ""
    is_baseline: bool = False
    split: str = "all"
    item: str = "all"
    at: float = float("nan")
    count: int = 1


def columns_of(scores: Iterable[Score]) -> dict[str, list[object]]:
    """Return scores as columns of the `scores` table, sorted so that the same figures always give the same bytes."""
    rows = sorted(scores, key=lambda s: (s.topic, s.metric, s.method, s.split, s.item, np.nan_to_num(s.at, nan=-1.0)))
    names = ("topic", "metric", "method", "is_baseline", "split", "item", "at", "value", "unit", "count")
    return {name: [getattr(row, name) for row in rows] for name in names}


def summarise(
    values: npt.NDArray[np.float64],
    *,
    topic: str,
    metric: str,
    method: str,
    unit: str,
    is_baseline: bool = False,
    split: str = "all",
    item: str = "all",
) -> list[Score]:
    """Return mean, median and 90th percentile of `values` (n,) as scores `<metric>_mean`, `_median`, `_p90`.

    Values that are not finite are left out; none left gives no score.
    """
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return []
    figures = {"mean": finite.mean(), "median": np.median(finite), "p90": np.percentile(finite, 90)}
    return [
        Score(
            topic=topic,
            metric=f"{metric}_{name}",
            method=method,
            value=float(value),
            unit=unit,
            is_baseline=is_baseline,
            split=split,
            item=item,
            count=int(finite.size),
        )
        for name, value in figures.items()
    ]
