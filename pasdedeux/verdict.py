"""Verdicts: is a result good, in one word, one sentence and one figure beside its trivial baseline."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

__all__ = ["Level", "Verdict", "summarise_verdicts"]


class Level(StrEnum):
    """How good a result is."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


_ORDER = tuple(Level)
_SHARE = re.compile(r"^\d+ of \d+: ")


@dataclass(frozen=True)
class Verdict:
    """What is thought of a result.

    Args:
        level: pass, warn or fail.
        reason: Why, in words; empty where it passes and there is nothing to say.
        figure: Name of the one figure that matters, as people say it ("contact drift"); empty without one.
        value: That figure; NaN without one.
        unit: Its unit.
        baseline: The same figure of the trivial way to do it; NaN without one.
        baseline_name: What that trivial way is ("plain forward kinematics").
        count: How many results this stands for.

    Raises:
        ValueError: Something other than pass has no reason.
    """

    level: Level
    reason: str = ""
    figure: str = ""
    value: float = math.nan
    unit: str = ""
    baseline: float = math.nan
    baseline_name: str = ""
    count: int = 1

    def __post_init__(self) -> None:
        """Refuse a warning or a failure without a reason."""
        if self.level is not Level.PASS and not self.reason:
            raise ValueError(f"a verdict '{self.level}' needs a reason")

    def to_json(self) -> dict[str, Any]:
        """Return the verdict as JSON values; a figure that is not finite becomes null."""
        numbers = {
            name: value if math.isfinite(value) else None
            for name, value in (("value", float(self.value)), ("baseline", float(self.baseline)))
        }
        words = {name: getattr(self, name) for name in ("reason", "figure", "unit", "baseline_name", "count")}
        return {"level": self.level.value, **words, **numbers}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Verdict:
        """Return the verdict that `to_json` wrote."""
        numbers = {name: math.nan if values[name] is None else values[name] for name in ("value", "baseline")}
        return cls(**{**values, **numbers, "level": Level(values["level"])})


def summarise_verdicts(verdicts: Iterable[Verdict]) -> Verdict | None:
    """Return one verdict over many: the worst level, how many share it and why, medians of figure and baseline.

    The reason is the most frequent one of the worst level.  None when there is no verdict.
    """
    found = list(verdicts)
    if len(found) < 2:
        return found[0] if found else None
    worst = max((verdict.level for verdict in found), key=_ORDER.index)
    total = sum(verdict.count for verdict in found)
    worst_ones = [verdict for verdict in found if verdict.level is worst]
    reasons = Counter(_SHARE.sub("", verdict.reason) for verdict in worst_ones if verdict.reason)
    reason = reasons.most_common(1)[0][0] if reasons else ""
    if worst is not Level.PASS:
        reason = f"{sum(verdict.count for verdict in worst_ones)} of {total}: {reason}"
    named = next((verdict for verdict in found if verdict.figure), found[0])
    alike = [verdict for verdict in found if verdict.figure == named.figure]
    return Verdict(
        level=worst,
        reason=reason,
        figure=named.figure,
        value=_median([verdict.value for verdict in alike]),
        unit=named.unit,
        baseline=_median([verdict.baseline for verdict in alike]),
        baseline_name=named.baseline_name,
        count=total,
    )


def _median(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan
