"""Any table as an npz archive: an array for each column, with joints, parents and units."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.export_format import Export, ExportFormat, FileNames
from pasdedeux.skeletons.working import WORKING_SKELETONS
from storage_schema import TABLES
from storage_schema.table_data import concatenate


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write every column as an array; varying rows as concatenated values with offsets.

    `<column>_unit` is a column's unit, `<skeleton>_joint_names` and `<skeleton>_parents` (-1 for the root) its joints.
    """
    rows = concatenate(TABLES[export.reference.table], export.batches())
    arrays: dict[str, Any] = {}
    for name in rows.column_names:
        values = rows[name]
        if isinstance(values, list):
            lengths = [len(value) for value in values]
            parts = [np.asarray(value) for value in values if len(value)]
            arrays[name] = np.concatenate(parts) if parts else np.empty(0)
            arrays[f"{name}_offsets"] = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64)
        elif values.dtype == object:
            arrays[name] = np.array(["" if value is None else value for value in values], dtype=np.str_)
        else:
            arrays[name] = values
    for column in rows.table.columns:
        if column.unit:
            arrays[f"{column.name}_unit"] = np.array(column.unit)
        if column.joints in WORKING_SKELETONS:
            skeleton = WORKING_SKELETONS[column.joints]
            arrays[f"{column.joints}_joint_names"] = np.array(skeleton.joint_names)
            arrays[f"{column.joints}_parents"] = np.array(skeleton.parents)
    path = FileNames(out).path(export.reference.table, suffix=".npz")
    np.savez_compressed(path, **arrays)
    return [path]


FORMAT = ExportFormat(_write)
