from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pytest

from pasdedeux.skeletons import WORKING_SKELETONS
from storage_schema import TABLES
from storage_schema.arrow import arrow_schema, schema_digest
from storage_schema.columns import Table, array, integer, text
from storage_schema.dictionary import DICTIONARY_PATH, data_dictionary
from storage_schema.joints import JOINT_NAMES
from tasks.rows.figures import COLUMNS_PATH, figure_columns


def test_joint_names_are_those_of_the_working_skeletons() -> None:
    assert {name: skeleton.joint_names for name, skeleton in WORKING_SKELETONS.items()} == JOINT_NAMES


def test_the_data_dictionary_is_up_to_date() -> None:
    assert DICTIONARY_PATH.read_text(encoding="utf-8") == data_dictionary(), "run python -m storage_schema.dictionary"


def test_the_columns_of_figures_are_those_that_the_science_declares() -> None:
    assert COLUMNS_PATH.read_text(encoding="utf-8") == figure_columns(), "run python -m tasks.rows.figures"


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_a_schema_carries_meaning_unit_shape_and_joints_of_every_column(table: Table) -> None:
    schema = arrow_schema(table)
    assert schema.metadata[b"table"].decode() == table.name
    assert json.loads(schema.metadata[b"sorted_by"]) == list(table.sorted_by)
    assert schema.names == [column.name for column in table.columns]
    for column in table.columns:
        stored = schema.field(column.name)
        metadata = {key.decode(): value.decode() for key, value in (stored.metadata or {}).items()}
        assert metadata["meaning"] == column.meaning
        assert metadata.get("unit", "") == column.unit
        assert stored.nullable == column.is_nullable
        if column.shape:
            assert stored.type.list_size == np.prod(column.shape)
            assert json.loads(metadata["shape"]) == list(column.shape)
            assert json.loads(metadata["axes"]) == list(column.axes)
        if column.joints:
            assert json.loads(metadata["joint_names"]) == list(WORKING_SKELETONS[column.joints].joint_names)
            assert column.shape[column.axes.index("joint")] == len(JOINT_NAMES[column.joints])


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_every_column_has_a_meaning_and_units_are_in_names(table: Table) -> None:
    for column in table.columns:
        assert column.meaning
        units = {"_m_s": "m/s", "_m": "m", "_px": "px", "_rad": "rad", "_hz": "Hz", "_s": "s"}
        stated = [unit for suffix, unit in units.items() if column.name.endswith(suffix)]
        assert not stated or column.unit == stated[0], column.name


def test_the_schema_digest_follows_the_columns_and_not_the_words() -> None:
    def digest(*columns: object, meaning: str = "Rows.") -> str:
        return schema_digest(Table(name="t", meaning=meaning, columns=columns))  # type: ignore[arg-type]

    before = digest(integer("a", "One"), array("b", "Two", axes={"xyz": 3}))
    assert before == digest(integer("a", "Other words"), array("b", "Two", axes={"xyz": 3}), meaning="Other.")
    changed = [
        digest(integer("a", "One", is_nullable=True), array("b", "Two", axes={"xyz": 3})),
        digest(integer("a", "One"), array("b", "Two", axes={"xyz": 3}, dtype=pa.float64())),
        digest(integer("a", "One"), array("b", "Two", axes={"x": 3, "y": 1})),
        digest(text("a", "One"), array("b", "Two", axes={"xyz": 3})),
        digest(array("b", "Two", axes={"xyz": 3}), integer("a", "One")),
    ]
    assert before not in changed
    assert len(set(changed)) == len(changed)
