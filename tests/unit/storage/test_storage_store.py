from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from storage_schema import (
    ArtifactRef,
    CorruptArtifact,
    MissingArtifact,
    SchemaError,
    ShardRecord,
    SourceCredit,
    StorageError,
    Store,
    artifact_key,
    create_dataset,
    record_latest,
    source_credits,
)
from storage_schema.errors import NewerSchema
from storage_schema.folder_store import FolderStore
from storage_schema.parquet_files import ROW_GROUP_ROWS
from storage_schema.version import SCHEMA_VERSION
from tests.builders.storage_rows import assert_same_values, commit_rows, edit_json, random_columns

KEY = artifact_key(stage="seeds", version=1, parameters={}, input_digests=[], seed=0)


def about(**changes: object) -> dict:
    values = {"stage": "seeds", "key": KEY, "partition": "p", "name": "n", "version": 1, "parameters": {}, "seed": 0}
    return {**values, "inputs": [], "files": [], **changes}


def test_timings_are_on_record_and_in_no_digest(tmp_path: Path) -> None:
    refs = set()
    for seconds in (1.0, 2.0):
        store = Store(tmp_path / str(seconds))
        with store.writer(**about()) as writer:
            writer.facts["takes"] = ["a"]
            writer.timings["solve"] = seconds
        manifest = store.manifest(writer.ref)
        assert (manifest.facts, manifest.timings) == ({"takes": ["a"]}, {"solve": seconds})
        refs.add(writer.ref)
    assert len(refs) == 1


def test_columns_and_rows_can_be_chosen(store: Store) -> None:
    given = random_columns("annotations", 2 * ROW_GROUP_ROWS + 50)
    ref = store.commit(**about(tables={"annotations": given}))
    edge = ROW_GROUP_ROWS
    for rows in (slice(5, 9), slice(edge - 2, edge + 2), slice(-3, None), slice(7, 3), slice(90, 10**9)):
        part = store.read(ref, "annotations", columns=["frame", "sequence_id"], rows=rows)
        assert part.column_names == ["sequence_id", "frame"]
        assert_same_values(part["frame"], given["frame"][rows])
        assert_same_values(part["sequence_id"], given["sequence_id"][rows])
    batches = list(store.iter_batches(ref, "annotations", columns=["frame"]))
    assert [batch.num_rows for batch in batches] == [ROW_GROUP_ROWS, ROW_GROUP_ROWS, 50]
    np.testing.assert_array_equal(np.concatenate([batch["frame"] for batch in batches]), given["frame"])


def test_nullable_numbers_read_as_nan_and_nullable_text_as_none(store: Store) -> None:
    columns = random_columns("annotations", 3) | {"take_frame": [4, None, 0], "take_id": ["a", None, ""]}
    rows = store.read(store.commit(**about(tables={"annotations": columns})), "annotations")
    np.testing.assert_array_equal(rows["take_frame"], [4.0, np.nan, 0.0])
    assert rows["take_id"].tolist() == ["a", None, ""]
    assert rows.is_null("take_frame").tolist() == [False, True, False]
    del columns["take_id"], columns["take_frame"]  # they may be left out
    rows = store.read(store.commit(**about(key="1" * 64, tables={"annotations": columns})), "annotations")
    assert rows["take_id"].tolist() == [None] * 3
    assert np.isnan(rows["take_frame"]).all()


def test_rows_of_a_table_are_arrays_dicts_and_slices(store: Store) -> None:
    given = random_columns("draws", 6)
    rows = store.read(store.commit(**about(tables={"draws": given})), "draws")
    assert len(rows) == 6
    assert rows["pair17_m"].shape == (6, 2, 17, 3)
    assert rows["pair17_m"].dtype == np.float32
    assert rows["pair17_m"].flags.writeable
    assert rows["pair17_m"] is rows["pair17_m"]
    assert rows.row(-1)["draw"] == given["draw"][5]
    assert_same_values(rows.slice(2, 4)["parameters"], given["parameters"][2:4])
    assert "draw" in rows
    assert "pair17" not in rows
    with pytest.raises(SchemaError, match="'draws': column 'pair17' is not here"):
        rows["pair17"]
    with pytest.raises(IndexError, match="6 rows"):
        rows.row(6)


def test_a_table_may_be_empty_and_keeps_its_shapes(store: Store) -> None:
    ref = store.commit(**about(tables={"poses": {name: [] for name in random_columns("poses", 0)}}))
    rows = store.read(ref, "poses")
    assert rows.num_rows == 0
    assert rows["pair17_m"].shape == (0, 17, 3)
    assert rows["local_unitquat"] == []
    assert list(store.iter_batches(ref, "poses")) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pair17_m": np.zeros((3, 17, 3))}, r"column 'pair17_m' has rows of shape \(17, 3\); .* \(2, 17, 3\)"),
        ({"pair17_m": [np.zeros((2, 17, 3)), np.zeros(3), np.zeros(3)]}, "'pair17_m' has rows of different shapes"),
        ({"draww": [1, 2, 3]}, "unknown column 'draww'; did you mean 'draw'"),
        ({"draw": [1, 2]}, "column 'draw' has 2 rows but column 'density' has 3"),
        ({"draw": [1.5, 2, 3]}, "column 'draw' has values of type float64 such as 1.5; whole numbers are needed"),
        ({"draw": [1, 2, 2**40]}, "column 'draw' has values from 1 to 1099511627776; int32 holds"),
        ({"draw": [1, None, 2]}, "column 'draw' has values of type object such as None"),
        ({"draw": np.ma.masked_equal([1, 2, 3], 2)}, "column 'draw' is a masked array; give None or NaN"),
        ({"draw": 3}, "column 'draw' is given as int; a list or array of rows is needed"),
        ({"density": "ic"}, "column 'density' is given as str"),
        ({"density": ["ic", 3, "ic"]}, "column 'density' has 3 in row 1; text is needed"),
        ({"density": ["ic", None, "ic"]}, "column 'density' has None in row 1; text is needed"),
        ({"log_density": ["a", "b", "c"]}, "column 'log_density' has values of type <U1 such as 'a'; numbers are"),
        ({"log_density": np.zeros((3, 2))}, r"column 'log_density' has rows of shape \(2,\); a single value"),
        ({"log_density": [1j, 0, 0]}, "column 'log_density' has values of type complex128"),
    ],
)
def test_a_misfit_is_refused_by_table_and_column(store: Store, change: dict, words: str) -> None:
    with pytest.raises(SchemaError, match=f"table 'draws': .*{words}"):
        store.commit(**about(tables={"draws": random_columns("draws", 3) | change}))
    assert store.find("seeds", KEY) is None
    assert list((store.root / "tmp").iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joint_names": ["abc", []]}, "column 'joint_names' has 'abc' in row 0; a list of texts"),
        (
            {"joint_parents": [[1], np.zeros((2, 2), int)]},
            r"column 'joint_parents' has an array of shape \(2, 2\) in row 1; flatten",
        ),
        ({"is_held_out": [1, 0]}, "column 'is_held_out' has values of type int64 such as 1; true or false"),
    ],
)
def test_bad_lists_and_truths_are_refused_by_name(store: Store, change: dict, words: str) -> None:
    with pytest.raises(SchemaError, match=words):
        store.commit(**about(tables={"takes": random_columns("takes", 2) | change}))


def test_a_missing_column_is_refused_by_name(store: Store) -> None:
    columns = random_columns("takes", 2)
    del columns["layout"]
    with pytest.raises(SchemaError, match="table 'takes': column 'layout' is missing"):
        store.commit(**about(tables={"takes": columns}))


def test_unknown_tables_stages_and_attachments_are_refused(store: Store) -> None:
    with pytest.raises(StorageError, match="unknown table 'posen'; known tables: takes, take_quality, poses"):
        store.commit(**about(tables={"posen": {}}))
    for stage in ("tmp", "runs", "datasets", "../x", "Ingest", ""):
        with pytest.raises(StorageError, match="cannot name a stage"):
            store.commit(**about(stage=stage, tables={}))
    for name in ("a/b", "../a", ".hidden", "manifest.json", "", "a\nb"):
        with pytest.raises(StorageError, match="cannot name an attachment"):
            store.commit(**about(tables={}, attachments={name: b""}))
    with pytest.raises(StorageError, match="already the name of a file"):
        store.commit(**about(tables={}, attachments={"poses.parquet": b""}))
    with pytest.raises(StorageError, match="64 hexadecimal digits"):
        store.commit(**about(key="abc", tables={}))
    with pytest.raises(StorageError, match=r"facts cannot be said in JSON: .*ndarray"):
        store.commit(**about(tables={}, facts={"a": np.zeros(1)}))
    assert list((store.root / "tmp").iterdir()) == []


def test_unknown_columns_tables_and_attachments_cannot_be_read(store: Store) -> None:
    ref = commit_rows(store)
    with pytest.raises(MissingArtifact, match="holds no table 'poses'; it holds: scores"):
        store.read(ref, "poses")
    with pytest.raises(SchemaError, match="table 'scores' has no column 'valu'; known columns: topic"):
        store.read(ref, "scores", columns=["valu"])
    with pytest.raises(MissingArtifact, match=r"has no attachment 'a.txt'; it has: none"):
        store.attachment(ref, "a.txt")


CMU, OURS = SourceCredit("cmu", "free", "mocap.cs.cmu.edu"), SourceCredit("duets", "Apache-2.0", "built in")
STRICTER = replace(CMU, licence="CC-BY-NC-ND-4.0")


def record(store: Store, study: str, *refs: ArtifactRef) -> None:
    """Put artifacts of different stages on record as the last run of a study."""
    record_latest(store, study, "run", {ref.stage: [ShardRecord.of(store.manifest(ref), store)] for ref in refs})


def test_credits_are_those_of_all_that_something_came_from_once(store: Store) -> None:
    first = commit_rows(store, stage="ingest", partition="a", sources=(CMU,))
    second = commit_rows(store, stage="ingest", partition="b", sources=(OURS, CMU))
    third = commit_rows(store, stage="seeds", inputs=(first, second))
    last = commit_rows(store, stage="chains", inputs=(third,))
    assert source_credits(store, last) == (CMU, OURS)
    assert source_credits(store, first) == (CMU,)


def test_a_licence_that_a_study_says_anew_reaches_what_was_made_before(store: Store) -> None:
    old = commit_rows(store, stage="ingest", partition="a", sources=(CMU,))
    draws = commit_rows(store, stage="chains", inputs=(old,))
    new = commit_rows(store, stage="ingest", partition="a", sources=(STRICTER,), version=2)
    assert (new, new.key == old.key) == (old, False), "the same bytes under another key"
    assert source_credits(store, draws) == (CMU,), "nothing on record says otherwise"
    for source, ref in ((STRICTER, new), (CMU, old), (STRICTER, new)):
        record(store, "study", ref)
        assert source_credits(store, draws) == (source,)


def test_a_source_that_a_dataset_calls_otherwise_keeps_its_credits_where_no_run_is_on_record(store: Store) -> None:
    unstated = SourceCredit("motion files given in the study", "not stated", "not stated")
    old = commit_rows(store, stage="ingest", partition="a", sources=(unstated,))
    draws = commit_rows(store, stage="chains", inputs=(old,))
    new = commit_rows(store, stage="ingest", partition="a", sources=(CMU,), version=2)
    record(store, "study", new)
    assert create_dataset(store, "released", [new, draws]).sources == (CMU,)
    shutil.rmtree(store.root / "runs")
    assert source_credits(store, draws) == (CMU,)


def test_licences_are_known_beside_studies_that_only_an_older_program_has_run(store: Store) -> None:
    draws = commit_rows(store, stage="chains", inputs=(commit_rows(store, stage="ingest", sources=(CMU,)),))
    record_latest(store, "older", "run", {})
    path = store.root / "runs" / "latest" / "older.json"
    path.write_text(json.dumps({"schema_version": SCHEMA_VERSION - 1, "study": "older", "shards": []}))
    assert source_credits(store, draws) == (CMU,)
    path.write_text("{")
    with pytest.raises(CorruptArtifact, match=r"older\.json cannot be read: .*; a run of its study writes it anew"):
        source_credits(store, draws)


def test_where_two_studies_say_different_licences_of_the_same_bytes_each_has_its_own(store: Store) -> None:
    free = commit_rows(store, stage="ingest", partition="a", sources=(CMU,))
    strict = commit_rows(store, stage="ingest", partition="a", sources=(STRICTER,), version=2)
    draws = commit_rows(store, stage="chains", inputs=(free,))
    record(store, "one", free, draws)
    record(store, "two", strict, draws)
    assert source_credits(store, draws, free) == (CMU,)
    assert source_credits(store, draws, strict) == (STRICTER,)
    assert source_credits(store, draws) == (STRICTER, CMU), "nobody says which of the two is meant"


def test_nothing_leaves_whose_licence_is_no_longer_known(store: Store) -> None:
    source = commit_rows(store, stage="ingest", sources=(CMU,))
    draws = commit_rows(store, stage="chains", inputs=(source,))
    store.discard(source)
    with pytest.raises(MissingArtifact, match="its licence is not known"):
        source_credits(store, draws)


def test_a_new_artifact_removes_no_folder(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("something was removed")

    monkeypatch.setattr(FolderStore, "remove_folders", refuse)
    assert commit_rows(store) == commit_rows(store)


def test_data_are_on_the_disk_before_an_artifact_has_its_name(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    on_disk: set[int] = set()
    waiting: dict[str, list[str]] = {}
    fsync, rename = os.fsync, Path.rename

    def noted_fsync(handle: int) -> None:
        on_disk.add(os.fstat(handle).st_ino)
        fsync(handle)

    def noted_rename(path: Path, target: Path) -> Path:
        parts = [path, *path.iterdir()] if path.is_dir() else [path]
        waiting[str(target)] = [part.name for part in parts if part.stat().st_ino not in on_disk]
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "rename", noted_rename)
    ref = commit_rows(store, attachments={"note.txt": b"note"})
    folder = store.folder(ref.stage, ref.key)
    assert waiting[str(folder)] == []
    assert folder.parent.stat().st_ino in on_disk, "and its name soon after"


DAMAGES: dict[str, Callable[[Path], object]] = {
    "missing": lambda folder: (folder / "scores.parquet").unlink(),
    "short": lambda folder: os.truncate(folder / "scores.parquet", (folder / "scores.parquet").stat().st_size - 1),
    "no manifest": lambda folder: (folder / "manifest.json").unlink(),
    "bad manifest": lambda folder: os.truncate(folder / "manifest.json", 100),
    "other columns": lambda folder: edit_json(folder / "manifest.json", "tables", "scores", schema="0" * 16),
    "other key": lambda folder: edit_json(folder / "manifest.json", "ref", key="0" * 64),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_artifact_is_not_found_and_a_new_commit_heals_it(store: Store, damage: str) -> None:
    ref = commit_rows(store)
    DAMAGES[damage](store.folder(ref.stage, ref.key))
    assert store.find(ref.stage, ref.key) is None
    assert list(store.artifacts()) == []
    assert commit_rows(store) == ref
    assert store.find(ref.stage, ref.key) is not None
    assert list((store.root / "tmp").iterdir()) == []


def test_reading_a_damaged_file_names_it(store: Store) -> None:
    ref = commit_rows(store, num_rows=50)
    path = store.folder(ref.stage, ref.key) / "scores.parquet"
    data = bytearray(path.read_bytes())
    data[60] ^= 0xFF
    for damaged in (data, data[:40]):
        path.write_bytes(damaged)
        with pytest.raises(CorruptArtifact, match=r"scores\.parquet cannot be read"):
            store.read(ref, "scores")
    path.unlink()
    with pytest.raises(CorruptArtifact, match=r"scores\.parquet is missing though its manifest names it"):
        list(store.iter_batches(ref, "scores"))


def test_a_store_of_a_newer_program_is_refused(store: Store) -> None:
    ref = commit_rows(store)
    (store.root / "store.json").write_text('{"schema_version": 99}')
    for act in (lambda s: s.find(ref.stage, ref.key), lambda s: s.manifest(ref), lambda s: commit_rows(s, name="1")):
        with pytest.raises(NewerSchema, match=r"newer program \(schema version 99, this one knows up to 2\)"):
            act(Store(store.root))


def test_an_artifact_of_a_newer_program_is_refused(store: Store) -> None:
    ref = commit_rows(store)
    edit_json(store.folder(ref.stage, ref.key) / "manifest.json", schema_version=99, something_new=1)
    with pytest.raises(NewerSchema, match="schema version 99"):
        store.find(ref.stage, ref.key)


def test_what_is_no_store_is_named(store: Store) -> None:
    store.root.write_text("I am a file")
    with pytest.raises(StorageError, match=r"is not a store: it is a file, not a folder$"):
        store.find("seeds", KEY)
    store.root.unlink()
    store.root.mkdir()
    (store.root / "store.json").write_text("[]")
    with pytest.raises(StorageError, match="is not a store"):
        store.find("seeds", KEY)
