"""Descriptions of columns and tables: name, type, unit, shape and meaning, stated once for the whole project."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import partial

import pyarrow as pa

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_.-]{1,200}")


@dataclass(frozen=True)
class Column:
    """One column of a table.

    `shape` has the axes of a fixed-size numeric column, `axes` their names, and `joints` the skeleton of the joint
    axis. All are in the Parquet field metadata.
    """

    name: str
    meaning: str
    type: pa.DataType
    unit: str = ""
    shape: tuple[int, ...] = ()
    axes: tuple[str, ...] = ()
    joints: str = ""
    is_nullable: bool = False

    def __post_init__(self) -> None:
        """Refuse a column whose axes do not describe its shape."""
        if len(self.shape) != len(self.axes):
            raise ValueError(f"column '{self.name}': {len(self.shape)} axes in its shape but {len(self.axes)} names")

    def with_meaning(self, meaning: str, *, is_nullable: bool = False) -> Column:
        """Return the same column with its meaning in one table, or nullable there."""
        return replace(self, meaning=meaning, is_nullable=is_nullable)


@dataclass(frozen=True)
class Table:
    """A table: its columns in order, and the columns by which its rows are sorted."""

    name: str
    meaning: str
    columns: tuple[Column, ...]
    sorted_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse repeated columns and sort columns that do not exist."""
        names = [column.name for column in self.columns]
        if len(set(names)) != len(names):
            raise ValueError(f"table '{self.name}': a column is defined twice")
        unknown = set(self.sorted_by) - set(names)
        if unknown:
            raise ValueError(f"table '{self.name}': sorted by unknown columns {sorted(unknown)}")

    @property
    def id_columns(self) -> list[str]:
        """Return the columns with names of takes, sequences and variants, whose values are plain names."""
        return [column.name for column in self.columns if column.name.endswith("_id") and column.type == pa.string()]

    def column(self, name: str) -> Column:
        """Return the column of this name, or a KeyError that lists the known ones."""
        by_name = {column.name: column for column in self.columns}
        if name not in by_name:
            raise KeyError(f"table '{self.name}' has no column '{name}'; known columns: {', '.join(by_name)}")
        return by_name[name]


def is_plain_name(name: str) -> bool:
    """Return whether an id can safely be part of a file name on every system."""
    return _PLAIN_NAME.fullmatch(name) is not None


text = partial(Column, type=pa.string())
text_list = partial(Column, type=pa.list_(pa.string()))
integer = partial(Column, type=pa.int32())
boolean = partial(Column, type=pa.bool_())
float64 = partial(Column, type=pa.float64())
"""Columns of single values: NaN is a float value, null only occurs in nullable columns."""


def array(
    name: str,
    meaning: str,
    *,
    axes: dict[str, int] | None = None,
    unit: str = "",
    joints: str = "",
    dtype: pa.DataType | None = None,
) -> Column:
    """Describe a numeric array column: of fixed shape when `axes` (name -> length) is given, else a flat list."""
    named = axes or {}
    stored = pa.list_(dtype or pa.float32(), math.prod(named.values()) if named else -1)
    return Column(name, meaning, stored, unit, tuple(named.values()), tuple(named), joints)
