"""Any table as CSV: a line for each row, and a list of its columns."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.export_format import Export, ExportFormat, FileNames, write_text
from pasdedeux.plain_text import cell_text, csv_line
from pasdedeux.skeletons.working import WORKING_SKELETONS
from storage_schema import TABLES, TableData
from storage_schema.columns import Column


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a table: fixed arrays with a column for each number, named by axes; varying ones as JSON.

    `<table>_columns.csv` has a line for each of the table's columns: unit, axes and meaning.
    """
    names = FileNames(out)
    path, listed = (names.path(export.reference.table, *end, suffix=".csv") for end in ((), ("columns",)))
    columns = TABLES[export.reference.table].columns
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([cell_text(name) for column in columns for name in _names(column)])
        for batch in export.batches():
            cells = [_cells(column, batch) for column in columns]
            for index in range(batch.num_rows):
                writer.writerow([cell for column in cells for cell in column[index]])
    descriptions = (csv_line(column.name, column.unit, " ".join(column.axes), column.meaning) for column in columns)
    return [path, write_text(listed, "\n".join(["column,unit,axes,meaning", *descriptions]) + "\n")]


FORMAT = ExportFormat(_write)


def _names(column: Column) -> list[str]:
    names = [column.name]
    for axis, length in zip(column.axes, column.shape, strict=True):
        if axis == "joint" and column.joints in WORKING_SKELETONS:
            labels: tuple[str, ...] = WORKING_SKELETONS[column.joints].joint_names
        elif len(axis) == length:
            labels = tuple(axis)
        else:
            labels = tuple(map(str, range(length)))
        names = [f"{name}.{label}" for name in names for label in labels]
    return names


def _cells(column: Column, batch: TableData) -> list[list[Any]]:
    values = batch[column.name]
    if isinstance(values, list):
        return [[json.dumps(np.asarray(value).tolist())] for value in values]
    if column.shape:
        return values.reshape(batch.num_rows, math.prod(column.shape)).tolist()
    return [[cell_text(value) if isinstance(value, str) else value] for value in values.tolist()]
