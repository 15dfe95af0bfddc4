"""The loader of windows compared with plain reading by pyarrow, and with the loader of `datasets`."""

from __future__ import annotations

import importlib
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from benchmarks.benchmark import BenchmarkResult, Rate, measure_rate
from pasdedeux.choreography.duets import make_duet
from storage_schema import TABLES, Manifest, ShardRecord, SourceCredit, Store, artifact_key, record_latest, table_files
from storage_schema.arrow import ColumnKind, column_kind, value_type
from tasks.stage.facts import TakeFacts, VariantFacts
from tasks.windows import PairDataset, PairStream

_TAKES, _VARIANTS, _FRAMES, _WINDOW, _RATE_HZ = 16, 40, 150, 30, 30.0
_COLUMNS = ["body22_m", "body22_unitquat"]
_MADE_UP = SourceCredit("made up", "CC0", "made up for benchmarks")
_ROWS_OF_DATASETS = 3_000
"""Rows that `datasets` reads in a repeat, few because it is slow."""


def _rows(table: str, count: int, **given: Any) -> dict[str, Any]:
    """Return rows of a table, with zeros and empty texts where nothing is given."""
    empty = {ColumnKind.TEXT: "", ColumnKind.TEXT_LIST: [], ColumnKind.VARYING: np.zeros(0)}
    columns: dict[str, Any] = {}
    for column in TABLES[table].columns:
        kind = column_kind(column)
        zeros = np.zeros((count, *column.shape), value_type(column).to_pandas_dtype()) if kind not in empty else None
        columns[column.name] = [empty[kind]] * count if zeros is None else zeros
    return columns | given


def _commit(store: Store, stage: str, name: str, tables: dict[str, Any], facts: Any, *inputs: Manifest) -> Manifest:
    key = artifact_key(stage=stage, version=1, parameters={"name": name}, input_digests=[], seed=0)
    described: dict[str, Any] = {
        "key": key,
        "partition": name,
        "name": name,
        "version": 1,
        "parameters": {"name": name},
    }
    described |= {
        "seed": 0,
        "inputs": [manifest.ref for manifest in inputs],
        "files": [],
        "sources": [SourceCredit("made up", "CC0", "")],
    }
    return store.manifest(store.commit(stage=stage, tables=tables, facts=facts.to_json(), **described))


def _add_take(store: Store, number: int) -> tuple[Manifest, Manifest]:
    """Commit a waltz, and variants of its size at other places."""
    name, rng = f"take-{number}", np.random.default_rng(number)
    people_m = make_duet("waltz", duration_s=_FRAMES / _RATE_HZ, rate_hz=_RATE_HZ).positions_m()
    frames, variants = len(people_m), [f"v{at}" for at in range(_VARIANTS)]
    still = np.tile(np.array([0.0, 0.0, 0.0, 1.0]), (2 * frames, 22, 1))
    places = {"take_id": [name] * 2 * frames, "person": np.repeat([0, 1], frames), "frame": np.tile(range(frames), 2)}
    motion = {"body22_m": people_m.swapaxes(0, 1).reshape(-1, 22, 3), "body22_world_unitquat": still}
    people = _rows("takes", 2, take_id=[name] * 2, person=[0, 1], body22_rest_m=people_m[0] - people_m[0, :, :1])
    counts = {"takes": (name,), "take_id": name, "num_persons": 2, "num_frames": frames, "rate_hz": _RATE_HZ}
    tables = {"poses": _rows("poses", 2 * frames, **places, **motion), "takes": people}
    take = _commit(store, "ingest", name, tables, TakeFacts(**counts))
    unitquats = rng.normal(size=(2 * frames * _VARIANTS, 22, 4))
    unitquats /= np.linalg.norm(unitquats, axis=-1, keepdims=True)
    moved = np.concatenate([people_m + rng.normal(0.0, 0.1, 3) for _ in variants]).reshape(-1, 22, 3)
    rows = _rows(
        "variants",
        len(moved),
        take_id=[name] * len(moved),
        variant_id=np.repeat(variants, 2 * frames),
        frame=np.tile(np.repeat(range(frames), 2), _VARIANTS),
        person=np.tile([0, 1], len(moved) // 2),
        body22_m=moved,
        body22_unitquat=unitquats,
    )
    said = {"variant_id": variants, "verdict": ["pass"] * _VARIANTS, "bone_scale": [np.ones(44)] * _VARIANTS}
    quality = _rows("variant_quality", _VARIANTS, take_id=[name] * _VARIANTS, **said)
    tables = {"variants": rows, "variant_quality": quality}
    return take, _commit(store, "augmentation", name, tables, VariantFacts(**counts, variants=tuple(variants)), take)


@contextmanager
def _drawn() -> Iterator[Store]:
    """Give a store of takes and variants, whose clips are unpacked beside it."""
    with tempfile.TemporaryDirectory() as folder:
        store, before = Store(Path(folder) / "store"), os.environ.get("PASDEDEUX_CACHE")
        takes = [_add_take(store, number) for number in range(_TAKES)]
        stages = dict(zip(("ingest", "augmentation"), zip(*takes, strict=True), strict=True))
        records = {
            stage: [ShardRecord.of(manifest, store) for manifest in manifests] for stage, manifests in stages.items()
        }
        record_latest(store, "bench", "none", records)
        os.environ["PASDEDEUX_CACHE"] = folder
        try:
            yield store
        finally:
            os.environ.pop("PASDEDEUX_CACHE")
            os.environ |= {} if before is None else {"PASDEDEUX_CACHE": before}


def _with_pyarrow(files: list[Path]) -> None:
    for path in files:
        file = pq.ParquetFile(path)
        for group in range(file.num_row_groups):
            rows = file.read_row_group(group, columns=_COLUMNS, use_threads=False)
            for name in _COLUMNS:
                rows[name].combine_chunks().flatten().to_numpy()


def _with_datasets(files: list[Path]) -> None:
    rows = importlib.import_module("datasets").load_dataset(
        "parquet", data_files=[str(path) for path in files], streaming=True, columns=_COLUMNS
    )
    for _ in islice(rows["train"].shuffle(seed=0, buffer_size=1_000).with_format("numpy"), _ROWS_OF_DATASETS):
        pass


def _beside(name: str, other: Callable[[list[Path]], None], label: str, rows: int) -> BenchmarkResult:
    """Measure shuffled windows of all arrays, and a reader of so many rows, two per frame, each frame in one window."""
    with _drawn() as store:
        windows = PairDataset("variants:bench", _WINDOW, store=store)
        stream, files = PairStream(windows, 64), table_files("variants:bench", store)
        fast = measure_rate("PairStream, shuffled", lambda: sum(1 for _ in stream), count=len(windows), repeats=5)
        plain = Rate("no `datasets` is installed, PairStream", fast.per_s)
        if label != "datasets" or find_spec("datasets"):
            plain = measure_rate(label, lambda: other(files), count=rows // (2 * _WINDOW))
        size_mb = sum(path.stat().st_size for path in files) / 1e6
        return BenchmarkResult(
            name,
            f"windows of {_WINDOW} frames",
            *fast,
            *plain,
            f"{_TAKES * _VARIANTS} clips of {_FRAMES} frames, {size_mb:.0f} MB of Parquet; {len(windows.fields)} "
            "arrays, half a window of stride, batches of 64",
        )


_ALL_ROWS = _TAKES * _VARIANTS * _FRAMES * 2
BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "beside pyarrow": lambda: _beside("windows, pyarrow", _with_pyarrow, "pyarrow in order, not cut", _ALL_ROWS),
    "beside datasets": lambda: _beside("windows, datasets", _with_datasets, "datasets", _ROWS_OF_DATASETS),
}
