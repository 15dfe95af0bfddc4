"""The method whose result is the product of a table with results of several, and the methods that are baselines."""

from __future__ import annotations

import numpy as np

from storage_schema import TableData

PRODUCTS: dict[str, tuple[str, ...]] = {
    "motions": ("fit_clean", "fit", "viterbi_clean", "viterbi", "window_clean", "window"),
    "lifted_pairs": ("over_time", "completed", "fitted"),
}
"""Methods by table, the best first; of `in_betweens` none is better than its baseline."""
BASELINES: dict[str, tuple[str, ...]] = {
    "motions": ("nearest",),
    "lifted_pairs": ("mean_pair", "lifting", "lifting_ik", "naive_sampling"),
    "in_betweens": ("straight",),
}
PRODUCT_COLUMNS: dict[str, tuple[str, ...]] = {
    "motions": ("sequence_id", "frame", "person_id", "method"),
    "lifted_pairs": ("sequence_id", "frame", "person_id", "partner_id", "method"),
}
"""Columns that decide which rows are the product: those of person and time, and the method."""


def product_rows(rows: TableData) -> np.ndarray:
    """Return which rows (n,) are the product: for each person and frame that of the best method; else all.

    Methods that are neither in `PRODUCTS` nor baselines come after those that are; of several, the last.
    """
    table = rows.table.name
    if table not in PRODUCTS:
        return np.arange(rows.num_rows)
    order = [*BASELINES[table], None, *reversed(PRODUCTS[table])]
    best: dict[tuple[object, ...], tuple[int, int]] = {}
    for row, (*place, method) in enumerate(zip(*(rows[name] for name in PRODUCT_COLUMNS[table]), strict=True)):
        rank = order.index(method if method in order else None)
        best[tuple(place)] = max(best.get(tuple(place), (-1, -1)), (rank, row))
    return np.array(sorted(row for _, row in best.values()), dtype=np.int64)


def method_name(table: str, method: str) -> str:
    """Return the name of a method for file names; baselines are marked.

    >>> method_name("motions", "nearest"), method_name("lifted_pairs", "nearest")
    ('nearest-baseline', 'nearest')
    """
    return f"{method}-baseline" if method in BASELINES.get(table, ()) else method
