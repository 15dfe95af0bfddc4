"""Is it good: a topic's one figure beside the trivial way to do it, and verdicts as rows for people and programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.evaluation.figures import compared_figure
from pasdedeux.evaluation.names import in_words, is_bound
from pasdedeux.evaluation.score_tables import format_value, shown_as
from pasdedeux.evaluation.scores import Score
from pasdedeux.verdict import Level, Verdict, summarise_verdicts

__all__ = ["Judged", "Yardstick", "by_stage", "figure_words", "part_name", "verdict_columns", "verdict_words"]

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

        Figures are means over the parts and items that both have; of a part with a figure over all its items, that one
        alone.  None where the metric, a method or a baseline is not among the scores.
        """
        found, unit, plain = self._found(scores)
        named = [method for method in self.methods if method in found][:1]
        methods = named if self.methods else [method for method in found if method not in plain]
        baselines = [name for name in self.baselines if name in found]
        if not methods or not (baselines or math.isfinite(self.chance)):
            return None
        mean = _means(found, [*methods, *baselines])
        if not mean:
            return None
        sign = -1.0 if self.is_larger_better else 1.0
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
        reason = f"{in_words(method)} is {how} {in_words(name)}"
        return Verdict(level, reason, self.figure, value, unit, baseline, in_words(name))

    def picture(self, scores: Iterable[Score]) -> tuple[bytes, str] | None:
        """Draw the mean figure of every method that was scored where the trivial ways were, best first, as SVG.

        The goal, told in the caption, is what has to be beaten: the best trivial way, or chance.  Where no trivial way
        was scored beside others, methods are drawn that were scored wherever most were.  Bounds, which know what nobody
        knows, are left to the tables.  None where there is nothing to compare, as only trivial ways.
        """
        found, unit, plain = self._found(scores)
        found = {name: own for name, own in found.items() if name in self.baselines or not is_bound(name)}
        own = max((set(found[name]) for name in found if name not in plain), key=len, default=set())
        tried = [own.intersection(found[name]) for name in self.baselines if name in found]
        for shared in (*tried, max(map(set, found.values()), key=len, default=set())):
            places = _apart(shared)
            methods = [name for name in found if places and places.issubset(found[name])]
            if len(methods) >= (1 if math.isfinite(self.chance) else 2):
                break
        else:
            return None
        if set(self.baselines).issuperset(methods) and not math.isfinite(self.chance):
            return None
        means = _means({name: {place: found[name][place] for place in places} for name in methods}, methods)
        sign = -1.0 if self.is_larger_better else 1.0
        ranked = sorted(means, key=lambda name: (sign * means[name], name))
        trivial = ((means[one], in_words(one)) for one in ranked if one in self.baselines)
        goal, name = next(trivial, (self.chance, self.chance_name))
        shown_unit, factor = shown_as(unit)
        drawn = compared_figure(
            {in_words(method): factor * means[method] for method in ranked},
            {in_words(method) for method in plain},
            goal=factor * goal,
            x_label=f"{self.figure} ({shown_unit})" if shown_unit else self.figure,
        )
        better = "longer bars are better" if self.is_larger_better else "shorter bars are better"
        beaten = f"; the dashed line, {name}, has to be beaten" if math.isfinite(goal) else ""
        mean = f", mean over {len(places)} parts of the data" if len(places) > 1 else ""
        return drawn, f"{self.figure[:1].upper()}{self.figure[1:]}{mean}: {better}, hatched are trivial ways{beaten}."

    def _found(self, scores: Iterable[Score]) -> tuple[dict[str, dict[tuple[str, str], float]], str, set[str]]:
        """Return the figures by method and place, their unit, and which methods are baselines."""
        found: dict[str, dict[tuple[str, str], float]] = {}
        unit, plain = "", set(self.baselines)
        for score in scores:
            if score.metric == self.metric and math.isnan(score.at) and math.isfinite(score.value):
                found.setdefault(score.method, {})[score.split, score.item] = score.value
                unit = score.unit
                plain |= {score.method} if score.is_baseline else set()
        return found, unit, plain


def _means(found: dict[str, dict[tuple[str, str], float]], methods: Sequence[str]) -> dict[str, float]:
    """Return the means of methods over the places that all of them have; nothing where there is none."""
    if not methods:
        return {}
    # Sorted: the mean of a set would depend on the order of its hashes.
    places = sorted(_apart(set.intersection(*(set(found[name]) for name in methods))))
    return {name: float(np.mean([found[name][place] for place in places])) for name in methods} if places else {}


def _apart(places: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return places without the items of parts that have a figure over all of them, which would count twice."""
    return {(split, item) for split, item in places if item == "all" or (split, "all") not in places}


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
        name = part_name(one.stage, one.partition) if one.stage == apart else one.stage
        groups.setdefault(name, []).append(one.verdict)
    return {name: verdict for name, found in groups.items() if (verdict := summarise_verdicts(found)) is not None}


def part_name(stage: str, partition: str) -> str:
    """Return the name of the verdict on one partition of a stage.

    >>> part_name("evaluation", "left_out_clips")
    'evaluation: left out clips'
    """
    return f"{stage}: {partition.replace('_', ' ')}"


def verdict_words(verdict: Verdict | None) -> str:
    """Return a verdict in one line: the level, why, and the figure that matters beside that of the trivial way.

    >>> verdict_words(Verdict(Level.WARN, "hands drift", "contact drift", 0.012, "m", 0.03, "plain kinematics"))
    'warn: hands drift; contact drift 1.2 cm against 3 cm (plain kinematics)'
    """
    return "" if verdict is None else "; ".join(filter(None, (_judged(verdict), figure_words(verdict))))


def figure_words(verdict: Verdict) -> str:
    """Return the figure that matters beside that of the trivial way, medians where it is of many; empty without one."""
    if not verdict.figure or not math.isfinite(verdict.value):
        return ""
    line = f"{verdict.figure} {format_value(verdict.value, verdict.unit)}"
    if math.isfinite(verdict.baseline):
        line += (
            f" against {format_value(verdict.baseline, verdict.unit)} ({in_words(verdict.baseline_name) or 'baseline'})"
        )
    return f"{line}, in the median" if verdict.count > 1 and "median" not in verdict.figure else line


def _judged(verdict: Verdict) -> str:
    return f"{verdict.level.value}: {verdict.reason}" if verdict.reason else verdict.level.value
