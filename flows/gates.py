"""Quality gates of a study: what has to hold of its scores and verdicts before a run of it is published."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from operator import ge, gt, le, lt
from typing import Any, NamedTuple

from pydantic import Field, field_validator

from pasdedeux.settings import Settings
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store
from tasks.graph import Graph
from tasks.stage import verdict_of

__all__ = ["Figure", "Figures", "Gate", "PublishSettings", "figures_of"]

_SCORE = re.compile(
    r"(?P<topic>\w+)\.(?P<metric>\w+)\.(?P<method>[^\[<>=]+?)\s*(\[(?P<part>[^\]]+)\])?\s*"
    r"(?P<sign><=|>=|<|>)\s*(?P<limit>[-+.\deE]+)\s*(?P<unit>[a-zA-Z%]*)"
)
_VERDICT = re.compile(r"verdict\.(?P<stage>\w+)(\.(?P<partition>[^<>=]+?))?\s*<=\s*(?P<worst>\w+)")
_HOW = (
    "a gate is TOPIC.METRIC.METHOD <= NUMBER UNIT, with [PART] after the method for one split or item, "
    "or verdict.STAGE.PARTITION <= pass or warn"
)
_SIGNS: Mapping[str, Callable[[float, float], bool]] = {"<=": le, ">=": ge, "<": lt, ">": gt}
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_LEVELS = tuple(Level)


class Figure(NamedTuple):
    """What a figure of the table `scores` is of; `at` is None where it is no point of a curve."""

    topic: str
    metric: str
    method: str
    split: str
    item: str
    at: float | None

    @property
    def place(self) -> str:
        """Return split and item as far as they say something."""
        return " ".join(word for word in (self.split, self.item) if word != "all") or "all"


Figures = Mapping[Figure, tuple[float | None, str]]
"""Value and unit of figures; NaN, of which JSON knows nothing, is None."""


def figures_of(store: Store, manifests: Iterable[Manifest]) -> Figures:
    """Return the scores among these artifacts."""
    found: dict[Figure, tuple[float | None, str]] = {}
    for manifest in manifests:
        if "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores", columns=[*Figure._fields, "value", "unit"])
            columns = [[_plain(value) for value in table[name]] for name in Figure._fields]
            for *name, value, unit in zip(*columns, table["value"], table["unit"], strict=True):
                found[Figure(*name)] = (_plain(value), unit)
    return found


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Gate:
    """One condition: on every single figure of a method by a metric, or on every verdict of a stage (`topic` empty).

    Args:
        text: As the study says it.
        topic: Topic of the scores.
        metric: Metric of the scores.
        method: Method of the scores.
        part: Split or item that is meant; all where empty.
        sign: How figure and limit are compared.
        limit: The limit, in `unit`.
        unit: Unit of the limit; that of the scores where empty.
        stage: Stage whose verdicts are meant.
        partition: Partition of it; all where empty.
        worst: The worst verdict that is let through.
    """

    text: str
    topic: str = ""
    metric: str = ""
    method: str = ""
    part: str = ""
    sign: str = "<="
    limit: float = math.nan
    unit: str = ""
    stage: str = ""
    partition: str = ""
    worst: Level = Level.PASS

    @classmethod
    def parse(cls, text: str) -> Gate:
        """Read a gate; ValueError where it is none."""
        verdict = _VERDICT.fullmatch(text.strip())
        if verdict is not None:
            if verdict["worst"] not in (Level.PASS, Level.WARN):
                raise ValueError(f"'{text}': a verdict is at most pass or warn, everything is at most fail")
            return cls(
                text, stage=verdict["stage"], partition=verdict["partition"] or "", worst=Level(verdict["worst"])
            )
        score = _SCORE.fullmatch(text.strip())
        if score is None:
            raise ValueError(f"'{text}' is no gate: {_HOW}")
        try:
            limit = float(score["limit"])
        except ValueError:
            raise ValueError(f"'{text}': {score['limit']} is no number") from None
        what = (score["topic"], score["metric"], score["method"], score["part"] or "")
        return cls(text, *what, sign=score["sign"], limit=limit, unit=score["unit"])

    def problem(self, graph: Graph) -> str:
        """Say why the stages of this graph cannot answer the gate, and what they can; empty where they can."""
        if self.stage:
            return "" if self.stage in graph.names else f"no stage '{self.stage}'; stages: {', '.join(graph.names)}"
        metrics = {topic: known for stage in graph.stages for topic, known in stage.metrics.items() if known}
        if not metrics:
            return "no stage of the study writes scores"
        if self.topic not in metrics:
            return f"no topic '{self.topic}' has scores; topics: {', '.join(metrics)}"
        if not any(fnmatch(self.metric, known) for known in metrics[self.topic]):
            return f"topic {self.topic} has no metric '{self.metric}'; metrics: {', '.join(metrics[self.topic])}"
        return ""

    def failure(self, manifests: Sequence[Manifest], figures: Figures) -> str:
        """Say with the figure why the gate does not hold of these artifacts and their scores; empty where it does."""
        found = self._of_verdicts(manifests) if self.stage else self._of_scores(figures)
        return found and f"{self.text}: {found}"

    def _of_verdicts(self, manifests: Sequence[Manifest]) -> str:
        judged = [
            (verdict, manifest)
            for manifest in manifests
            if manifest.ref.stage == self.stage and self.partition in ("", manifest.partition)
            if (verdict := verdict_of(manifest)) is not None
        ]
        if not judged:
            return "there is no such verdict"
        verdict, manifest = max(judged, key=lambda one: _LEVELS.index(one[0].level))
        if _LEVELS.index(verdict.level) <= _LEVELS.index(self.worst):
            return ""
        return f"{manifest.partition} {manifest.name} is {verdict.level.value}, {verdict.reason}"

    def _of_scores(self, figures: Figures) -> str:
        mine = [name for name in figures if (name.topic, name.metric, name.at) == (self.topic, self.metric, None)]
        named = [one for one in mine if one.method == self.method and self.part in ("", one.split, one.item)]
        if not named:
            parts = {part for one in mine if one.method == self.method for part in (one.split, one.item)}
            there = parts or {one.method for one in mine}
            kind = "parts" if parts else "methods"
            return "there is no such figure" + (f"; {kind}: {', '.join(sorted(there))}" if there else "")
        for one in named:
            value, unit = figures[one]
            if value is None:
                return f"it is not a number ({one.place})"
            if self.unit not in ("", unit):
                if not {self.unit, unit} <= set(_METRES):
                    return f"the figure is in {unit or 'no unit'} ({one.place})"
                value = round(value * _METRES[unit] / _METRES[self.unit], 9)
            if not _SIGNS[self.sign](value, self.limit):
                return f"it is {value:.4g} {self.unit or unit}".rstrip() + f" ({one.place})"
        return ""


class PublishSettings(Settings):
    """The `[publish]` section: a run of the whole study becomes a version of a dataset where all gates hold."""

    name: str | None = Field(
        None, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="Name of the dataset; the study's when not given"
    )
    gates: tuple[str, ...] = Field(
        (),
        description="What has to hold: 'TOPIC.METRIC.METHOD <= NUMBER UNIT' of every split and item, [PART] after the "
        "method for one; 'verdict.STAGE <= warn' of every partition, .PARTITION after the stage for one",
    )

    @field_validator("gates")
    @classmethod
    def _check_gates(cls, gates: tuple[str, ...]) -> tuple[str, ...]:
        for gate in gates:
            Gate.parse(gate)
        return gates

    @property
    def parsed(self) -> tuple[Gate, ...]:
        """Return the gates."""
        return tuple(map(Gate.parse, self.gates))
