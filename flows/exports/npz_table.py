"""Any table as an npz archive: an array for each column."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.export_format import Export, ExportFormat, FileNames
from storage_schema import TABLES
from storage_schema.table_data import concatenate


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write every column as an array; one of varying length as its values end to end and the rows' offsets."""
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
    path = FileNames(out).path(export.reference.table, suffix=".npz")
    np.savez_compressed(path, **arrays)
    return [path]


FORMAT = ExportFormat(_write)
