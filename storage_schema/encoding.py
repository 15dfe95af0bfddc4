"""Converts Python values to Arrow, with checks against the table's definition and one clear sentence on a misfit."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from types import NoneType
from typing import Any

import numpy as np
import pyarrow as pa

from storage_schema.arrow import ColumnKind, arrow_schema, column_kind, value_type
from storage_schema.columns import Column, Table
from storage_schema.errors import SchemaError

_EXACT_BELOW = 2.0**53
"""Whole numbers below this are exact as float64."""


def encode(table: Table, columns: Mapping[str, Any]) -> pa.Table:
    """Return the rows of a table as Arrow, in the order given.

    Args:
        table: Definition of the table.
        columns: For each column a list or array, rows first: (rows,) for single values, (rows, *axes) for arrays of a
            fixed shape, a list of 1-d arrays for arrays of varying length.  Text is str.  A nullable column may be left
            out or hold None (or NaN, for numbers); NaN is a value elsewhere.  Without any column the table has no rows.

    Numbers are narrowed to the column's type (float64 to float32); whole numbers are never rounded into it.

    Raises:
        SchemaError: A column is missing, unknown, of another length, shape or kind.
    """
    schema = arrow_schema(table)
    for name in columns:
        if name not in schema.names:
            near = difflib.get_close_matches(name, schema.names, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise SchemaError(
                f"table '{table.name}': unknown column '{name}'{hint} (known columns: {', '.join(schema.names)})"
            )
    if not columns:
        return schema.empty_table()
    arrays: list[pa.Array] = []
    for column, stored in zip(table.columns, schema.types, strict=True):
        try:
            arrays.append(_encode_column(column, columns, stored))
        except _MisfitError as misfit:
            raise SchemaError(f"table '{table.name}': column '{column.name}' {misfit}") from None
    return pa.Table.from_arrays(arrays, schema=schema)


def with_columns(table: Table, rows: pa.Table, columns: Mapping[str, Any]) -> pa.Table:
    """Return encoded rows of a table with other values in some columns, in the form of `encode`."""
    for column in table.columns:
        if column.name in columns:
            at = rows.schema.get_field_index(column.name)
            field = rows.schema.field(at)
            rows = rows.set_column(at, field, _encode_column(column, columns, field.type))
    return rows


def _encode_column(column: Column, columns: Mapping[str, Any], stored: pa.DataType) -> pa.Array:
    first = next(iter(columns))
    if column.name not in columns:
        if not column.is_nullable:
            raise _MisfitError("is missing")
        return pa.nulls(_num_rows(columns[first]), column.type)
    values = columns[column.name]
    if (num_rows := _num_rows(values)) != (wanted := _num_rows(columns[first])):
        raise _MisfitError(f"has {num_rows} rows but column '{first}' has {wanted}")
    encoders = {
        ColumnKind.FIXED: _fixed,
        ColumnKind.VARYING: _varying,
        ColumnKind.TEXT: _texts,
        ColumnKind.TEXT_LIST: _texts,
    }
    return encoders.get(column_kind(column), _numbers)(column, values, stored)


def _num_rows(values: Any) -> int:
    if isinstance(values, np.ma.MaskedArray):
        raise _MisfitError("is a masked array; give None or NaN where a value is missing")
    is_single = values.ndim == 0 if isinstance(values, np.ndarray) else isinstance(values, str | bytes)
    if is_single or not isinstance(values, np.ndarray | Sequence):
        raise _MisfitError(f"is given as {type(values).__name__}; a list or array of rows is needed")
    return len(values)


class _MisfitError(Exception):
    """The reason why values do not fit a column, without the column's name."""


def _fixed(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    axes = ", ".join(f"{name} {size}" for name, size in zip(column.axes, column.shape, strict=True))
    array = _array(values)
    if len(array) == 0:
        array = np.empty((0, *column.shape))
    if array.shape[1:] != column.shape:
        raise _MisfitError(f"has rows of shape {array.shape[1:]}; each row has the shape {column.shape} ({axes})")
    flat = _as_type(array.reshape(-1), value_type(column))
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=stored)


def _varying(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    rows = [_array(row) for row in values]
    for index, row in enumerate(rows):
        if row.ndim != 1:
            raise _MisfitError(f"has an array of shape {row.shape} in row {index}; flatten it to one axis")
    rows = [_as_type(row, value_type(column)) for row in rows]
    offsets = np.cumsum([0, *(len(row) for row in rows)])
    if offsets[-1] > np.iinfo(np.int32).max:
        raise _MisfitError(
            f"holds {offsets[-1]} numbers in one batch; at most {np.iinfo(np.int32).max} fit, append fewer rows"
        )
    flat = np.concatenate(rows) if rows else np.empty(0, value_type(column).to_pandas_dtype())
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pa.array(flat), type=stored)


def _texts(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    is_list = column_kind(column) is ColumnKind.TEXT_LIST
    kinds = set(map(type, values))
    are_texts = not is_list and all(
        issubclass(kind, str) or (kind is NoneType and column.is_nullable) for kind in kinds
    )
    for index, value in enumerate(() if are_texts else values):
        texts = value if is_list else [value]
        is_null = value is None and column.is_nullable
        if not (is_null or (isinstance(texts, list | tuple | np.ndarray) and all(isinstance(t, str) for t in texts))):
            raise _MisfitError(f"has {value!r} in row {index}; {'a list of texts' if is_list else 'text'} is needed")
    return pa.array(list(values), stored)


def _numbers(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    nulls = None
    if column.is_nullable:
        # The inverse of reading: a null number is read as NaN, so NaN and None are null here.
        listed = [np.nan if value is None else value for value in values]
        numbers = _array(listed)
        if numbers.ndim == 1 and numbers.dtype.kind == "f":
            nulls = np.isnan(numbers)
            numbers = np.where(nulls, 0, numbers)
            if pa.types.is_integer(stored) and np.all((numbers == np.rint(numbers)) & (np.abs(numbers) < _EXACT_BELOW)):
                numbers = numbers.astype(np.int64)
    else:
        numbers = _array(values)
    if numbers.ndim != 1:
        raise _MisfitError(f"has rows of shape {numbers.shape[1:]}; a single value a row is needed")
    if len(numbers) == 0:
        return pa.array([], stored)
    return pa.array(_as_type(numbers, stored), stored, mask=nulls)


def _array(values: Any) -> np.ndarray:
    try:
        return np.asarray(values)
    except ValueError:
        raise _MisfitError("has rows of different shapes") from None


def _as_type(array: np.ndarray, wanted: pa.DataType) -> np.ndarray:
    """Narrow numbers to the stored type; refuse changes of whole numbers, and numbers as truth values."""
    target = np.dtype(wanted.to_pandas_dtype())
    if len(array) == 0:
        return np.empty(0, target)
    allowed = {"f": "fiu", "i": "iu", "b": "b"}[target.kind]
    if array.dtype.kind not in allowed:
        fitting = {"f": int | float, "i": int, "b": bool}[target.kind]
        values = array.tolist()
        example = next((value for value in values if not isinstance(value, fitting)), values[0])
        needed = {"f": "numbers are", "i": "whole numbers are", "b": "true or false is"}[target.kind]
        raise _MisfitError(f"has values of type {array.dtype} such as {example!r}; {needed} needed")
    if target.kind == "i":
        limits = np.iinfo(target)
        if int(array.min()) < limits.min or int(array.max()) > limits.max:
            raise _MisfitError(
                f"has values from {array.min()} to {array.max()}; {target} holds {limits.min} to {limits.max}"
            )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=target)
