"""Random rows that fit a table's definition, and short ways to commit them; for the tests of the store."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from storage_schema import TABLES, ArtifactRef, Manifest, SourceCredit, Store, artifact_key
from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.columns import Table

MADE_UP = SourceCredit("made up", "CC0", "made up for tests")
_WORDS = np.array(["waltz", "hug", "judo", "push", "", "Tänzer Ω", "a,b|c"], dtype=object)


def random_columns(table: str | Table, num_rows: int, seed: int = 0) -> dict[str, Any]:
    """Return random values of every column: NaN in floats, nulls in nullable columns, empty and long lists."""
    definition = TABLES[table] if isinstance(table, str) else table
    rng = np.random.default_rng(seed)
    return {column.name: _values(column, num_rows, rng) for column in definition.columns}


def _values(column: Any, num_rows: int, rng: np.random.Generator) -> Any:
    kind = column_kind(column)
    if kind is ColumnKind.TEXT:
        texts = rng.choice(_WORDS, num_rows).tolist()
        return [None if column.is_nullable and rng.random() < 0.3 else text for text in texts]
    if kind is ColumnKind.TEXT_LIST:
        return [rng.choice(_WORDS, rng.integers(0, 4)).tolist() for _ in range(num_rows)]
    if kind is ColumnKind.FIXED:
        return _numbers(value_type(column), (num_rows, *column.shape), rng)
    if kind is ColumnKind.VARYING:
        return [_numbers(value_type(column), (int(rng.integers(0, 9)),), rng) for _ in range(num_rows)]
    numbers = _numbers(value_type(column), (num_rows,), rng)
    if column.is_nullable:
        return [None if rng.random() < 0.3 else number for number in numbers.tolist()]
    return numbers


def _numbers(arrow_type: Any, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    dtype = np.dtype(arrow_type.to_pandas_dtype())
    if dtype.kind == "b":
        return rng.random(shape) < 0.5
    if dtype.kind == "i":
        return rng.integers(-1000, 1000, shape, dtype=dtype)
    values = rng.normal(size=shape).astype(dtype)
    values[rng.random(shape) < 0.05] = np.nan
    return values


def commit_rows(
    store: Store,
    table: str = "scores",
    num_rows: int = 5,
    *,
    stage: str = "evaluation",
    partition: str = "all",
    name: str = "0",
    seed: int = 0,
    inputs: tuple[ArtifactRef, ...] = (),
    files: tuple[tuple[str, str], ...] = (),
    sources: tuple[SourceCredit, ...] = (),
    version: int = 1,
    **more: Any,
) -> ArtifactRef:
    """Commit random rows of one table; the same arguments give the same key and the same bytes."""
    parameters = {"partition": partition, "name": name, "num_rows": num_rows}
    digests = [ref.content_digest for ref in inputs] + [digest for _, digest in files]
    key = artifact_key(stage=stage, version=version, parameters=parameters, input_digests=digests, seed=seed)
    return store.commit(
        stage=stage,
        key=key,
        partition=partition,
        name=name,
        version=version,
        parameters=parameters,
        seed=seed,
        inputs=inputs,
        files=files,
        tables={table: random_columns(table, num_rows, seed)},
        sources=sources,
        **more,
    )


def list_as_of_schema_1(dataset: Path) -> None:
    """Let the list of a dataset be as schema 1 had it, which knew no credits."""
    path = dataset / "dataset.json"
    values = json.loads(path.read_text()) | {"schema_version": 1}
    path.write_text(json.dumps({name: value for name, value in values.items() if name != "sources"}))


def edit_json(path: Path, *names: str, **changes: Any) -> None:
    """Change values of a file, or of the part of it that names lead to."""
    values = part = json.loads(path.read_text())
    for name in names:
        part = part[name]
    part.update(changes)
    path.write_text(json.dumps(values))


def assert_same_values(values: Any, given: Any) -> None:
    """Assert that a column read back holds what was given; None and NaN are equal in nullable number columns."""
    if isinstance(values, np.ndarray) and values.dtype != object:
        if isinstance(given, list):
            given = np.array([np.nan if value is None else value for value in given])
        np.testing.assert_array_equal(values, np.asarray(given).astype(values.dtype).reshape(values.shape))
    elif isinstance(values, np.ndarray):
        assert values.tolist() == list(given)
    else:
        assert len(values) == len(given)
        for value, expected in zip(values, given, strict=True):
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, expected)
            else:
                assert value == expected


def put(
    store: Store,
    stage: str,
    name: str,
    tables: dict[str, Any],
    facts: dict[str, Any],
    inputs: tuple[Manifest, ...] = (),
    source: SourceCredit = MADE_UP,
    files: tuple[tuple[str, str], ...] = (),
    **told: Any,
) -> Manifest:
    """Commit what an earlier stage would have written, with further parameters."""
    ref = store.commit(
        stage=stage,
        key=artifact_key(stage=stage, version=1, parameters={"name": name}, input_digests=[], seed=0),
        partition=name,
        name=name,
        version=1,
        parameters={"name": name, **told},
        seed=0,
        inputs=[manifest.ref for manifest in inputs],
        files=files,
        tables=tables,
        facts=facts,
        sources=[source],
    )
    return store.manifest(ref)


def having(table: str, manifests: Iterable[Manifest]) -> list[Manifest]:
    """Return the artifacts that have a table."""
    return [manifest for manifest in manifests if table in manifest.tables]


def take_rows(
    take_id: str, num_persons: int, num_frames: int, *, rate_hz: float = 30.0, is_held_out: bool = False, **given: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return columns of the table poses, person after person, zeros where nothing is given, and the facts of a take."""
    count = num_persons * num_frames
    frame = np.tile(np.arange(num_frames), num_persons)
    columns = {
        "take_id": [take_id] * count,
        "person": np.repeat(np.arange(num_persons), num_frames),
        "frame": frame,
        "time_s": frame / rate_hz,
        "root_translation_m": np.zeros((count, 3)),
        "local_unitquat": [np.zeros(4)] * count,
        "pair17_m": np.zeros((count, 17, 3)),
        "op14_m": np.zeros((count, 14, 3)),
        "body22_m": np.zeros((count, 22, 3)),
        "body22_world_unitquat": np.zeros((count, 22, 4)),
    }
    facts = {"kind": "take", "take_id": take_id, "takes": [take_id], "rate_hz": rate_hz, "is_held_out": is_held_out}
    return {**columns, **given}, {**facts, "is_prior": False, "num_persons": num_persons, "num_frames": num_frames}
