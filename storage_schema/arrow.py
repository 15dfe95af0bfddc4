"""Tables as Arrow schemas: types, shapes, units, axes, joint names and meanings in the field metadata."""

from __future__ import annotations

import hashlib
import json
from enum import Enum
from functools import cache

import pyarrow as pa

from storage_schema.columns import Column, Table
from storage_schema.joints import JOINT_NAMES
from storage_schema.keys import canonical_json
from storage_schema.version import SCHEMA_VERSION


class ColumnKind(Enum):
    """Python form of a column's values."""

    TEXT = "text"
    TEXT_LIST = "list of texts"
    BOOLEAN = "truth values"
    INTEGER = "whole numbers"
    FLOAT = "numbers"
    FIXED = "array of fixed shape"
    VARYING = "arrays of varying length"


def column_kind(column: Column) -> ColumnKind:
    """Return the Python form of a column's values."""
    if pa.types.is_fixed_size_list(column.type):
        return ColumnKind.FIXED
    if pa.types.is_list(column.type):
        return ColumnKind.TEXT_LIST if pa.types.is_string(column.type.value_type) else ColumnKind.VARYING
    if pa.types.is_string(column.type):
        return ColumnKind.TEXT
    if pa.types.is_boolean(column.type):
        return ColumnKind.BOOLEAN
    return ColumnKind.INTEGER if pa.types.is_integer(column.type) else ColumnKind.FLOAT


def value_type(column: Column) -> pa.DataType:
    """Return the type of a column's single numbers or texts."""
    return column.type.value_type if pa.types.is_nested(column.type) else column.type


@cache
def arrow_schema(table: Table) -> pa.Schema:
    """Return the Arrow schema of a table, for writing and reading its files.

    Field metadata: `meaning`, `unit`, and for arrays `shape` and `axes` (JSON lists), `joints` (name of the skeleton)
    and `joint_names` (JSON list).  Schema metadata: `table`, `meaning`, `sorted_by` (JSON list) and `schema_version`.
    """
    metadata = {
        "table": table.name,
        "meaning": table.meaning,
        "sorted_by": json.dumps(table.sorted_by),
        "schema_version": str(SCHEMA_VERSION),
    }
    return pa.schema([_field(column) for column in table.columns], metadata=metadata)


@cache
def schema_digest(table: Table) -> str:
    """Return a short digest of a table's columns, without their meanings."""
    described = [
        [c.name, str(c.type), c.unit, c.shape, c.axes, c.joints, list(JOINT_NAMES.get(c.joints, ())), c.is_nullable]
        for c in table.columns
    ]
    return hashlib.sha256(canonical_json(described)).hexdigest()[:16]


def _field(column: Column) -> pa.Field:
    metadata = {"meaning": column.meaning, "unit": column.unit}
    if column.shape:
        metadata |= {"shape": json.dumps(column.shape), "axes": json.dumps(column.axes)}
    if column.joints:
        metadata |= {"joints": column.joints, "joint_names": json.dumps(JOINT_NAMES[column.joints])}
    metadata = {name: text for name, text in metadata.items() if text}
    return pa.field(column.name, _stored_type(column), nullable=column.is_nullable, metadata=metadata)


def _stored_type(column: Column) -> pa.DataType:
    """Return the column's type with elements that are never null; a missing number inside an array is NaN."""
    kind = column_kind(column)
    if kind is ColumnKind.FIXED:
        return pa.list_(pa.field("element", column.type.value_type, nullable=False), column.type.list_size)
    if kind in (ColumnKind.VARYING, ColumnKind.TEXT_LIST):
        return pa.list_(pa.field("element", column.type.value_type, nullable=False))
    return column.type
