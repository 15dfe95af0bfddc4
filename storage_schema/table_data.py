"""Rows of a table for readers: numpy arrays by column name."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from storage_schema.arrow import ColumnKind, arrow_schema, column_kind
from storage_schema.columns import Column, Table
from storage_schema.errors import SchemaError


@dataclass(frozen=True)
class TableData:
    """Some rows and columns of a table.

    `data[column]` gives:

    - numbers: an array (rows,), float64, int32 or bool as stored; a *nullable* number is always float64, NaN for null
    - arrays of a fixed shape: an array (rows, *axes), float32 or float64 as stored
    - arrays of varying length: a list of 1-d arrays
    - text: an object array (rows,) of str, None for null; lists of texts: a list of lists

    Arrays are writable and belong to this object: asking again gives the same array.
    """

    table: Table
    rows: pa.Table = field(repr=False)
    _decoded: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return int(self.rows.num_rows)

    @property
    def column_names(self) -> list[str]:
        """Names of the columns that were read, in the order of the table's definition."""
        return list(self.rows.column_names)

    def __repr__(self) -> str:
        return f"TableData({self.table.name}: {self.num_rows} rows of {', '.join(self.column_names)})"

    def __len__(self) -> int:
        return self.num_rows

    def __contains__(self, name: object) -> bool:
        return name in self.rows.column_names

    def __iter__(self) -> Iterator[str]:
        return iter(self.column_names)

    def __getitem__(self, name: str) -> Any:
        """Return a column's values.

        Raises:
            SchemaError: The column is not in the table, or was not read.
        """
        if name not in self._decoded:
            if name not in self.rows.column_names:
                raise SchemaError(
                    f"table '{self.table.name}': column '{name}' is not here; columns: {', '.join(self.column_names)}"
                )
            self._decoded[name] = _decode(self.table.column(name), self.rows.column(name))
        return self._decoded[name]

    def is_null(self, name: str) -> np.ndarray:
        """Return for each row whether the column is null there, as a bool array (rows,)."""
        self[name]
        return np.array(self.rows.column(name).is_null().to_numpy(), dtype=bool)

    def slice(self, start: int, stop: int | None = None) -> TableData:
        """Return the rows from `start` up to, not including, `stop`; negative numbers count from the end."""
        first, last, _ = slice(start, stop).indices(self.num_rows)
        return TableData(self.table, self.rows.slice(first, max(last - first, 0)))

    def row(self, index: int) -> dict[str, Any]:
        """Return one row as a dict of its columns' values.

        Raises:
            IndexError: There is no such row.
        """
        if not -self.num_rows <= index < self.num_rows:
            raise IndexError(f"table '{self.table.name}' has {self.num_rows} rows, none is number {index}")
        single = self.slice(index % self.num_rows, index % self.num_rows + 1)
        return {name: single[name][0] for name in single}


def concatenate(table: Table, parts: Iterable[TableData]) -> TableData:
    """Return the rows of all parts as one table; without parts an empty one with all columns."""
    listed = [part.rows for part in parts]
    return TableData(table, pa.concat_tables(listed) if listed else arrow_schema(table).empty_table())


def _decode(column: Column, chunks: pa.ChunkedArray) -> Any:
    kind = column_kind(column)
    if kind is ColumnKind.TEXT:
        texts = np.empty(len(chunks), dtype=object)
        texts[:] = chunks.to_pylist()
        return texts
    if kind is ColumnKind.TEXT_LIST:
        return chunks.to_pylist()
    values = chunks.combine_chunks()
    if kind is ColumnKind.FIXED:
        return _numpy(values.flatten()).reshape(len(chunks), *column.shape)
    if kind is ColumnKind.VARYING:
        flat = _numpy(values.flatten())
        offsets = values.offsets.to_numpy() - (values.offsets[0].as_py() if len(values.offsets) else 0)
        return [flat[start:stop] for start, stop in itertools.pairwise(offsets)]
    if column.is_nullable:
        return np.array(values.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    return _numpy(values)


def _numpy(values: pa.Array) -> np.ndarray:
    """Return a writable copy; Arrow's own memory is read-only, which numba and torch treat as another type."""
    return np.array(values.to_numpy(zero_copy_only=False))
