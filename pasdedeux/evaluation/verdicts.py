"""Is it good: a topic's one figure beside the trivial way to do it, and verdicts as rows for people and programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.evaluation.report import TextTable
from pasdedeux.evaluation.score_tables import format_value
from pasdedeux.evaluation.scores import Score
from pasdedeux.verdict import Level, Verdict, summarise_verdicts

__all__ = ["Judged", "Yardstick", "by_stage", "verdict_columns", "verdict_line", "verdict_table"]

_CLEARLY = 0.05
"""A method is better or worse than a baseline where it differs by more than this share of the baseline's figure."""


@dataclass(frozen=True)
class Yardstick:
    """The figure that says whether a topic's result is good, and what it has to beat.

    Args:
        metric: Metric of the scores.
        figure: What it is, as people say it.
        baselines: Methods that are the trivial ways; the best of those that were scored is what has to be beaten.
        methods: What has to beat it: the first of these that was scored; where none is named, the best method that is
            no baseline.
        is_larger_better: For shares and areas; errors are better smaller.
        chance: What doing nothing, or guessing, gives where no method stands for it; NaN where one does.
        chance_name: What that is.
    """

    metric: str
    figure: str
    baselines: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    is_larger_better: bool = False
    chance: float = math.nan
    chance_name: str = ""

    def verdict(self, scores: Iterable[Score]) -> Verdict | None:
        """Return the verdict on these scores: pass where clearly better, fail where clearly worse, warn in between.

        Figures are means over the parts and items that both have.  None where the metric, a method or a baseline is
        not among the scores.
        """
        found: dict[str, dict[tuple[str, str], float]] = {}
        unit, plain = "", set(self.baselines)
        for score in scores:
            if score.metric == self.metric and math.isnan(score.at) and math.isfinite(score.value):
                found.setdefault(score.method, {})[score.split, score.item] = score.value
                unit = score.unit
                plain |= {score.method} if score.is_baseline else set()
        named = [method for method in self.methods if method in found][:1]
        methods = named if self.methods else [method for method in found if method not in plain]
        baselines = [name for name in self.baselines if name in found]
        if not methods or not (baselines or math.isfinite(self.chance)):
            return None
        # Sorted: the mean of a set would depend on the order of its hashes.
        places = sorted(set.intersection(*(set(found[name]) for name in [*methods, *baselines])))
        if not places:
            return None
        sign = -1.0 if self.is_larger_better else 1.0
        mean = {name: float(np.mean([found[name][place] for place in places])) for name in [*methods, *baselines]}
        method = min(methods, key=lambda name: sign * mean[name])
        name = min(baselines, key=lambda name: sign * mean[name]) if baselines else self.chance_name
        value, baseline = mean[method], mean.get(name, self.chance)
        lead = sign * (baseline - value)
        level = (
            Level.PASS
            if lead > _CLEARLY * abs(baseline) or value == baseline == 0.0
            else Level.FAIL
            if lead < -_CLEARLY * abs(baseline)
            else Level.WARN
        )
        how = {
            Level.PASS: "better than" if lead else "without error, as",
            Level.WARN: "about as good as",
            Level.FAIL: "worse than",
        }[level]
        reason = f"{_words(method)} is {how} {_words(name)}"
        return Verdict(level, reason, self.figure, value, unit, baseline, _words(name))


@dataclass(frozen=True)
class Judged:
    """What is thought of a stage's partition, or of a topic of the evaluation."""

    stage: str
    partition: str
    verdict: Verdict


def verdict_columns(judged: Sequence[Judged]) -> dict[str, list[object]]:
    """Return verdicts as columns of the `verdicts` table, in the order of stage and partition."""
    rows = sorted(judged, key=lambda one: (one.stage, one.partition))
    names = ("level", "reason", "figure", "value", "unit", "baseline", "baseline_name", "count")
    return {
        "stage": [row.stage for row in rows],
        "partition": [row.partition for row in rows],
        **{name: [getattr(row.verdict, name) for row in rows] for name in names},
    }


def by_stage(judged: Sequence[Judged], *, apart: str) -> dict[str, Verdict]:
    """Return one verdict for each stage in order of appearance; partitions of stage `apart` each have their own."""
    groups: dict[str, list[Verdict]] = {}
    for one in judged:
        name = f"{one.stage}: {_words(one.partition)}" if one.stage == apart else one.stage
        groups.setdefault(name, []).append(one.verdict)
    return {name: verdict for name, found in groups.items() if (verdict := summarise_verdicts(found)) is not None}


def verdict_table(verdicts: dict[str, Verdict]) -> TextTable:
    """Lay out verdicts by name: how good, why, and the figure beside that of the trivial way."""
    return TextTable(
        caption="Verdicts: the figure that matters beside that of the trivial way to do it",
        headings=("of", "verdict", "why", "figure", "here", "trivial way", "which is"),
        rows=tuple(
            (
                name,
                verdict.level.value,
                verdict.reason,
                verdict.figure,
                _shown(verdict.value, verdict.unit),
                _shown(verdict.baseline, verdict.unit),
                verdict.baseline_name,
            )
            for name, verdict in verdicts.items()
        ),
        levels=tuple(verdict.level.value for verdict in verdicts.values()),
    )


def verdict_line(name: str, verdict: Verdict) -> str:
    """Return a verdict as a line of text."""
    line = f"{name}: {verdict.level.value}" + (f", {verdict.reason}" if verdict.reason else "")
    if verdict.figure and math.isfinite(verdict.value):
        line += f"; {verdict.figure} {_shown(verdict.value, verdict.unit)}"
        if math.isfinite(verdict.baseline):
            line += f" against {_shown(verdict.baseline, verdict.unit)} ({verdict.baseline_name})"
    return line


def _shown(value: float, unit: str) -> str:
    return format_value(value, unit) if math.isfinite(value) else ""


def _words(name: str) -> str:
    return name.replace("_", " ")
