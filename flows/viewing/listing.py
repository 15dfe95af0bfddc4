"""The list of items of a part, filtered and sorted, with the figures of each item."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flows.viewing.curating import Curation
from flows.viewing.panel import Panel, set_value
from flows.viewing.shelf import GROUPS, Item, Shelf, ViewedPartition
from flows.viewing.table_views import TABLE_VIEWS
from pasdedeux.evaluation.shown_figures import figure_label, value_words
from pasdedeux.verdict import Level
from tasks.files.curation import UNDECIDED

ALL, FAILS, WARNS, PASSES = "all", "fail", "warn", "pass"
STORED_ORDER = "as stored"
ONLY = (ALL, PASSES, WARNS, FAILS, "accepted", "rejected", UNDECIDED)


class Listing:
    """The folder of the panel that filters and sorts the items of a part.

    Args:
        panel: The panel.
        shelf: The contents.
        curation: The choices.
        offered: The widget with the listed items.
    """

    def __init__(self, panel: Panel, shelf: Shelf, curation: Curation, offered: Any) -> None:
        self._shelf, self._curation, self._offered = shelf, curation, offered
        with panel.gui.add_folder("Filter and sort", expand_by_default=False):
            self.only = panel.gui.add_dropdown("only", ONLY)
            self.by = panel.gui.add_dropdown("sort by, largest first", (STORED_ORDER,))
        self.order: list[int] = []
        """Numbers of the listed items."""

    def show(self, part: ViewedPartition, kept: int) -> None:
        """List the items of another part; `kept` is listed in any case."""
        self._part, self._figures = part, qualities(self._shelf, part)
        first = next(iter(self._figures.values()), {})
        self._names = {figure_label(name).words: name for name, value in first.items() if _is_figure(part, name, value)}
        self.by.options = (STORED_ORDER, *self._names)
        self.sort(kept)

    @property
    def items(self) -> Sequence[Item]:
        """All items of the part."""
        return self._shelf.items(self._part)

    def mark(self, index: int) -> None:
        """Select an item in the widget."""
        set_value(self._offered, self.label(index))

    def sort(self, kept: int | None = None) -> None:
        """Filter and sort the items as chosen; `kept` is listed in any case."""
        rows, by, only = [self.figures(item) for item in self.items], str(self.by.value), str(self.only.value)
        shown = [{ALL, str(row.get("verdict", "")), self._chosen(at)} for at, row in enumerate(rows)]
        self.order = [at for at, words in enumerate(shown) if at == kept or only in words]
        if by != STORED_ORDER:
            self.order.sort(key=lambda at: -_number(rows[at].get(self._names[by])))
        self._offered.options = tuple(map(self.label, self.order)) or ("none",)

    def after(self, index: int, by: int) -> int | None:
        """Return the item some places after another one; None if none is listed."""
        at = self.order.index(index) if index in self.order else 0
        return self.order[(at + by) % len(self.order)] if self.order else None

    def label(self, index: int) -> str:
        """Return the label of an item, with verdict and choice unless it passes and is undecided."""
        item = self.items[index]
        words = self.figures(item).get("verdict", PASSES), self._chosen(index)
        return " ".join([item.label, *(f"({word})" for word in words if word not in (PASSES, UNDECIDED, ""))])

    def figures(self, item: Item) -> dict[str, Any]:
        """Return the stored figures of an item."""
        return self._figures.get(item.names, {})

    def figure_lines(self, item: Item) -> list[str]:
        """Return the figures of an item over all its frames, a line each."""
        row = self.figures(item)
        return [value_words(name, value) for name, value in row.items() if _is_figure(self._part, name, value)]

    def _chosen(self, index: int) -> str:
        return self._curation.of_item(self._part, self.items[index])


def qualities(shelf: Shelf, part: ViewedPartition) -> dict[tuple[str, ...], dict[str, Any]]:
    """Return the figures of each item of a part by the item's names; of several people those of the worst."""
    table = TABLE_VIEWS[part.table].quality
    quality_rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for ref in shelf.having(table, part.name) if table else ():
        data = shelf.store.read(ref, table)
        for number in range(data.num_rows):
            row = data.row(number)
            names = tuple(str(row[name]) for name in GROUPS[part.table])
            if names not in quality_rows or Level(row["verdict"]).rank > Level(quality_rows[names]["verdict"]).rank:
                quality_rows[names] = row
    return quality_rows


def _is_figure(part: ViewedPartition, name: str, value: Any) -> bool:
    """Return whether a column of figures is a number and no identifier."""
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool | np.bool_)
    return is_number and name not in {*GROUPS[part.table], "person"}


def _number(value: Any) -> float:
    return float(value) if value is not None and np.isfinite(value) else -np.inf
