"""Python values into Arrow: checked against the table's definition, with one clear sentence when they do not fit."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from storage_schema.arrow import Kind, arrow_schema, column_kind, value_type
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
            out or hold None (or NaN, for numbers); NaN is a value elsewhere.  No column at all is a table without rows.

    Numbers are narrowed to the column's type (float64 to float32); whole numbers are never rounded into it.

    Raises:
        SchemaError: A column is missing, unknown, of another length, shape or kind.
    """
    unknown = [name for name in columns if name not in {column.name for column in table.columns}]
    if unknown:
        raise SchemaError(_unknown_column(table, unknown[0]))
    if not columns:
        return arrow_schema(table).empty_table()
    rows = {name: _num_rows(table, name, values) for name, values in columns.items()}
    for column in table.columns:
        if column.name not in columns and not column.is_nullable:
            raise SchemaError(f"table '{table.name}': column '{column.name}' is missing")
    num_rows = next(iter(rows.values()))
    for name, found in rows.items():
        if found != num_rows:
            first = next(iter(rows))
            raise SchemaError(
                f"table '{table.name}': column '{name}' has {found} rows but column '{first}' has {num_rows}"
            )
    schema = arrow_schema(table)
    arrays = [
        _encode_column(table, column, columns[column.name], schema.field(column.name).type)
        if column.name in columns
        else pa.nulls(num_rows, column.type)
        for column in table.columns
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _unknown_column(table: Table, name: str) -> str:
    known = [column.name for column in table.columns]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"table '{table.name}': unknown column '{name}'{hint} (known columns: {', '.join(known)})"


def _num_rows(table: Table, name: str, values: Any) -> int:
    if isinstance(values, np.ma.MaskedArray):
        raise SchemaError(
            f"table '{table.name}': column '{name}' is a masked array; give None or NaN where a value is missing"
        )
    if isinstance(values, np.ndarray) and values.ndim:
        return len(values)
    if isinstance(values, Sequence) and not isinstance(values, str | bytes):
        return len(values)
    raise SchemaError(
        f"table '{table.name}': column '{name}' is given as {type(values).__name__}; a list or array of rows is needed"
    )


def _encode_column(table: Table, column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    kind = column_kind(column)
    try:
        if kind is Kind.FIXED:
            return _fixed(column, values, stored)
        if kind is Kind.VARYING:
            return _varying(column, values, stored)
        if kind is Kind.TEXT:
            return pa.array(_texts(column, values), stored)
        if kind is Kind.TEXT_LIST:
            return _text_lists(column, values, stored)
        return _numbers(column, kind, values, stored)
    except _MisfitError as misfit:
        raise SchemaError(f"table '{table.name}': column '{column.name}' {misfit}") from None


class _MisfitError(Exception):
    """Why values do not fit a column, without saying which."""


def _fixed(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    axes = ", ".join(f"{name} {size}" for name, size in zip(column.axes, column.shape, strict=True))
    found = _array(values)
    if len(found) == 0:
        found = np.empty((0, *column.shape))
    if found.shape[1:] != column.shape:
        raise _MisfitError(f"has rows of shape {found.shape[1:]}; each row has the shape {column.shape} ({axes})")
    flat = _as_type(found.reshape(-1), value_type(column))
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


def _texts(column: Column, values: Any) -> list[str | None]:
    texts: list[str | None] = []
    for index, value in enumerate(values):
        if value is None and column.is_nullable:
            texts.append(None)
        elif isinstance(value, str):
            texts.append(str(value))
        else:
            raise _MisfitError(f"has {value!r} in row {index}; text is needed")
    return texts


def _text_lists(column: Column, values: Any, stored: pa.DataType) -> pa.Array:
    rows: list[list[str]] = []
    for index, row in enumerate(values):
        if not isinstance(row, list | tuple | np.ndarray) or not all(isinstance(item, str) for item in row):
            raise _MisfitError(f"has {row!r} in row {index}; a list of texts is needed")
        rows.append([str(item) for item in row])
    return pa.array(rows, stored)


def _numbers(column: Column, kind: Kind, values: Any, stored: pa.DataType) -> pa.Array:
    nulls = None
    if column.is_nullable:
        # The inverse of reading: a null number reads as NaN, so NaN and None are null here.
        listed = [np.nan if value is None else value for value in values]
        found = _array(listed)
        if found.ndim == 1 and found.dtype.kind == "f":
            nulls = np.isnan(found)
            found = np.where(nulls, 0, found)
            if kind is Kind.INTEGER and np.all((found == np.rint(found)) & (np.abs(found) < _EXACT_BELOW)):
                found = found.astype(np.int64)
    else:
        found = _array(values)
    if found.ndim != 1:
        raise _MisfitError(f"has rows of shape {found.shape[1:]}; a single value a row is needed")
    if len(found) == 0:
        return pa.array([], stored)
    return pa.array(_as_type(found, stored), stored, mask=nulls)


def _array(values: Any) -> np.ndarray:
    try:
        return np.asarray(values)
    except ValueError:
        raise _MisfitError("has rows of different shapes") from None


def _as_type(found: np.ndarray, wanted: pa.DataType) -> np.ndarray:
    """Narrow numbers to the stored type, refusing what would change a whole number or invent a truth value."""
    target = np.dtype(wanted.to_pandas_dtype())
    if len(found) == 0:
        return np.empty(0, target)
    allowed = {"f": "fiu", "i": "iu", "b": "b"}[target.kind]
    if found.dtype.kind not in allowed:
        fitting = {"f": int | float, "i": int, "b": bool}[target.kind]
        values = found.tolist()
        example = next((value for value in values if not isinstance(value, fitting)), values[0])
        needed = {"f": "numbers are", "i": "whole numbers are", "b": "true or false is"}[target.kind]
        raise _MisfitError(f"has values of type {found.dtype} such as {example!r}; {needed} needed")
    if target.kind == "i":
        limits = np.iinfo(target)
        if int(found.min()) < limits.min or int(found.max()) > limits.max:
            raise _MisfitError(
                f"has values from {found.min()} to {found.max()}; {target} holds {limits.min} to {limits.max}"
            )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(found, dtype=target)
