"""Compare a method with every baseline on the same held-out items, and give verdicts in words and rows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.names import in_words, is_bound
from pasdedeux.evaluation.pictures import compared_figure
from pasdedeux.evaluation.score_tables import format_both, format_interval, format_value, shown_as
from pasdedeux.evaluation.scores import FEWEST_UNITS, Score, bootstrap_interval, weighted_mean
from pasdedeux.plain_text import counted
from pasdedeux.verdict import Level, Paired, Verdict

FEWEST_BLOCKS = 10
"""Fewest seconds of motion, or stills, for a judgement."""
NEGLIGIBLE = 0.01
"""Differences of means smaller than this share of the baseline's are irrelevant, however certain."""
_HELD_OUT = "held_out"
_NOTHING = "no data was held out for it"


@dataclass(frozen=True)
class Items:
    """Errors of methods on the same held-out items, one by one.

    Args:
        values: By method, the figure of each item (item,); NaN where it has none.
        takes: Take of each item, or another unit of which items are alike.
        times_s: Its time within the take, seconds.
        count: Number of things, if each has many frames as items.
    """

    values: Mapping[str, npt.NDArray[np.float64]] = field(default_factory=dict)
    takes: Sequence[str] = ()
    times_s: Sequence[float] | npt.NDArray[np.float64] = ()
    count: int | None = None

    @classmethod
    def joined(cls, parts: Sequence[Items]) -> Items:
        """Return the items of all parts; a method that a part lacks has NaN there."""
        names = dict.fromkeys(name for part in parts for name in part.values)
        values = {
            name: np.concatenate(
                [np.asarray(part.values.get(name, np.full(len(part.takes), np.nan))) for part in parts]
            )
            for name in names
        }
        takes = [take for part in parts for take in part.takes]
        times_s = [float(time) for part in parts for time in part.times_s]
        counts = [part.count for part in parts if part.count is not None]
        return cls(values, takes, times_s, sum(counts) if counts else None)

    def paired(
        self, methods: Sequence[str], baselines: Collection[str], *, is_larger_better: bool = False
    ) -> Paired | None:
        """Return the first of these methods that was scored, else the best that is no baseline, beside the baselines.

        Only items that all of them have count; bounds, which know the ground truth, are no baselines.  None where no
        method was scored.
        """
        finite = {
            name: values for name, values in self.values.items() if not is_bound(name) and np.isfinite(values).any()
        }
        sign = -1.0 if is_larger_better else 1.0
        candidates = [name for name in methods if name in finite] or sorted(
            (name for name in finite if name not in baselines and not methods),
            key=lambda name: (sign * float(np.nanmean(finite[name])), name),
        )
        if not candidates:
            return None
        beside = sorted(name for name in finite if name in baselines and name != candidates[0])
        names = [candidates[0], *beside]
        kept = np.isfinite([finite[name] for name in names]).all(axis=0)
        takes, take = np.unique(np.asarray(self.takes), return_inverse=True)
        seconds = np.floor(np.asarray(self.times_s, dtype=np.float64)).astype(np.int64)
        known, row = np.unique(np.stack([take, seconds], axis=1)[kept], axis=0, return_inverse=True)
        row = row.ravel()
        sums = {name: tuple(np.bincount(row, finite[name][kept], len(known)).tolist()) for name in names}
        return Paired(
            method=candidates[0],
            baselines=tuple(beside),
            count=int(kept.sum()) if self.count is None or not kept.any() else self.count,
            takes=tuple(str(takes[at]) for at in known[:, 0]),
            seconds=tuple(known[:, 1].tolist()),
            sizes=tuple(np.bincount(row, minlength=len(known)).tolist()),
            sums=sums,
            is_larger_better=is_larger_better,
        )


def lead_interval(paired: Paired, baseline: str) -> tuple[float, float]:
    """Return the interval of a method's lead over a baseline (larger is better): over takes, or blocks if few."""
    return bootstrap_interval(
        _sign(paired) * np.subtract(paired.sums[baseline], paired.sums[paired.method]),
        np.array(paired.sizes, dtype=np.float64),
        units=paired.takes if _has_takes(paired) else None,
    )


def _means(paired: Paired) -> dict[str, float]:
    """Return the mean figure of each method; empty where there are no items."""
    size = sum(paired.sizes)
    return {name: math.fsum(sums) / size for name, sums in paired.sums.items()} if size else {}


def _sign(paired: Paired) -> float:
    return -1.0 if paired.is_larger_better else 1.0


def _has_takes(paired: Paired) -> bool:
    return len(set(paired.takes)) >= FEWEST_UNITS


def compare(paired: Paired, figure: str, unit: str, thing: str) -> Verdict:
    """Judge a method: the one rule for all comparisons of methods.

    The difference to each baseline on the same items has an interval by bootstrap: over takes where there are five,
    else over blocks of 1 s.  Pass where every interval lies on the good side, fail where one lies on the bad side, and
    the means differ by 1 % of the baseline's or more; warn in between.  Not judged without a baseline, or with items in
    fewer than ten blocks of 1 s.  The baseline that is named is the one that is hardest to beat.
    """
    sizes, num_blocks = np.array(paired.sizes, dtype=np.float64), len(paired.sizes)
    mean = {name: float(np.sum(sums) / sizes.sum()) if num_blocks else math.nan for name, sums in paired.sums.items()}
    sign = _sign(paired)
    intervals = {name: lead_interval(paired, name) for name in paired.baselines if num_blocks >= FEWEST_BLOCKS}
    leads = {name: sign * (mean[name] - mean[paired.method]) for name in paired.baselines}
    matters = {name: abs(leads[name]) >= NEGLIGIBLE * abs(mean[name]) for name in paired.baselines}
    behind = [name for name, (_, high) in intervals.items() if high < 0.0 and matters[name]]
    unbeaten = [name for name, (low, _) in intervals.items() if low <= 0.0 or not matters[name]]
    hardest = min(
        behind or unbeaten or paired.baselines,
        key=lambda name: intervals[name][bool(behind)] if intervals else sign * mean[name],
        default="",
    )
    method, beaten = in_words(paired.method), in_words(hardest) if hardest else ""
    if not intervals:
        level = Level.NOT_JUDGED
        reason = (
            f"no baseline was scored to compare {method} with"
            if not hardest
            else f"only {num_blocks} s of motion or stills to compare; {FEWEST_BLOCKS} are needed"
            if num_blocks
            else f"no {thing} have figures for both {method} and every baseline"
        )
    else:
        lead, (low, high) = leads[hardest], intervals[hardest]
        level = Level.FAIL if behind else Level.WARN if unbeaten else Level.PASS
        if is_worse := bool(behind) or lead < 0.0:
            lead, low, high = -lead, -high, -low
        by, ends = format_interval(lead, low, high, unit)
        over = (
            counted(len(set(paired.takes)), "take") if _has_takes(paired) else f"{counted(num_blocks, 'block')} of 1 s"
        )
        how = {Level.PASS: "better than", Level.WARN: "about as well as", Level.FAIL: "worse than"}[level]
        lead_words = "by" if level is not Level.WARN else "behind by" if is_worse else "ahead by"
        reason = f"{method} performed {how} {beaten}, {lead_words} {by} ({ends}, over {over})"
    values = (mean[paired.method], unit, mean.get(hardest, math.nan), beaten)
    return Verdict(level, reason, figure, *values, count=paired.count, thing=thing, paired=paired)


_Places = dict[str, dict[tuple[str, str], float]]
"""Figures by method, then by part of the data and item."""


@dataclass(frozen=True)
class Criterion:
    """The figure that decides whether a topic's result is good; every scored baseline has to be beaten.

    Args:
        metric: Metric of the scores that are drawn.
        figure: Its name in words.
        unit: Its unit.
        thing: Name of the items, in the plural.
        methods: Methods to judge: the first of these that was scored; if none is named, the best that is no baseline.
        name: Name of the judged result, if a topic has several verdicts; empty for the topic itself.
        is_larger_better: For shares and areas; errors are better smaller.
        limit: Allowed value if there is no method to compare with; otherwise NaN.
    """

    metric: str
    figure: str
    unit: str
    thing: str
    methods: tuple[str, ...] = ()
    name: str = ""
    is_larger_better: bool = False
    limit: float = math.nan

    def verdict(self, items: Items, baselines: Collection[str]) -> Verdict | None:
        """Return the verdict on these items; None where no method is among them."""
        paired = items.paired(self.methods, baselines, is_larger_better=self.is_larger_better)
        judged = [method for method in items.values if method not in baselines and not is_bound(method)]
        tried = [method for method in self.methods or judged if method in items.values]
        if paired is None and items.takes and not tried:
            return None
        if paired is None or (not paired.sizes and not math.isnan(self.limit)):
            words = f"{in_words(tried[0])} has no finite figure" if items.takes else _NOTHING
            return Verdict(Level.NOT_JUDGED, words, self.figure, count=len(items.takes), thing=self.thing)
        if math.isnan(self.limit):
            return compare(paired, self.figure, self.unit, self.thing)
        value = sum(paired.sums[paired.method]) / sum(paired.sizes)
        level = Level.PASS if value <= self.limit else Level.FAIL
        reason = "" if level is Level.PASS else f"more than the allowed {format_value(self.limit, self.unit)}"
        more = (value, self.unit, self.limit, "allowed")
        return Verdict(level, reason, self.figure, *more, count=paired.count, thing=self.thing)

    def picture(self, scores: Iterable[Score], verdict: Verdict | None = None) -> tuple[bytes, str] | None:
        """Draw the mean figure of every method that was scored where the baselines were, best first, as SVG.

        What the verdict compared is drawn with its means; other methods beside it where they have the same items.

        The goal, named in the caption, is the best baseline or the limit.  If a part is held out, that alone is drawn.
        If no baseline was scored beside others, the methods with most parts are drawn.  Bounds, which know the ground
        truth, are only in tables.  None if there is nothing to compare, such as baselines alone.
        """
        values, counts, unit, plain = self._found(scores)
        scored = max((set(values[name]) for name in values if name not in plain), key=len, default=set())
        tried = [scored.intersection(values[name]) for name in sorted(plain)]
        for shared in (*tried, max(map(set, values.values()), key=len, default=set())):
            places = _apart(shared)
            methods = [name for name in values if places and places.issubset(values[name])]
            if len(methods) >= (1 if math.isfinite(self.limit) else 2):
                break
        else:
            return None
        if plain.issuperset(methods) and not math.isfinite(self.limit):
            return None
        # Sorted: the mean of a set would depend on the order of its hashes.
        means = {name: weighted_mean((values[name][at], counts[name][at]) for at in sorted(places)) for name in methods}
        paired = None if verdict is None else verdict.paired
        judged = {} if paired is None else _means(paired)
        if paired is not None and judged:
            is_same = all(math.isclose(means.get(method, math.nan), judged[method], rel_tol=1e-6) for method in judged)
            means = means | judged if is_same else judged
            plain = plain.union(paired.baselines)
        sign = -1.0 if self.is_larger_better else 1.0
        ranked = sorted(means, key=lambda name: (sign * means[name], name))
        baselines = ((means[method], in_words(method)) for method in ranked if method in plain)
        goal, name = next(baselines, (self.limit, "the limit"))
        if verdict is not None and judged:
            goal, name = verdict.baseline, verdict.baseline_name
        shown_unit, factor = shown_as(unit)
        drawn = compared_figure(
            {method: factor * means[method] for method in ranked},
            plain,
            goal=factor * goal,
            x_label=f"{self.figure} ({shown_unit})" if shown_unit else self.figure,
        )
        better = "longer bars are better" if self.is_larger_better else "shorter bars are better"
        beaten = f"; the dashed line is the value to beat ({name})" if math.isfinite(goal) else ""
        mean = f", weighted mean over {len(places)} parts of the data" if len(places) > 1 else ""
        return drawn, f"{self.figure[:1].upper()}{self.figure[1:]}{mean}; {better}; baselines are hatched{beaten}."

    def _found(self, scores: Iterable[Score]) -> tuple[_Places, _Places, str, set[str]]:
        """Return figures and counts by method and place without bounds, the unit, and which methods are baselines."""
        mine = [
            score
            for score in scores
            if score.metric == self.metric and math.isnan(score.at) and math.isfinite(score.value)
            if not is_bound(score.method)
        ]
        mine = [score for score in mine if score.split == _HELD_OUT] or mine
        values, counts = _Places(), _Places()
        for score in mine:
            values.setdefault(score.method, {})[score.split, score.item] = score.value
            counts.setdefault(score.method, {})[score.split, score.item] = score.count
        return values, counts, mine[-1].unit if mine else "", {score.method for score in mine if score.is_baseline}


def _apart(places: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return places without items of parts that also have a figure over all items: they would count twice."""
    return {(split, item) for split, item in places if item == "all" or (split, "all") not in places}


def merge_verdicts(verdicts: Iterable[Verdict]) -> Verdict | None:
    """Merge verdicts into one, independent of how the work was split and ordered; None if there are none.

    Comparisons are made again over all items. Other verdicts give the worst level, how many share it, and their most
    frequent reason; figure and baseline of that reason are means over all items.
    """
    every = list(verdicts)
    merged = _joined([verdict for verdict in every if verdict.count] or every[:1])
    if len(merged) < 2:
        return merged[0] if merged else None
    tally = Counter[tuple[Level, str]]()
    for verdict in merged:
        for level, reason, count in verdict.tally or ((verdict.level, verdict.reason, 1),):
            tally[level, reason] += count
    worst = max((level for level, _ in tally), key=lambda level: level.rank)
    shared = {reason: count for (level, reason), count in tally.items() if level is worst}
    why = min(shared, key=lambda reason: (not reason, -shared[reason], reason))
    reason = why if worst is Level.PASS else f"{sum(shared.values())} of {tally.total()}: {why}"
    measured: dict[str, list[Verdict]] = {}
    for verdict in merged:
        if verdict.figure and math.isfinite(verdict.value):
            measured.setdefault(verdict.figure, []).append(verdict)
    rows = tuple((level, reason, count) for (level, reason), count in sorted(tally.items()))
    if not measured:
        return Verdict(worst, reason, count=tally.total(), tally=rows)

    def rank(figure: str) -> tuple[int, int, str]:
        alike = measured[figure]
        has_reason = any(
            (worst, why) in {(same.level, same.reason), *(row[:2] for row in same.tally)} for same in alike
        )
        return -has_reason, -sum(verdict.count for verdict in alike), figure

    alike = measured[min(measured, key=rank)]
    names = sorted({verdict.baseline_name for verdict in alike})
    return Verdict(
        worst,
        reason,
        alike[0].figure,
        weighted_mean((verdict.value, verdict.count) for verdict in alike),
        alike[0].unit,
        weighted_mean((verdict.baseline, verdict.count) for verdict in alike),
        names[0] if len(names) == 1 else "",
        count=sum(verdict.count for verdict in alike),
        thing=alike[0].thing,
        tally=rows,
    )


def _joined(verdicts: Iterable[Verdict]) -> list[Verdict]:
    """Return verdicts, merging those that compared the same methods by the same figure."""
    alone: list[Verdict] = []
    groups: dict[tuple[str, str, tuple[str, ...]], list[Verdict]] = {}
    for verdict in verdicts:
        if verdict.paired is None:
            alone.append(verdict)
        else:
            groups.setdefault((verdict.figure, verdict.paired.method, verdict.paired.baselines), []).append(verdict)
    for same in groups.values():
        parts = [verdict.paired for verdict in same if verdict.paired is not None]
        names = (parts[0].method, *parts[0].baselines)
        blocks: dict[tuple[str, int], list[tuple[float, ...]]] = {}
        for part in parts:
            columns = zip(part.sizes, *(part.sums[name] for name in names), strict=True)
            for block, row in zip(zip(part.takes, part.seconds, strict=True), columns, strict=True):
                blocks.setdefault(block, []).append(row)
        known = sorted(blocks)
        rows = [[math.fsum(column) for column in zip(*blocks[block], strict=True)] for block in known]
        whole = replace(
            parts[0],
            count=sum(part.count for part in parts),
            takes=tuple(take for take, _ in known),
            seconds=tuple(second for _, second in known),
            sizes=tuple(int(size) for size, *_ in rows),
            sums={name: tuple(row[at] for row in rows) for at, name in enumerate(names, 1)},
        )
        alone.append(compare(whole, same[0].figure, same[0].unit, same[0].thing))
    return alone


@dataclass(frozen=True)
class NamedVerdict:
    """The verdict on a stage's partition, or on a topic of the evaluation."""

    stage: str
    partition: str
    verdict: Verdict


def verdict_columns(judged: Sequence[NamedVerdict]) -> dict[str, list[object]]:
    """Return verdicts as columns of the `verdicts` table, in the order of stage and partition."""
    rows = sorted(judged, key=lambda verdict: (verdict.stage, verdict.partition))
    names = ("level", "reason", "figure", "value", "unit", "baseline", "baseline_name", "count", "thing")
    return {
        "stage": [row.stage for row in rows],
        "partition": [row.partition for row in rows],
        **{name: [getattr(row.verdict, name) for row in rows] for name in names},
    }


def part_name(stage: str, partition: str) -> str:
    """Return the name of the verdict on one partition of a stage.

    >>> part_name("evaluation", "parallel_views")
    'evaluation: parallel views'
    """
    return f"{stage}: {partition.replace('_', ' ')}"


def verdict_words(verdict: Verdict | None) -> str:
    """Return a verdict in one line: level, reason, and the decisive figure beside the baseline's.

    >>> verdict_words(Verdict(Level.WARN, "hands drift", "contact drift", 0.012, "m", 0.03, "plain kinematics"))
    'warn: hands drift; contact drift 1.2 cm against 3 cm (plain kinematics)'
    """
    return "" if verdict is None else "; ".join(filter(None, (_judged(verdict), figure_words(verdict))))


def figure_words(verdict: Verdict) -> str:
    """Return the decisive figure beside the baseline's, and the number of things it is over; empty without one.

    >>> figure_words(Verdict(Level.PASS, "", "contact drift", 0.012, "m", count=40, thing="variants"))
    'contact drift 1.2 cm, mean of 40 variants'
    """
    if not verdict.figure or not math.isfinite(verdict.value):
        return ""
    value, baseline = format_both(verdict.value, verdict.baseline, verdict.unit)
    line = f"{verdict.figure} {value}"
    if math.isfinite(verdict.baseline):
        line += f" against {baseline} ({in_words(verdict.baseline_name) or 'baseline'})"
    return f"{line}, mean of {verdict.count:,} {verdict.thing}" if verdict.count > 1 else line


def _judged(verdict: Verdict) -> str:
    return f"{verdict.level.value}: {verdict.reason}" if verdict.reason else verdict.level.value
