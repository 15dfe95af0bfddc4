"""Differences of two artifacts of the same work by column, and whether they are rounding.

On one platform the same work gives the same bytes. Another processor or version of a library rounds differently;
results count as the same if no value differs by more than the tolerance of its column.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.columns import Column
from storage_schema.manifest import Manifest
from storage_schema.store import Store
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES

TOLERANCES = {
    "": 1e-4,
    "Hz": 1e-6,
    "m": 1e-4,
    "m/px": 1e-6,
    "m/s": 1e-3,
    "m/s^3": 1.0,
    "px": 0.05,
    "rad": 1e-3,
    "s": 1e-6,
}
"""By the unit of a column, what a number may differ by: above rounding that solvers carry on, below what shows.

Whole numbers, truth values and texts may not differ, but for keys of artifacts and numbers with a point in a text.
"""
RELATIVE_TOLERANCE = 1e-4
"""Relative tolerance of a number, added to that of its unit."""
_TINY = 1e-300
_KEY = re.compile(r"@[0-9a-f]{8,64}")
_NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?|-?\d+e-\d+")


@dataclass(frozen=True)
class Difference:
    """The largest difference in a column of a table, or of an attached file, which has no column.

    `largest` and `allowed` apply to numbers; `largest` is infinite for other values. `is_missing`: only one of the two
    has the table or file.
    """

    table: str
    column: str = ""
    row: int = 0
    detail: str = "other bytes"
    largest: float = np.inf
    allowed: float = 0.0
    is_missing: bool = False

    @property
    def is_beyond(self) -> bool:
        """Return whether this is more than rounding."""
        return not self.largest <= self.allowed

    @property
    def is_attachment(self) -> bool:
        """Return whether this is an attached file, which has no tolerance."""
        return self.table not in TABLES

    @property
    def excess(self) -> float:
        """Return the difference divided by the tolerance; huge if that is zero."""
        return self.largest / max(self.allowed, _TINY)

    def __str__(self) -> str:
        if not self.column:
            return f"{self.table}: {self.detail}"
        size = f" (allowed {self.allowed:.2g})" if np.isfinite(self.largest) else ""
        return f"{self.table}.{self.column}, row {self.row}: {self.detail}{size}"


def compare_artifacts(one_store: Store, first: Manifest, other_store: Store, other: Manifest) -> list[Difference]:
    """Return the differences of two artifacts by column and file, tables first; none for the same bytes.

    Raises:
        CorruptArtifact, SchemaError: A table cannot be read.
    """
    if first.ref.content_digest == other.ref.content_digest:
        return []
    differences = [
        difference
        for name in first.tables
        if name in other.tables and first.tables[name].sha256 != other.tables[name].sha256
        for difference in _of_table(one_store, first, other_store, other, name)
    ]
    files, other_files = first.data_files, other.data_files
    differences += [
        Difference(name.removesuffix(".parquet"), detail="is only in one", is_missing=True)
        for name in sorted(files.keys() ^ other_files.keys())
    ]
    return differences + [
        Difference(name)
        for name in first.attachments
        if name in other.attachments and first.attachments[name].sha256 != other.attachments[name].sha256
    ]


def tolerances_text() -> str:
    """Return the tolerances as a sentence, for the data dictionary."""
    units = ", ".join(f"{value:g} {unit}".rstrip() for unit, value in TOLERANCES.items())
    return f"{units} by the unit of the column,\nand {RELATIVE_TOLERANCE:g} of the number itself"


def _of_table(
    one_store: Store, mine_of: Manifest, other_store: Store, other: Manifest, name: str
) -> Iterator[Difference]:
    rows, other_rows = mine_of.tables[name].rows, other.tables[name].rows
    if rows != other_rows:
        yield Difference(name, detail=f"{rows} rows, {other_rows} there")
        return
    worst: dict[str, Difference] = {}
    start = 0
    batches = zip(one_store.iter_batches(mine_of.ref, name), other_store.iter_batches(other.ref, name), strict=True)
    for mine, theirs in batches:
        for column in TABLES[name].columns:
            difference = _of_column(name, column, mine, theirs, start)
            before = worst.get(column.name)
            if difference is not None and (before is None or difference.excess > before.excess):
                worst[column.name] = difference
        start += len(mine)
    yield from worst.values() if worst else [Difference(name, detail="the same values in other bytes", largest=0.0)]


def _of_column(name: str, column: Column, mine: TableData, theirs: TableData, start: int) -> Difference | None:
    first, other = mine[column.name], theirs[column.name]
    if column_kind(column) is ColumnKind.VARYING:
        lengths = [len(values) for values in first]
        if lengths != [len(values) for values in other]:
            row = next(i for i, values in enumerate(other) if len(values) != lengths[i])
            detail = f"{lengths[row]} values, {len(other[row])} there"
            return Difference(name, column.name, start + row, detail)
        rows = np.repeat(np.arange(len(first)), lengths)
        first, other = (np.concatenate([*values, []]) for values in (first, other))
    else:
        rows = np.arange(len(mine))
    if column_kind(column) in (ColumnKind.TEXT, ColumnKind.TEXT_LIST):
        differing = [
            _of_text(name, column, start + index, str(a), str(b))
            for index, (a, b) in enumerate(zip(first, other, strict=True))
            if a != b
        ]
        return max(differing, key=lambda difference: difference.excess, default=None)
    first, other = (np.asarray(values, np.float64) for values in (first, other))
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.where((first == other) | (np.isnan(first) & np.isnan(other)), 0.0, np.abs(first - other))
    apart = np.where(np.isnan(apart), np.inf, apart)
    if not apart.any():
        return None
    allowed = np.zeros_like(apart)
    if pa.types.is_floating(value_type(column)):
        allowed += TOLERANCES[column.unit] + RELATIVE_TOLERANCE * np.nan_to_num(np.abs(first))
    with np.errstate(over="ignore"):
        at = np.unravel_index(np.argmax(apart / np.maximum(allowed, _TINY)), apart.shape)
    detail = f"{first[at]:.9g}, {other[at]:.9g} there, {apart[at]:.2g} {column.unit}".rstrip() + " apart"
    return Difference(name, column.name, start + int(rows[at[0]]), detail, float(apart[at]), float(allowed[at]))


def _of_text(name: str, column: Column, row: int, first: str, other: str) -> Difference:
    """Compare two texts: keys of artifacts are ignored, and decimal numbers are compared as numbers."""
    detail = f"{first!r:.60}, {other!r:.60} there"
    bare = [_KEY.sub("@", text) for text in (first, other)]
    if _NUMBER.sub("", bare[0]) != _NUMBER.sub("", bare[1]):
        return Difference(name, column.name, row, detail)
    mine, theirs = (np.array(_NUMBER.findall(text), np.float64) for text in bare)
    apart, allowed = np.abs(mine - theirs), TOLERANCES[""] + RELATIVE_TOLERANCE * np.abs(mine)
    worst = np.argmax(apart / allowed) if len(apart) else None
    size = (0.0, 0.0) if worst is None else (float(apart[worst]), float(allowed[worst]))
    return Difference(name, column.name, row, detail, *size)
