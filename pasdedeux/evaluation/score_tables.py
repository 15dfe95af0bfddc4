"""Scores as tables for people: methods side by side where there are several, else figures side by side."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.evaluation.names import better_sign, in_words, is_bound, part_in_words
from pasdedeux.evaluation.scores import Score, weighted_mean

_HUNDREDTHS = {"m": ("cm", 100.0), "": ("", 1.0)}
"""Lengths are shown in centimetres."""
_MIN_LENGTH_M = 1e-9
"""Lengths below this are rounding errors, shown as 0."""


@dataclass(frozen=True)
class TextTable:
    """A table of text: a caption, column headings and rows."""

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def format_value(value: float, unit: str, num_digits: int = 3) -> str:
    """Return a figure with its unit, so many significant digits, lengths in cm."""
    shown_unit, factor = shown_as(unit)
    scaled = 0.0 if unit == "m" and abs(value) < _MIN_LENGTH_M else value * factor
    text = f"{scaled:.{num_digits}g}" if abs(scaled) < 1000 else f"{scaled:,.0f}"
    return f"{text} {shown_unit}".strip() if np.isfinite(value) else "-"


def format_both(value: float, other: float, unit: str) -> tuple[str, str]:
    """Return two figures with the fewest digits, from three to five, that distinguish them.

    >>> format_both(0.10573, 0.10554, "m"), format_both(0.1, 0.2, "m")
    (('10.57 cm', '10.55 cm'), ('10 cm', '20 cm'))
    """
    for num_digits in (3, 4, 5):
        both = format_value(value, unit, num_digits), format_value(other, unit, num_digits)
        if both[0] != both[1]:
            return both
    return format_value(value, unit), format_value(other, unit)


def shown_as(unit: str) -> tuple[str, float]:
    """Return the display unit of figures and its factor."""
    return _HUNDREDTHS.get(unit, (unit, 1.0))


def format_interval(value: float, low: float, high: float, unit: str) -> tuple[str, str]:
    """Return a figure with its unit, and the ends of its interval as "low to high"."""
    ends = (format_value(end, unit).split(" ")[0] for end in (low, high))
    return format_value(value, unit), " to ".join(ends)


def format_score(score: Score) -> str:
    """Return the figure of a score with its unit, and its interval where it has one."""
    value, ends = format_interval(score.value, score.low, score.high, score.unit)
    return f"{value} ({ends})" if np.isfinite([score.low, score.high]).all() else value


def pivot_table(
    scores: Iterable[Score],
    caption: str,
    headings: Sequence[str],
    row: Callable[[Score], tuple[str, ...]],
    columns: Mapping[str, str],
    column: Callable[[Score], str],
    cell: Callable[[Sequence[Score]], str],
) -> TextTable:
    """Lay out scores as a table, by the names of their rows and their columns.

    Args:
        scores: The scores, in the order of their rows.
        caption: Caption of the table.
        headings: Headings of the names that `row` returns.
        row: Names of the row that a score stands in.
        columns: Headings by column, in order; scores of other columns make no row.
        column: The column that a score stands in.
        cell: Text of the scores of a cell; a cell without scores is empty.
    """
    cells: dict[tuple[str, ...], dict[str, list[Score]]] = {}
    for score in scores:
        if column(score) in columns:
            cells.setdefault(row(score), {}).setdefault(column(score), []).append(score)
    rows = (
        (*names, *(cell(cells_of[key]) if key in cells_of else "" for key in columns))
        for names, cells_of in cells.items()
    )
    return TextTable(caption, (*headings, *columns.values()), tuple(rows))


def score_table(scores: Iterable[Score], *, caption: str, has_marks: bool = False) -> TextTable:
    """Lay out the single figures of a topic; points of curves (`at` given) are left to the pictures.

    Several methods have a column each, with baselines and bounds marked; of a single method, figures are columns and
    items are rows.  With marks, the best value of a row has a star if the better direction is known; bounds have none.
    """
    single = sorted((score for score in scores if np.isnan(score.at)), key=_all_first)
    methods = {
        method: in_words(method) + (" (bound)" if is_bound(method) else " (baseline)" if is_baseline else "")
        for is_baseline, method in sorted({(score.is_baseline, score.method) for score in single})
    }
    if len(methods) == 1:
        single.sort(key=lambda score: (score.split, _natural(score.item)))
        figures = {name: in_words(name) for name in sorted({score.metric for score in single})}
        items = pivot_table(
            *(single, caption, ("part", "item"), lambda score: (part_in_words(score.split), score.item), figures),
            *(lambda score: score.metric, _text),
        )
        return _without_all(items)
    best = _best(single) if has_marks else set()
    table = pivot_table(
        single,
        caption,
        ("figure", "part", "item"),
        lambda score: (score.metric, part_in_words(score.split), score.item),
        methods,
        lambda score: score.method,
        lambda in_cell: _text(in_cell) + " *" * (in_cell[-1] in best),
    )
    return _without_all(replace(table, rows=tuple((in_words(metric), *rest) for metric, *rest in table.rows)))


def _text(scores: Sequence[Score]) -> str:
    return format_score(scores[-1])


def _best(scores: Iterable[Score]) -> set[Score]:
    """Return the best scores of each figure, part and item if the better direction is known and methods compete."""
    rows: dict[tuple[str, str, str], list[Score]] = {}
    for score in scores:
        if np.isfinite(score.value) and not is_bound(score.method):
            rows.setdefault((score.metric, score.split, score.item), []).append(score)
    best = set()
    for (metric, *_), alternatives in rows.items():
        if (sign := better_sign(metric)) and len(alternatives) > 1:
            value = max(sign * score.value for score in alternatives)
            best |= {score for score in alternatives if sign * score.value == value}
    return best


def mean_table(scores: Sequence[Score], *, caption: str, has_marks: bool = False) -> TextTable | None:
    """Lay out means over the items of each figure, weighted by size, in columns by method; None for single items.

    If the mean over views of an item is an item of its own (named with "mean of"), only these means are used, so that
    every item counts once.
    """
    groups: dict[tuple[str, str], dict[str, list[Score]]] = {}
    for score in scores:
        if np.isnan(score.at) and np.isfinite(score.value):
            groups.setdefault((score.metric, score.split), {}).setdefault(score.method, []).append(score)
    rows, counts = [], set()
    for (metric, split), by_method in groups.items():
        means = {
            method: [score for score in method_scores if "mean of" in score.item] or method_scores
            for method, method_scores in by_method.items()
        }
        count = max(len(chosen) for chosen in means.values())
        counts.add(count)
        for chosen in means.values():
            # A method with only some of the items has no mean over all of them.
            if len(chosen) == count:
                value = weighted_mean((score.value, score.count) for score in chosen)
                plain = replace(chosen[0], low=float("nan"), high=float("nan"))
                rows.append(replace(plain, metric=metric, split=split, item=f"mean of {count}", value=value))
    return score_table(rows, caption=caption, has_marks=has_marks) if counts and max(counts) > 1 else None


def _without_all(table: TextTable) -> TextTable:
    """Return a table without the columns of part and item that say `all` in every row."""
    kept = [
        at
        for at, name in enumerate(table.headings)
        if name not in ("part", "item") or {row[at] for row in table.rows} != {"all"}
    ]
    headings, *rows = (tuple(row[at] for at in kept) for row in (table.headings, *table.rows))
    return TextTable(table.caption, headings, tuple(rows))


def _all_first(score: Score) -> tuple[str, bool, str, bool, list[tuple[int, str]]]:
    return score.metric, score.split != "clean", score.split, score.item != "all", _natural(score.item)


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts clip_2 before clip_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]
