"""The same rows give the same bytes: in another process, with another hash seed, however they are cut into appends."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema import TABLES, Store
from storage_schema.parquet_files import ROW_GROUP_ROWS, TableWriter
from tests.builders.storage_rows import commit_rows, random_columns

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import sys
from storage_schema import TABLES, Store
from tests.builders.storage_rows import commit_rows
for name in TABLES:
    print(commit_rows(Store(sys.argv[1]), name, 40, stage="ingest", partition=name))
"""


def test_keys_and_digests_are_the_same_in_every_process(tmp_path: Path) -> None:
    outputs = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT, str(tmp_path / seed)],
            env={**os.environ, "PYTHONHASHSEED": seed, "OMP_NUM_THREADS": seed},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    ]
    store = Store(tmp_path / "here")
    here = [str(commit_rows(store, name, 40, stage="ingest", partition=name)) for name in TABLES]
    assert outputs[0].splitlines() == outputs[1].splitlines() == here


def test_row_groups_have_one_size_however_rows_come(tmp_path: Path) -> None:
    columns = random_columns("scores", 3 * ROW_GROUP_ROWS + 5)
    parts = []
    for number, step in enumerate((10**9, ROW_GROUP_ROWS, 999, 2 * ROW_GROUP_ROWS + 1)):
        writer = TableWriter(tmp_path / str(number), TABLES["scores"])
        for start in range(0, 3 * ROW_GROUP_ROWS + 5, step):
            writer.append({name: values[start : start + step] for name, values in columns.items()})
        parts.append(writer.finish())
    assert len(set(parts)) == 1
    metadata = pq.ParquetFile(tmp_path / "0").metadata
    groups = [metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)]
    assert groups == [ROW_GROUP_ROWS] * 3 + [5]


def test_a_writer_holds_a_bounded_number_of_rows_in_memory(tmp_path: Path) -> None:
    rows_bytes = 2500 * (204 * 2 + 102) * 4
    columns = random_columns("variants", 2500)
    columns = {**columns, "body22_m": columns["body22_m"].copy()}
    writer = TableWriter(tmp_path / "rows.parquet", TABLES["variants"])
    before = pa.total_allocated_bytes()
    held = []
    for _ in range(24):
        writer.append(columns)
        held.append(pa.total_allocated_bytes() - before)
    assert writer.finish().rows == 60_000
    # A row group's rows wait at most, once as given and once for moments as one piece; 24 appends would be 120 MB.
    assert max(held) < 4 * (ROW_GROUP_ROWS // 2500) * rows_bytes
