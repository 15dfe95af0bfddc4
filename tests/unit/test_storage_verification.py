from __future__ import annotations

import json
from pathlib import Path

import pytest

from storage_schema import ArtifactRef, MissingArtifact, Store, create_dataset, lineage, source_files, verify
from storage_schema.verification import ProblemKind
from tests.builders.storage_rows import commit_rows


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


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
