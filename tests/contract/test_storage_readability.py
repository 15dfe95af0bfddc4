"""Other programs read the files as they are, without this one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
import pytest

from storage_schema import TABLES, Store
from storage_schema.arrow import ColumnKind, column_kind
from storage_schema.columns import Table
from tests.builders.storage_rows import commit_rows, random_columns

NUM_ROWS = 23


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write random rows of every table; give the Parquet file of each."""
    store = Store(tmp_path_factory.mktemp("store"))
    refs = {name: commit_rows(store, name, NUM_ROWS, stage="ingest", partition=name) for name in TABLES}
    return {name: store.folder(ref.stage, ref.key) / f"{name}.parquet" for name, ref in refs.items()}


def assert_rows(table: Table, found: dict[str, list]) -> None:
    """Assert that plain Python lists, rows first, hold the random rows of the table."""
    given = random_columns(table, NUM_ROWS)
    assert list(found) == [column.name for column in table.columns]
    for column in table.columns:
        values = found[column.name]
        assert len(values) == NUM_ROWS
        kind = column_kind(column)
        if kind in (ColumnKind.TEXT, ColumnKind.TEXT_LIST):
            assert [row if row is None or isinstance(row, str) else list(row) for row in values] == given[column.name]
        elif kind is ColumnKind.FIXED:
            rows = np.array([np.asarray(row, dtype=float).reshape(column.shape) for row in values])
            np.testing.assert_array_equal(rows, given[column.name])
        elif kind is ColumnKind.VARYING:
            for row, expected in zip(values, given[column.name], strict=True):
                np.testing.assert_array_equal(np.asarray(row, dtype=float), expected)
        else:
            numbers = [np.nan if row is None or row is pd.NA else float(row) for row in values]
            expected = [np.nan if row is None else float(row) for row in given[column.name]]
            np.testing.assert_array_equal(numbers, expected)


def read_by_duckdb(path: Path) -> dict[str, list]:
    with duckdb.connect() as connection:
        relation = connection.read_parquet(str(path))
        names, rows = relation.columns, relation.fetchall()
    return {name: [row[at] for row in rows] for at, name in enumerate(names)}


READERS: dict[str, Callable[[Path], dict[str, list]]] = {
    "pyarrow": lambda path: pq.read_table(path).to_pydict(),
    "polars": lambda path: pl.read_parquet(path).to_dict(as_series=False),
    "duckdb": read_by_duckdb,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", TABLES)
def test_others_read_every_table(files: dict[str, Path], name: str, reader: str) -> None:
    assert_rows(TABLES[name], READERS[reader](files[name]))


@pytest.mark.parametrize("name", TABLES)
def test_columns_carry_their_meaning_and_shape(files: dict[str, Path], name: str) -> None:
    schema, as_polars_reads = pq.read_schema(files[name]), pl.read_parquet_schema(files[name])
    assert schema.metadata[b"table"].decode() == name
    for column in TABLES[name].columns:
        metadata = schema.field(column.name).metadata
        assert metadata[b"meaning"].decode() == column.meaning
        if column.shape:
            assert tuple(json.loads(metadata[b"shape"])) == column.shape
            assert as_polars_reads[column.name].shape == (int(np.prod(column.shape)),)
        if column.joints:
            assert len(json.loads(metadata[b"joint_names"])) == column.shape[column.axes.index("joint")]


def test_duckdb_queries_across_the_shards_of_a_stage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for number in range(3):
        commit_rows(store, "scores", 10, stage="evaluation", name=str(number), seed=number)
    with duckdb.connect() as connection:
        found = connection.sql(f"select count(*) from '{tmp_path}/evaluation/*/*/scores.parquet'").fetchall()
    assert found == [(30,)]


@pytest.mark.parametrize("name", TABLES)
def test_bytes_are_laid_out_as_the_design_says(files: dict[str, Path], name: str) -> None:
    metadata = pq.ParquetFile(files[name]).metadata
    assert metadata.format_version == "2.6"
    for index in range(metadata.num_columns):
        column = metadata.row_group(0).column(index)
        assert column.compression == "ZSTD"
        if column.physical_type in ("FLOAT", "DOUBLE"):
            assert "BYTE_STREAM_SPLIT" in column.encodings
            assert not column.has_dictionary_page
        if column.physical_type == "BYTE_ARRAY":
            assert column.has_dictionary_page
