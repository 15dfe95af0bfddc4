"""The data dictionary: every table and column in Markdown; `python -m storage_schema.dictionary` writes it."""

from __future__ import annotations

from pathlib import Path

from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.columns import Column, Table
from storage_schema.comparison import tolerances_text
from storage_schema.joints import JOINT_NAMES
from storage_schema.tables import TABLES
from storage_schema.version import SCHEMA_VERSION

DICTIONARY_PATH = Path(__file__).with_name("DATA_DICTIONARY.md")

_PREAMBLE = f"""# Data dictionary

Written by `python -m storage_schema.dictionary` from `storage_schema/tables/`; do not edit.
Schema version {SCHEMA_VERSION}.

Tables are Parquet files; a shard's part of a table is `<store>/<stage>/<key[:2]>/<key>/<table>.parquet`. From Python,
`storage_schema.open_table("poses:duets/waltz", "store")` gives the rows of a partition as numpy arrays by column.

World axes are right-handed with Y up; lengths are in metres, angles in radians, times in
seconds, except where a column says otherwise. 2D columns in pixels have x to the right and y down. Quaternions are unit
quaternions (x, y, z, w). An array of a fixed shape is a fixed-size list, row-major over the axes named here; the same
shape, axes, joint names and unit stand in the field's metadata. Only columns marked *null* may be null; a number that
is missing inside an array is NaN.

Computed again on another platform (`pasdedeux rerun`), other numbers than whole ones count as the same within their
tolerance: {tolerances_text()}.
"""


def data_dictionary() -> str:
    """Return the data dictionary of all tables as Markdown."""
    contents = "\n".join(f"- [`{table.name}`](#{table.name}): {table.meaning}" for table in TABLES.values())
    tables = "\n".join(_table(table) for table in TABLES.values())
    joints = "\n".join(f"- `{name}`: {', '.join(names)}" for name, names in JOINT_NAMES.items())
    return f"{_PREAMBLE}\n## Tables\n\n{contents}\n\n{tables}\n## Joints\n\n{joints}\n"


def main() -> None:
    """Write the data dictionary beside this module."""
    DICTIONARY_PATH.write_text(data_dictionary(), encoding="utf-8")


def _table(table: Table) -> str:
    order = ", ".join(f"`{name}`" for name in table.sorted_by)
    lines = [
        f"## {table.name}",
        "",
        table.meaning + (f" Rows come by {order}." if order else ""),
        "",
        "| column | type | axes | unit | meaning |",
        "|---|---|---|---|---|",
        *(_column(column) for column in table.columns),
        "",
    ]
    return "\n".join(lines)


def _column(column: Column) -> str:
    kind = column_kind(column)
    element = str(value_type(column)).replace("double", "float64").replace("float", "float32")
    element = element.replace("float3264", "float64")
    type_text = f"list of {element}" if kind in (ColumnKind.VARYING, ColumnKind.TEXT_LIST) else element
    if column.is_nullable:
        type_text += ", *null*"
    axes = " x ".join(f"{name} {size}" for name, size in zip(column.axes, column.shape, strict=True))
    if column.joints:
        axes += f" ({column.joints})"
    return f"| `{column.name}` | {type_text} | {axes} | {column.unit} | {column.meaning} |"


if __name__ == "__main__":
    main()
