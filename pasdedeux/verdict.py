"""Verdicts: whether a result is good, in one word, one sentence and one figure beside its baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Level(StrEnum):
    """Levels from best to worst; too little data to judge is not a pass."""

    PASS = "pass"
    NOT_JUDGED = "not judged"
    WARN = "warn"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """Its rank among levels: the worst has the highest."""
        return list(Level).index(self)


@dataclass(frozen=True)
class Paired:
    """Errors of a method and its baselines on the same items, as sums over blocks of 1 s of a take.

    Args:
        method: The method.
        baselines: The methods that it is compared with.
        count: Number of things that the items belong to, such as variants, each of many frames.
        takes: Take of each block.
        seconds: Its second within the take.
        sizes: Number of items in each block.
        sums: Sums over these items, by method and baseline.
        is_larger_better: True for shares, False for errors.
    """

    method: str
    baselines: tuple[str, ...]
    count: int
    takes: tuple[str, ...]
    seconds: tuple[int, ...]
    sizes: tuple[int, ...]
    sums: Mapping[str, tuple[float, ...]]
    is_larger_better: bool = False

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Paired:
        """Return the instance from the JSON of its `dataclasses.asdict`."""
        rows: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        return cls(**{**rows, "sums": {name: tuple(sums) for name, sums in values["sums"].items()}})


@dataclass(frozen=True)
class Verdict:
    """A verdict on a result.

    Args:
        level: pass, not judged, warn or fail.
        reason: The reason, in words; may be empty for a pass.
        figure: Name of the one figure that matters, in words ("contact drift"); empty if there is none.
        value: That figure, or its mean over several things; NaN if there is none.
        unit: Its unit.
        baseline: The same figure of the baseline; NaN if there is none.
        baseline_name: Name of the baseline ("plain forward kinematics").
        count: Number of things that the figure covers.
        thing: Their name in the plural ("variants").
        tally: For a verdict on several results: levels, reasons, and the number of results with each.
        paired: Evidence for the level, if methods were compared on the same items.

    Raises:
        ValueError: A level other than pass has no reason.
    """

    level: Level
    reason: str = ""
    figure: str = ""
    value: float = math.nan
    unit: str = ""
    baseline: float = math.nan
    baseline_name: str = ""
    count: int = 1
    thing: str = "results"
    tally: tuple[tuple[Level, str, int], ...] = ()
    paired: Paired | None = None

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
        words = {name: getattr(self, name) for name in ("reason", "figure", "unit", "baseline_name", "count", "thing")}
        tally = {"tally": [[level.value, reason, count] for level, reason, count in self.tally]} if self.tally else {}
        paired = {} if self.paired is None else {"paired": asdict(self.paired)}
        return {"level": self.level.value, **words, **numbers, **tally, **paired}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Verdict:
        """Return the verdict that `to_json` wrote."""
        numbers = {name: math.nan if values[name] is None else values[name] for name in ("value", "baseline")}
        tally = tuple((Level(level), reason, count) for level, reason, count in values.get("tally", ()))
        paired = Paired.from_json(values["paired"]) if "paired" in values else None
        return cls(**{**values, **numbers, "level": Level(values["level"]), "tally": tally, "paired": paired})
