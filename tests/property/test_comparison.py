"""Compare two artifacts: a changed value is named, and is rounding only within its tolerance."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage_schema import TABLES, Store
from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.comparison import RELATIVE_TOLERANCE, TOLERANCES, Difference, compare_artifacts
from tests.builders.storage_rows import commit_rows, put, random_columns

NUM_ROWS = 7


def compared(table: str, first: dict[str, Any], second: dict[str, Any]) -> list[Difference]:
    with tempfile.TemporaryDirectory() as folder:
        stores = [Store(Path(folder) / name) for name in "ab"]
        made = [put(store, "made", "n", {table: rows}, {}) for store, rows in zip(stores, (first, second), strict=True)]
        return compare_artifacts(stores[0], made[0], stores[1], made[1])


def test_every_unit_of_a_number_has_a_tolerance() -> None:
    numbers = [c for t in TABLES.values() for c in t.columns if pa.types.is_floating(value_type(c))]
    assert {column.unit for column in numbers} == set(TOLERANCES)


@pytest.mark.parametrize("table", TABLES)
def test_the_same_rows_do_not_differ(table: str) -> None:
    assert compared(table, random_columns(table, NUM_ROWS), random_columns(table, NUM_ROWS)) == []


@given(data=st.data(), table=st.sampled_from(sorted(TABLES)), factor=st.sampled_from([0.2, 5.0]))
def test_one_changed_value_is_named_and_judged_by_the_tolerance_of_its_column(
    data: st.DataObject, table: str, factor: float
) -> None:
    first, second = random_columns(table, NUM_ROWS), random_columns(table, NUM_ROWS)
    column = data.draw(st.sampled_from(TABLES[table].columns))
    row = data.draw(st.integers(0, NUM_ROWS - 1))
    kind = column_kind(column)
    is_rounding = False
    if kind is ColumnKind.TEXT:
        second[column.name][row] = "something else"
    elif kind is ColumnKind.TEXT_LIST:
        second[column.name][row] = ["something else"]
    elif kind is ColumnKind.VARYING:
        second[column.name][row] = np.append(second[column.name][row], 1).astype(second[column.name][row].dtype)
    elif pa.types.is_floating(value_type(column)):
        # Steps of the stored type are far below the tolerances, so what is stored is what was meant.
        value = 4.0
        allowed = TOLERANCES[column.unit] + RELATIVE_TOLERANCE * value
        for columns, put in ((first, value), (second, value + factor * allowed)):
            if column.shape:
                columns[column.name][row].flat[-1] = put
            else:
                columns[column.name][row] = put
        is_rounding = factor < 1
    elif column.shape:
        second[column.name][row].flat[-1] = first[column.name][row].flat[-1] + 1
    else:
        before = first[column.name][row]
        second[column.name][row] = (not before) if kind is ColumnKind.BOOLEAN else (before or 0) + 1
        if before is None:
            first[column.name][row] = 0
    (found,) = compared(table, first, second)
    assert (found.table, found.column, found.row) == (table, column.name, row)
    assert found.is_beyond is not is_rounding
    assert f"{table}.{column.name}, row {row}: " in str(found)


def test_the_worst_row_of_all_row_groups_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.parquet_files.ROW_GROUP_ROWS", 3)
    first, second = random_columns("scores", 8), random_columns("scores", 8)
    first["value"][:] = second["value"][:] = 0.0
    second["value"][[1, 5, 7]] = [1.0, 3.0, 2.0]
    (found,) = compared("scores", first, second)
    assert (found.row, found.largest, found.allowed) == (5, 3.0, TOLERANCES[""])


def test_a_number_beside_a_missing_or_an_infinite_one_is_beyond_every_tolerance() -> None:
    first = random_columns("scores", 2)
    first["value"][:] = [np.nan, np.inf]
    assert compared("scores", first, {**first, "value": first["value"].copy()}) == []
    for values in ([1.0, np.inf], [np.nan, 1.0], [np.nan, -np.inf]):
        (found,) = compared("scores", first, {**first, "value": np.array(values)})
        assert found.is_beyond


@pytest.mark.parametrize(
    ("first", "second", "is_beyond"),
    [
        ("draws@3cee9f89eb64a470#2", "draws@bc51b59d1c01853d#2", False),
        ("draws@3cee9f89eb64a470#2", "draws@bc51b59d1c01853d#3", True),
        ('{"log_block": [1.15442, 2.5e-05], "n": 3}', '{"log_block": [1.15443, 2.6e-05], "n": 3}', False),
        ('{"log_block": [1.15442, 2.5e-05], "n": 3}', '{"log_block": [1.25442, 2.5e-05], "n": 3}', True),
        ('{"n": 3}', '{"n": 4}', True),
        ("judo", "jude", True),
    ],
)
def test_a_text_may_differ_by_keys_and_by_rounded_numbers_alone(first: str, second: str, is_beyond: bool) -> None:
    rows = random_columns("lifted_pairs", 2)
    (found,) = compared("lifted_pairs", {**rows, "draw": ["", first]}, {**rows, "draw": ["", second]})
    assert (found.column, found.row, found.is_beyond) == ("draw", 1, is_beyond)


def test_arrays_without_a_value_do_not_differ() -> None:
    first = random_columns("models", 2)
    first["values"] = [np.zeros(0), np.zeros(0)]
    (found,) = compared("models", first, {**first, "array_name": [*first["array_name"][:1], "else"]})
    assert (found.column, found.row) == ("array_name", 1)


def test_other_numbers_of_rows_and_other_attachments_are_said(tmp_path: Path) -> None:
    (found,) = compared("scores", random_columns("scores", 2), random_columns("scores", 3))
    assert (str(found), found.is_beyond, found.is_attachment) == ("scores: 2 rows, 3 there", True, False)
    artifacts = []
    for name, files in {"a": {"page.html": b"a"}, "b": {"page.html": b"b"}, "none": {}}.items():
        store = Store(tmp_path / name)
        artifacts.append((store, store.manifest(commit_rows(store, num_rows=2, attachments=files))))
    (found,) = compare_artifacts(*artifacts[0], *artifacts[1])
    assert (str(found), found.is_beyond, found.is_attachment) == ("page.html: other bytes", True, True)
    for first, second in ((0, 2), (2, 0)):
        (found,) = compare_artifacts(*artifacts[first], *artifacts[second])
        assert (str(found), found.is_beyond, found.is_missing) == ("page.html: is only in one", True, True)


def test_whole_numbers_far_apart_are_beyond_without_a_warning() -> None:
    first = random_columns("models", 1)
    first["array_shape"] = [np.array([2**31 - 1])]
    (found,) = compared("models", first, {**first, "array_shape": [np.array([1])]})
    assert (found.column, found.is_beyond) == ("array_shape", True)
