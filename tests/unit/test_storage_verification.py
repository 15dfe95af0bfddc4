from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest

from storage_schema import (
    ArtifactRef,
    MissingArtifact,
    Store,
    create_dataset,
    lineage,
    new_run,
    open_table,
    read_latest,
    record_latest,
    source_files,
    verify,
)
from storage_schema.errors import NamedByDataset, OlderSchema
from storage_schema.garbage import find_unneeded
from storage_schema.verification import ProblemKind
from tests.builders.storage_rows import commit_rows


@pytest.fixture
def refs(store: Store) -> list[ArtifactRef]:
    return [commit_rows(store, name=str(number), attachments={"note.txt": b"note"}) for number in range(3)]


def test_an_undamaged_store_has_no_problems(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs)
    found = verify(store)
    assert found.is_ok
    assert (found.num_artifacts, found.num_files) == (3, 6)
    assert found.num_bytes == sum(store.manifest(ref).num_bytes for ref in refs)


def test_every_kind_of_damage_is_named_and_nothing_else(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs[:1])
    folders = [store.folder(ref.stage, ref.key) for ref in refs]
    data = bytearray((folders[0] / "scores.parquet").read_bytes())
    data[20] ^= 1
    (folders[0] / "scores.parquet").write_bytes(data)
    (folders[0] / "note.txt").unlink()
    (folders[0] / "stray.txt").write_bytes(b"")
    (folders[1] / "manifest.json").write_text("{}")
    manifest = json.loads((folders[2] / "manifest.json").read_text())
    manifest["ref"]["content_digest"] = "0" * 64
    (folders[2] / "manifest.json").write_text(json.dumps(manifest))
    (store.root / "seeds" / "ab" / ("ab" + "0" * 62)).mkdir(parents=True)
    problems = verify(store).problems
    assert f"seeds@ab{'0' * 10}/manifest.json: missing: " in "\n".join(map(str, problems))
    found = {(problem.key, problem.file_name, problem.kind) for problem in problems}
    assert found == {
        (refs[0].key, "scores.parquet", ProblemKind.CHANGED),
        (refs[0].key, "note.txt", ProblemKind.MISSING),
        (refs[0].key, "stray.txt", ProblemKind.EXTRA),
        (refs[1].key, "manifest.json", ProblemKind.UNREADABLE),
        (refs[2].key, "manifest.json", ProblemKind.CHANGED),
        ("ab" + "0" * 62, "manifest.json", ProblemKind.MISSING),
        (refs[0].key, "manifest.json", ProblemKind.MISSING),
    }


def test_a_manifest_whose_facts_were_changed_gives_way_to_what_is_computed_again(store: Store) -> None:
    ref = commit_rows(store, facts={"is_held_out": True})
    as_of(store, ref, facts={"is_held_out": False})
    (problem,) = verify(store).problems
    assert (problem.file_name, problem.kind) == ("manifest.json", ProblemKind.CHANGED)
    commit_rows(store, facts={"is_held_out": True}, replaces=True)
    assert verify(store).is_ok


def test_damaged_records_and_lists_are_named_and_nothing_else(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs)
    runs = [new_run(store, "duets") for _ in range(3)]
    for run in runs:
        run.write("plan.json", {"stages": []})
        run.write("run.json", {"status": "finished"})
    record_latest(store, "duets", runs[0].run_id, {})
    record_latest(store, "salsa", runs[0].run_id, {})
    assert verify(store).is_ok
    (runs[0].path / "plan.json").write_bytes(b"{\x00")
    (runs[1].path / "run.json").write_text("[]")
    (store.root / "runs" / "latest" / "salsa.json").write_text("{}")
    (store.root / "datasets" / "released@1" / "dataset.json").write_text("{}")
    problems = verify(store).problems
    assert {problem.kind for problem in problems} == {ProblemKind.UNREADABLE}
    assert {str(problem).partition(":")[0] for problem in problems} == {
        f"runs/{runs[0].run_id}/plan.json",
        f"runs/{runs[1].run_id}/run.json",
        "runs/latest/salsa.json",
        "datasets/released@1/dataset.json",
    }


def test_what_a_dataset_was_computed_from_is_missed_too(store: Store) -> None:
    take = commit_rows(store, "poses", stage="ingest")
    create_dataset(store, "released", [commit_rows(store, inputs=(take,))])
    store.discard(take)
    (problem,) = verify(store).problems
    assert (problem.stage, problem.kind) == ("ingest", ProblemKind.MISSING)
    assert "dataset released@1 was computed from this artifact" in problem.detail


def as_of(store: Store, ref: ArtifactRef, **changed: object) -> None:
    """Let a manifest say other things of itself."""
    path = store.folder(ref.stage, ref.key) / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"code_version": "0.0.9", **changed}))


def test_what_an_older_schema_wrote_is_no_damage_and_its_release_is_named(store: Store) -> None:
    take = commit_rows(store, "poses", stage="ingest")
    ref = commit_rows(store, inputs=(take,))
    create_dataset(store, "released", [ref])
    as_of(store, ref, schema_version=0, what_there_was_then=1)
    record = store.root / "runs" / "latest" / "duets.json"
    record.parent.mkdir(parents=True)
    record.write_text('{"schema_version": 0, "shards": []}')
    with pytest.raises(OlderSchema):
        read_latest(store, "duets")
    found = verify(store)
    assert found.is_ok
    (note,) = found.notes
    assert note.endswith("pasdedeux 0.0.9 reads it, and a run of its study with this one computes it anew beside it")
    assert store.find(ref.stage, ref.key) is None
    with pytest.raises(OlderSchema, match=r"written under schema version 0, .* pasdedeux 0\.0\.9 reads it"):
        open_table("scores:released@1", store)
    kept = find_unneeded(store, [(ref.stage, ref.key)], datetime.max.replace(tzinfo=UTC)).kept
    assert {one.place[0] for one in kept} == {"ingest", "evaluation"}


def test_a_dataset_of_other_columns_names_the_release_that_reads_them(store: Store) -> None:
    ref = commit_rows(store)
    create_dataset(store, "released", [ref])
    (table, part), *_ = json.loads((store.folder(ref.stage, ref.key) / "manifest.json").read_text())["tables"].items()
    as_of(store, ref, tables={table: {**part, "schema": "0" * 16}})
    found = verify(store)
    assert (found.problems, len(found.notes)) == ((), 1)
    assert "scores of it have columns of another version; pasdedeux 0.0.9 reads them" in found.notes[0]
    with pytest.raises(NamedByDataset, match="dataset released@1 needs the old one"):
        commit_rows(store, attachments={"note.txt": b"other bytes under this key"})


def test_lineage_reaches_every_source_once(store: Store) -> None:
    first = commit_rows(store, "poses", stage="ingest", partition="a", files=(("a.bvh", "aa"),))
    second = commit_rows(store, "poses", stage="ingest", partition="b", files=(("b.bvh", "bb"), ("a.bvh", "aa")))
    seeds = commit_rows(store, "seeds", stage="seeds", inputs=(first, second))
    last = commit_rows(store, "draws", 2, stage="chains", inputs=(seeds, first))
    steps = lineage(store, last)
    assert steps[0].ref == last
    assert sorted(step.ref for step in steps) == sorted([first, second, seeds, last])
    assert {step.ref: step.depth for step in steps} == {last: 0, seeds: 1, first: 1, second: 2}
    assert [(use.name, use.sha256, use.stage) for use in source_files(steps)] == [
        ("a.bvh", "aa", "ingest"),
        ("b.bvh", "bb", "ingest"),
    ]


def test_an_input_that_is_gone_ends_its_branch(store: Store) -> None:
    first = commit_rows(store, "poses", stage="ingest")
    seeds = commit_rows(store, "seeds", stage="seeds", inputs=(first,))
    store.discard(first)
    assert [(step.ref, step.manifest is None) for step in lineage(store, seeds)] == [(seeds, False), (first, True)]
    with pytest.raises(MissingArtifact):
        lineage(store, first)
