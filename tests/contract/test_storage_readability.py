"""Other programs read the files as they are, without this one."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
import pytest

from storage_schema import TABLES, Dataset, Store, create_dataset
from storage_schema.arrow import Kind, column_kind
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
        if kind in (Kind.TEXT, Kind.TEXT_LIST):
            assert [row if row is None or isinstance(row, str) else list(row) for row in values] == given[column.name]
        elif kind is Kind.FIXED:
            rows = np.array([np.asarray(row, dtype=float).reshape(column.shape) for row in values])
            np.testing.assert_array_equal(rows, given[column.name])
        elif kind is Kind.VARYING:
            for row, expected in zip(values, given[column.name], strict=True):
                np.testing.assert_array_equal(np.asarray(row, dtype=float), expected)
        else:
            numbers = [np.nan if row is None or row is pd.NA else float(row) for row in values]
            expected = [np.nan if row is None else float(row) for row in given[column.name]]
            np.testing.assert_array_equal(numbers, expected)


@pytest.mark.parametrize("name", TABLES)
def test_pyarrow_reads_every_table_with_its_metadata(files: dict[str, Path], name: str) -> None:
    found = pq.read_table(files[name])
    assert_rows(TABLES[name], found.to_pydict())
    assert found.schema.metadata[b"table"].decode() == name
    for column in TABLES[name].columns:
        metadata = found.schema.field(column.name).metadata
        assert metadata[b"meaning"].decode() == column.meaning
        if column.shape:
            assert tuple(json.loads(metadata[b"shape"])) == column.shape
        if column.joints:
            assert len(json.loads(metadata[b"joint_names"])) == column.shape[column.axes.index("joint")]


def _none_where_missing(value: object) -> object:
    return None if pd.api.types.is_scalar(value) and pd.isna(value) else value


@pytest.mark.parametrize("name", TABLES)
def test_polars_reads_every_table(files: dict[str, Path], name: str) -> None:
    found = pl.read_parquet(files[name])
    assert_rows(TABLES[name], found.to_dict(as_series=False))
    for column in TABLES[name].columns:
        if column.shape:
            dtype = found.schema[column.name]
            assert isinstance(dtype, pl.Array)
            assert dtype.shape == (int(np.prod(column.shape)),)


@pytest.mark.parametrize("name", TABLES)
def test_duckdb_reads_every_table(files: dict[str, Path], name: str) -> None:
    with duckdb.connect() as connection:
        relation = connection.read_parquet(str(files[name]))
        rows = relation.fetchall()
        columns = relation.columns
    assert_rows(TABLES[name], {column: [row[i] for row in rows] for i, column in enumerate(columns)})


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


READ = ("takes", "variant_quality")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Publish two tables, one of them in two parts."""
    store = Store(tmp_path_factory.mktemp("published"))
    parts = (("takes", NUM_ROWS), ("variant_quality", NUM_ROWS), ("variant_quality", 20))
    refs = [commit_rows(store, table, count, stage="ingest", partition=f"{table}{count}") for table, count in parts]
    return create_dataset(store, "toys", refs)


def test_a_published_version_says_in_croissant_which_files_and_columns_it_has(published: Dataset) -> None:
    described = json.loads((published.path / "croissant.json").read_bytes())
    assert described["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    assert (described["name"], described["version"]) == ("toys", "1")
    assert described["license"] == [source.licence for source in published.sources]
    files = [one for one in described["distribution"] if one["@type"] == "cr:FileObject"]
    sets = {one["@id"]: one for one in described["distribution"] if one["@type"] == "cr:FileSet"}
    assert set(sets) == set(READ)
    for file in files:
        data = (published.path / file["contentUrl"]).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), f"{len(data)} B") == (file["sha256"], file["contentSize"])
    ids = [one["@id"] for one in described["distribution"]]
    for record_set, table in zip(described["recordSet"], READ, strict=True):
        assert [one["@id"] for one in sets[table]["containedIn"]] == [
            name for name in ids if name.startswith(f"{table}-")
        ]
        found = [field["source"]["extract"]["column"] for field in record_set["field"]]
        assert found == [column.name for column in TABLES[table].columns]
        assert all(field["source"]["fileSet"]["@id"] == table for field in record_set["field"])
        kinds = {name: field["dataType"] for name, field in zip(found, record_set["field"], strict=True)}
        assert kinds["take_id"] == "sc:Text"
        ids += [field["@id"] for field in record_set["field"]]
    assert len(set(ids)) == len(ids)


def test_pandas_polars_and_duckdb_load_a_published_version_from_its_folder(published: Dataset) -> None:
    described = json.loads((published.path / "croissant.json").read_bytes())
    files = [
        str(published.path / one["contentUrl"])
        for one in described["distribution"]
        if one["@id"].startswith("variant_")
        if one["@type"] == "cr:FileObject"
    ]
    names = [column.name for column in TABLES["variant_quality"].columns]
    question = duckdb.sql("select * from read_parquet($files)", params={"files": files})
    for found in (pd.read_parquet(files), pl.read_parquet(files), question.to_arrow_table()):
        columns = getattr(found, "columns", None)
        assert list(found.column_names if hasattr(found, "column_names") else columns) == names
        assert len(found) == NUM_ROWS + 20


def test_the_library_datasets_keeps_what_is_held_out_and_all_made_from_it_out_of_train(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    counts = {"waltz": 7, "hug": 11, "judo": 13}
    takes = {
        name: commit_rows(store, "takes", count, stage="ingest", partition=name, facts={"is_held_out": name == "hug"})
        for name, count in counts.items()
    }
    variants = [
        commit_rows(store, "variant_quality", count, stage="augmentation", partition=name, inputs=(takes[name],))
        for name, count in (("waltz", 17), ("hug", 19), ("judo", 23))
    ]
    grandchild = commit_rows(store, "variant_quality", 29, stage="generation", inputs=(variants[1],))
    only_test = commit_rows(store, "scores", 5, inputs=(grandchild, variants[0]))
    published = create_dataset(store, "toys", [*takes.values(), *variants, grandchild, only_test])
    script = (
        "import sys, datasets\n"
        "for table in ('takes', 'variant_quality', 'scores'):\n"
        "    found = datasets.load_dataset(sys.argv[1], table)\n"
        "    print(table, *(f'{split}={rows.num_rows}' for split, rows in sorted(found.items())))\n"
        "    print(*next(iter(found.values())).column_names)\n"
    )
    offline = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-c", script, str(published.path)]
    done = subprocess.run(command, env=os.environ | offline, capture_output=True, text=True, check=True, timeout=300)
    lines = done.stdout.splitlines()
    assert lines[::2] == ["takes test=11 train=20", "variant_quality test=48 train=40", "scores test=5"]
    names = [
        " ".join(column.name for column in TABLES[table].columns) for table in ("takes", "variant_quality", "scores")
    ]
    assert lines[1::2] == names
