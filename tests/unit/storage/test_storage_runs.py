from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from storage_schema import (
    CorruptArtifact,
    InputRecord,
    MissingArtifact,
    ShardRecord,
    StorageError,
    Store,
    latest_studies,
    list_runs,
    new_run,
    open_run,
    read_latest,
    record_latest,
)
from storage_schema.errors import NewerSchema
from tests.builders.storage_rows import commit_rows, edit_json


def test_a_record_says_what_decided_a_shard(store: Store) -> None:
    take = commit_rows(store, "poses", stage="ingest", partition="waltz", files=(("a.bvh", "ff"),))
    seeds = commit_rows(store, "seeds", stage="seeds", partition="all", inputs=(take,), seed=3)
    record = ShardRecord.of(store.manifest(seeds), store)
    assert record.inputs == (InputRecord("ingest", "waltz", "0", take.content_digest),)
    assert record.parameters == {"partition": "all", "name": "0", "num_rows": 5}
    assert (record.key, record.content_digest, record.version, record.seed) == (seeds.key, seeds.content_digest, 1, 3)
    assert ShardRecord.of(store.manifest(take), store).files == (("a.bvh", "ff"),)


def test_the_latest_run_reads_back_and_keeps_stages_it_did_not_run(store: Store) -> None:
    assert read_latest(store, "duets") is None
    assert latest_studies(store) == []
    take = commit_rows(store, "poses", stage="ingest", partition="waltz", files=(("a.bvh", "ff"),))
    seeds = commit_rows(store, "seeds", stage="seeds", inputs=(take,))
    for run_id, ref in (("one", take), ("two", seeds)):
        records = {ref.stage: [ShardRecord.of(store.manifest(ref), store)]}
        written = record_latest(store, "duets", run_id, records)
    latest = read_latest(store, "duets")
    assert (latest, latest.run_id) == (written, "two")
    refs = [latest.refs(*words) for words in (("ingest",), ("ingest", "waltz"), ("ingest", "hug"), ("chains",))]
    assert refs == [[take], [take], [], []]
    assert latest_studies(store) == ["duets"]
    assert list(store.artifacts("runs")) == []


def test_runs_that_record_at_the_same_time_lose_nothing(store: Store) -> None:
    script = (
        "import sys; from storage_schema import Store, ShardRecord, record_latest\n"
        "for i in range(10):\n"
        "    shard = ShardRecord('p', 'n', '0' * 64, '0' * 64, 1, 0, {})\n"
        "    record_latest(Store(sys.argv[1]), 'duets', 'run', {f'stage_{sys.argv[2]}_{i}': [shard]})\n"
    )
    root = Path(__file__).resolve().parents[3]
    command = [sys.executable, "-c", script, str(store.root)]
    children = [subprocess.Popen([*command, str(number)], cwd=root) for number in range(3)]
    assert [child.wait(timeout=60) for child in children] == [0, 0, 0]
    latest = read_latest(store, "duets")
    assert len(latest.stages) == 30


def test_a_damaged_or_newer_record_is_said(store: Store) -> None:
    record_latest(store, "duets", "one", {})
    path = store.root / "runs" / "latest" / "duets.json"
    edit_json(path, schema_version=7)
    with pytest.raises(NewerSchema, match="schema version 7"):
        read_latest(store, "duets")
    path.write_text(path.read_text()[:-10])
    with pytest.raises(CorruptArtifact, match=r"duets\.json cannot be read"):
        read_latest(store, "duets")


def test_a_run_has_a_folder_of_its_own(store: Store) -> None:
    first, second = new_run(store, "duets"), new_run(store, "duets")
    assert first.run_id != second.run_id
    first.write("plan.json", {"chains": ["fresh", 3]})
    first.write("run.json", {"status": "running"})
    first.write("run.json", {"status": "finished"})
    again = open_run(store, first.run_id)
    assert json.loads(again.read("plan.json")) == {"chains": ["fresh", 3]}
    assert json.loads(again.read("run.json")) == {"status": "finished"}
    record_latest(store, "duets", first.run_id, {})
    assert {run.run_id for run in list_runs(store)} == {first.run_id, second.run_id}


def test_files_and_runs_that_are_not_there_are_said(store: Store) -> None:
    run = new_run(store, "duets")
    with pytest.raises(MissingArtifact, match=r"has no file 'plan\.json'"):
        run.read("plan.json")
    for run_id in ("nothing", "latest"):
        with pytest.raises(MissingArtifact, match=f"there is no run '{run_id}'"):
            open_run(store, run_id)
    with pytest.raises(StorageError, match="cannot name a study"):
        new_run(store, "a/b")
