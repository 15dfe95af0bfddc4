"""Scores as tables for people: methods side by side where there are several, else figures side by side."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.evaluation.names import better_sign, in_words, is_bound
from pasdedeux.evaluation.scores import Score

_HUNDREDTHS = {"m": ("cm", 100.0), "": ("", 1.0)}
"""Lengths are shown in centimetres."""
_MIN_LENGTH_M = 1e-9
"""Lengths below are rounding, and shown as 0."""


@dataclass(frozen=True)
class TextTable:
    """A table of text: a caption, column headings and rows."""

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def format_value(value: float, unit: str) -> str:
    """Return a figure with its unit, three significant digits, lengths in cm."""
    shown_unit, factor = shown_as(unit)
    scaled = 0.0 if unit == "m" and abs(value) < _MIN_LENGTH_M else value * factor
    text = f"{scaled:.3g}" if abs(scaled) < 1000 else f"{scaled:,.0f}"
    return f"{text} {shown_unit}".strip() if np.isfinite(value) else "-"


def shown_as(unit: str) -> tuple[str, float]:
    """Return the unit that figures of a unit are shown in, and what they are multiplied by."""
    return _HUNDREDTHS.get(unit, (unit, 1.0))


def format_score(score: Score) -> str:
    """Return the figure of a score with its unit, and its interval where it has one."""
    shown = format_value(score.value, score.unit)
    if not np.isfinite([score.low, score.high]).all():
        return shown
    low, high = (format_value(value, score.unit).split(" ")[0] for value in (score.low, score.high))
    return f"{shown} ({low} to {high})"


def score_table(scores: Sequence[Score], *, caption: str, has_marks: bool = False) -> TextTable:
    """Lay out the single figures of a topic; points of curves (`at` given) are left to the pictures.

    Several methods stand in columns of their own beside each other, baselines marked as such; of a single method the
    figures stand in columns and the items in rows.  With marks the best value of a row has a star, where it is known
    what is better; what nobody can know has none.
    """
    single = [score for score in scores if np.isnan(score.at)]
    if len({score.method for score in single}) == 1:
        return _by_item(single, caption)
    methods = sorted({(score.is_baseline, score.method) for score in single})
    keys = sorted({(score.metric, score.split, score.item) for score in single}, key=_all_first)
    cells = {(s.metric, s.split, s.item, s.method): format_score(s) for s in single}
    for key in keys if has_marks else ():
        found = [s for s in single if (s.metric, s.split, s.item) == key and np.isfinite(s.value)]
        own = {score.method: score.value for score in found if not is_bound(score.method)}
        sign = better_sign(key[0])
        best = max((sign * value for value in own.values()), default=0.0)
        if sign and len(own) > 1:
            cells |= {(*key, name): f"{cells[*key, name]} *" for name, value in own.items() if sign * value == best}
    headings = tuple(
        f"{in_words(method)} (baseline)" if is_baseline else in_words(method) for is_baseline, method in methods
    )
    return _without_all(
        caption=caption,
        headings=("figure", "part", "item", *headings),
        rows=tuple(
            (in_words(metric), split, item, *(cells.get((metric, split, item, m), "") for _, m in methods))
            for metric, split, item in keys
        ),
    )


def mean_table(scores: Sequence[Score], *, caption: str, has_marks: bool = False) -> TextTable | None:
    """Lay out means over the items of each figure, methods in columns; None where no figure has several items.

    Where views of an item have their mean as an item of its own (named with "mean of"), those means are taken, so that
    every item counts once.
    """
    groups: dict[tuple[str, str], dict[str, list[Score]]] = {}
    for score in scores:
        if np.isnan(score.at) and np.isfinite(score.value):
            groups.setdefault((score.metric, score.split), {}).setdefault(score.method, []).append(score)
    rows, counts = [], set()
    for (metric, split), by_method in groups.items():
        own = {
            method: [score for score in found if "mean of" in score.item] or found
            for method, found in by_method.items()
        }
        count = max(len(found) for found in own.values())
        counts.add(count)
        for found in own.values():
            # A method that is there for some items only is no mean over all of them.
            if len(found) == count:
                value = float(np.mean([score.value for score in found]))
                plain = replace(found[0], low=float("nan"), high=float("nan"))
                rows.append(replace(plain, metric=metric, split=split, item=f"mean of {count}", value=value))
    return score_table(rows, caption=caption, has_marks=has_marks) if counts and max(counts) > 1 else None


def _by_item(scores: Sequence[Score], caption: str) -> TextTable:
    """Lay out the figures of one method: a row per item, a column per figure."""
    metrics = sorted({score.metric for score in scores})
    rows = sorted({(score.split, score.item) for score in scores}, key=lambda row: (row[0], _natural(row[1])))
    cells = {(score.split, score.item, score.metric): format_score(score) for score in scores}
    return _without_all(
        caption=caption,
        headings=("part", "item", *(in_words(metric) for metric in metrics)),
        rows=tuple((split, item, *(cells.get((split, item, m), "") for m in metrics)) for split, item in rows),
    )


def _without_all(caption: str, headings: tuple[str, ...], rows: tuple[tuple[str, ...], ...]) -> TextTable:
    """Return a table without the columns of part and item that say `all` in every row."""
    kept = [
        at for at, name in enumerate(headings) if name not in ("part", "item") or {row[at] for row in rows} != {"all"}
    ]
    return TextTable(caption, tuple(headings[at] for at in kept), tuple(tuple(row[at] for at in kept) for row in rows))


def _all_first(key: tuple[str, str, str]) -> tuple[str, bool, str, bool, list[tuple[int, str]]]:
    metric, split, item = key
    return metric, split != "clean", split, item != "all", _natural(item)


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts clip_2 before clip_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]
