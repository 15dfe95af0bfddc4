"""Parquet files of a table: the same rows give the same bytes, and reading gives the declared schema."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema.arrow import ColumnKind, arrow_schema, column_kind, schema_digest, value_type
from storage_schema.columns import Column, Table
from storage_schema.durable import HashingFile
from storage_schema.encoding import encode
from storage_schema.errors import CorruptArtifact, SchemaError
from storage_schema.manifest import TableFile
from storage_schema.table_data import TableData

ROW_GROUP_ROWS = 10_000
"""Rows of a row group, which writers hold in memory and readers read at a time."""

_COMPRESSION_LEVEL = 3


class TableWriter:
    """Writes the rows of one table to a new file as they come.

    Rows are collected into row groups of `ROW_GROUP_ROWS`, so that the file does not depend on the calls of `append`,
    and memory holds at most one row group beside the appended rows.
    """

    def __init__(self, path: Path, table: Table) -> None:
        self._table = table
        self._num_rows = 0
        self._waiting: list[pa.Table] = []
        self._num_waiting = 0
        self._file = HashingFile(path)
        self._parquet = pq.ParquetWriter(self._file, arrow_schema(table), **_options(table))

    def append(self, columns: Mapping[str, Any]) -> None:
        """Add rows at the end.

        Raises:
            SchemaError: A column is missing, unknown, of another length, shape or kind.
        """
        self.append_rows(encode(self._table, columns))

    def append_rows(self, rows: pa.Table) -> None:
        """Add rows that are already encoded."""
        self._waiting.append(rows)
        self._num_waiting += rows.num_rows
        self._num_rows += rows.num_rows
        while self._num_waiting >= ROW_GROUP_ROWS:
            self._write(ROW_GROUP_ROWS)

    def write_group(self, rows: pa.Table) -> None:
        """Add encoded rows as a separate row group of any size."""
        if self._num_waiting:
            self._write(self._num_waiting)
        self._parquet.write_table(rows.combine_chunks(), row_group_size=max(rows.num_rows, 1))
        self._num_rows += rows.num_rows

    def finish(self) -> TableFile:
        """Write pending rows, sync the file to the disk, and return its description."""
        if self._num_waiting:
            self._write(self._num_waiting)
        self._parquet.close()
        self._file.close()
        return TableFile(self._num_rows, self._file.num_bytes, self._file.sha256, schema_digest(self._table))

    def abandon(self) -> None:
        """Close the file and discard it."""
        for part in (self._parquet, self._file):
            try:
                part.close()
            except (OSError, ValueError, pa.ArrowException):
                # A consequence of the error that is reported.
                continue

    def _write(self, num_rows: int) -> None:
        waiting = pa.concat_tables(self._waiting)
        group, rest = waiting.slice(0, num_rows), waiting.slice(num_rows)
        self._parquet.write_table(group.combine_chunks(), row_group_size=ROW_GROUP_ROWS)
        self._waiting, self._num_waiting = [rest], rest.num_rows


def read_table(
    path: Path, table: Table, *, columns: Sequence[str] | None = None, rows: slice | None = None
) -> TableData:
    """Read rows of a table, and only the row groups with these rows.

    Without `columns` or `rows` all are read; columns come in the order of the definition, and rows as in Python:
    negative numbers count from the end, and a range beyond the end is cut.

    Raises:
        SchemaError: A column is not in the table, or the file was written with other columns.
        CorruptArtifact: The file cannot be read.
    """
    names = _wanted(table, columns)
    with _opened(path, table) as file:
        if rows is None:
            return TableData(table, _guarded(path, lambda: file.read(columns=names, use_threads=False)))
        start, stop, step = rows.indices(file.metadata.num_rows)
        if step != 1:
            raise SchemaError(f"table '{table.name}': rows are read in steps of 1, not {step}")
        groups, first = _groups_of(file, start, max(start, stop))
        arrow_table = _guarded(path, lambda: file.read_row_groups(groups, columns=names, use_threads=False))
        return TableData(table, arrow_table.slice(start - first, max(stop - start, 0)))


def iter_table(
    path: Path, table: Table, *, columns: Sequence[str] | None = None, only: Mapping[str, str] = MappingProxyType({})
) -> Iterator[TableData]:
    """Read a table one row group at a time, those that by the file's statistics hold `only` these texts in columns.

    Raises:
        SchemaError: A column is not in the table, or the file was written with other columns.
        CorruptArtifact: The file cannot be read.
    """
    names = _wanted(table, columns)
    with _opened(path, table) as file:
        for group in groups_with(file, only):
            yield TableData(
                table, _guarded(path, lambda g=group: file.read_row_group(g, columns=names, use_threads=False))
            )


def groups_with(file: pq.ParquetFile, only: Mapping[str, str]) -> list[int]:
    """Return the row groups that, by the file's statistics, hold only these texts in columns."""
    groups = []
    for group in range(file.num_row_groups):
        row_group = file.metadata.row_group(group)
        stats = {
            chunk.path_in_schema: chunk.statistics for chunk in map(row_group.column, range(row_group.num_columns))
        }
        if all(stats[name] and stats[name].min == stats[name].max == text for name, text in only.items()):
            groups.append(group)
    return groups


def _options(table: Table) -> dict[str, Any]:
    """Return the writer's options; all that affect bytes are stated, so that changed defaults change no digest."""
    return {
        "version": "2.6",
        "data_page_version": "1.0",
        "compression": "zstd",
        "compression_level": _COMPRESSION_LEVEL,
        "use_dictionary": [
            _path(c) for c in table.columns if column_kind(c) in (ColumnKind.TEXT, ColumnKind.TEXT_LIST)
        ],
        "use_byte_stream_split": [_path(c) for c in table.columns if pa.types.is_floating(value_type(c))],
        "write_statistics": [c.name for c in table.columns if not pa.types.is_nested(c.type)],
        "write_page_checksum": True,
        "store_schema": True,
        "use_compliant_nested_type": True,
    }


def _path(column: Column) -> str:
    """Return the Parquet path of a column's leaf."""
    return f"{column.name}.list.element" if pa.types.is_nested(column.type) else column.name


def _wanted(table: Table, columns: Sequence[str] | None) -> list[str]:
    known = [column.name for column in table.columns]
    if isinstance(columns, str):
        raise SchemaError(f"columns are a list of names, such as ['{columns}'], not a text")
    if columns is None:
        return known
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise SchemaError(f"table '{table.name}' has no column '{unknown[0]}'; known columns: {', '.join(known)}")
    return [name for name in known if name in columns]


def _opened(path: Path, table: Table) -> pq.ParquetFile:
    file = _guarded(path, lambda: pq.ParquetFile(path, page_checksum_verification=True))
    if not file.schema_arrow.equals(arrow_schema(table), check_metadata=False):
        file.close()
        raise SchemaError(f"table '{table.name}': {path.name} was written with other columns; run its stage again")
    return file


def _guarded(path: Path, read: Any) -> Any:
    try:
        return read()
    except FileNotFoundError:
        raise CorruptArtifact(f"{path} is missing though its manifest names it") from None
    except (OSError, pa.ArrowException) as error:
        raise CorruptArtifact(
            f"{path} cannot be read ({error}); `pasdedeux verify` tells whether it is damaged"
        ) from error


def _groups_of(file: pq.ParquetFile, start: int, stop: int) -> tuple[list[int], int]:
    """Return the row groups that hold the rows start..stop, and the number of the first row of the first of them."""
    groups: list[int] = []
    first = position = 0
    for group in range(file.num_row_groups):
        end = position + file.metadata.row_group(group).num_rows
        if position < stop and end > start:
            if not groups:
                first = position
            groups.append(group)
        position = end
    return groups, first if groups else start
