"""Store columns of every kind and read them back; refuse any other value in one sentence."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from storage_schema import TABLES, SchemaError
from storage_schema.arrow import arrow_schema
from storage_schema.columns import Table, array, boolean, float64, integer, text, text_list
from storage_schema.encoding import encode
from storage_schema.parquet_files import TableWriter, iter_table, read_table
from storage_schema.table_data import TableData
from tests.builders.storage_rows import assert_same_values, random_columns

ANY = Table(
    name="any",
    meaning="One column of every kind.",
    columns=(
        text("word", "Text"),
        text("word_or_null", "Text", is_nullable=True),
        text_list("words", "Texts"),
        boolean("flag", "Truth"),
        integer("whole", "Whole number"),
        integer("whole_or_null", "Whole number", is_nullable=True),
        float64("number", "Number"),
        float64("number_or_null", "Number", is_nullable=True),
        array("fixed", "Numbers", axes={"row": 2, "column": 3}),
        array("fixed_whole", "Whole numbers", axes={"item": 2}, dtype=pa.int64()),
        array("varying", "Numbers"),
        array("varying_whole", "Whole numbers", dtype=pa.int32()),
    ),
)

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
INT32 = st.integers(-(2**31), 2**31 - 1)
FLOAT32 = st.floats(width=32)
ROW = st.fixed_dictionaries(
    {
        "word": TEXT,
        "word_or_null": st.none() | TEXT,
        "words": st.lists(TEXT, max_size=3),
        "flag": st.booleans(),
        "whole": INT32,
        "whole_or_null": st.none() | INT32,
        "number": st.floats(),
        "number_or_null": st.none() | st.floats(allow_nan=False),
        "fixed": st.lists(st.lists(FLOAT32, min_size=3, max_size=3), min_size=2, max_size=2),
        "fixed_whole": st.lists(st.integers(-(2**63), 2**63 - 1), min_size=2, max_size=2),
        "varying": st.lists(FLOAT32, max_size=4),
        "varying_whole": st.lists(INT32, max_size=4),
    }
)


def write_and_read(columns: dict, table: Table = ANY, cuts: tuple[int, ...] = ()) -> tuple[TableData, bytes]:
    num_rows = len(next(iter(columns.values())))
    edges = [0, *sorted(min(cut, num_rows) for cut in cuts), num_rows]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.parquet"
        writer = TableWriter(path, table)
        for start, stop in pairwise(edges):
            writer.append({name: values[start:stop] for name, values in columns.items()})
        part = writer.finish()
        assert part.rows == num_rows
        assert sum(batch.num_rows for batch in iter_table(path, table)) == num_rows
        return read_table(path, table), path.read_bytes()


@given(st.lists(ROW, max_size=6), st.tuples(st.integers(0, 6), st.integers(0, 6)))
@settings(max_examples=60, deadline=None)
def test_every_row_comes_back_as_it_was_given_and_is_written_again_with_the_same_bytes(
    rows: list[dict], cuts: tuple[int, int]
) -> None:
    columns = {column.name: [row[column.name] for row in rows] for column in ANY.columns}
    found, data = write_and_read(columns)
    assert found.num_rows == len(rows)
    assert found.rows.schema.equals(arrow_schema(ANY), check_metadata=True)
    for name, values in columns.items():
        assert_same_values(found[name], values)
    assert write_and_read(columns, cuts=cuts)[1] == data
    assert write_and_read({name: found[name] for name in found})[1] == data, "what was read is written the same"


@pytest.mark.parametrize("name", TABLES)
def test_no_column_at_all_is_a_table_without_rows(name: str) -> None:
    assert encode(TABLES[name], {}).equals(encode(TABLES[name], random_columns(name, 0)), check_metadata=True)


JUNK = st.one_of(
    st.none(),
    st.integers(),
    st.floats(),
    TEXT,
    st.booleans(),
    st.binary(max_size=3),
    st.lists(st.one_of(st.none(), st.integers(), st.floats(), TEXT, st.lists(st.integers(), max_size=2)), max_size=4),
    st.just(np.zeros(())),
    st.just(np.array([1, 2], dtype="datetime64[s]")),
    st.just([np.zeros(2), {}]),
    st.just([object(), 1]),
)


@given(st.sampled_from([column.name for column in ANY.columns]), JUNK)
@example("whole_or_null", [None, 2.0**63])
@example("words", np.array([1, 2], dtype="datetime64[s]"))
@example("flag", [np.zeros(2), {}])
@settings(max_examples=300, deadline=None)
def test_any_value_is_either_stored_or_refused_in_one_sentence(name: str, junk: object) -> None:
    columns = random_columns(ANY, 2)
    try:
        stored = encode(ANY, columns | {name: junk})
    except SchemaError:
        with pytest.raises(SchemaError, match=r"table 'any': column '.*' (has|is given as) "):
            encode(ANY, columns | {name: junk})
    else:
        assert stored.num_rows == 2
