from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import pytest

from storage_schema import (
    ArtifactRef,
    Manifest,
    MissingArtifact,
    Store,
    create_dataset,
    lineage,
    new_run,
    open_table,
    read_latest,
    record_latest,
    record_page,
    source_files,
    verify,
)
from storage_schema.ancestry import inputs_with
from storage_schema.errors import NamedByDataset, OlderSchema
from storage_schema.garbage import find_unneeded
from storage_schema.verification import ProblemKind
from tests.builders.storage_rows import commit_rows, edit_json
from tests.builders.toy_runs import run_toys, write_study


@pytest.fixture
def refs(store: Store) -> list[ArtifactRef]:
    return [commit_rows(store, name=str(number), attachments={"note.txt": b"note"}) for number in range(3)]


def test_an_undamaged_store_has_no_problems(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs)
    report = verify(store)
    assert report.is_ok
    assert (report.num_artifacts, report.num_files) == (3, 6)
    assert report.num_bytes == sum(store.manifest(ref).num_bytes for ref in refs)


def test_every_kind_of_damage_is_named_and_nothing_else(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs[:1])
    first, second, third = (store.folder(ref.stage, ref.key) for ref in refs)
    data = bytearray((first / "scores.parquet").read_bytes())
    data[20] ^= 1
    (first / "scores.parquet").write_bytes(data)
    (first / "note.txt").unlink()
    (first / "stray.txt").write_bytes(b"")
    (second / "manifest.json").write_text("{}")
    edit_json(third / "manifest.json", "ref", content_digest="0" * 64)
    lost = "ab" + "0" * 62
    (store.root / "seeds" / "ab" / lost).mkdir(parents=True)
    problems = verify(store).problems
    assert f"seeds@{lost[:12]}/manifest.json: missing: " in "\n".join(map(str, problems))
    assert {(problem.key, problem.file_name, problem.kind) for problem in problems} == {
        (refs[0].key, "scores.parquet", ProblemKind.CHANGED),
        (refs[0].key, "note.txt", ProblemKind.MISSING),
        (refs[0].key, "stray.txt", ProblemKind.EXTRA),
        (refs[1].key, "manifest.json", ProblemKind.UNREADABLE),
        (refs[2].key, "manifest.json", ProblemKind.CHANGED),
        (lost, "manifest.json", ProblemKind.MISSING),
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
    """Let a manifest of an earlier release say other things of itself, with a digest of what it says."""
    path = store.folder(ref.stage, ref.key) / "manifest.json"
    text = json.dumps(json.loads(path.read_text()) | {"code_version": "0.0.9", **changed, "digest": ""})
    path.write_text(text if "schema_version" in changed else signed(text))


def signed(text: str) -> str:
    """Return a manifest with the digest of what it says now."""
    return Manifest.from_json(text.encode(), where="made up").to_json()


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
    report = verify(store)
    assert report.is_ok
    (note,) = report.notes
    assert note.endswith("pasdedeux 0.0.9 reads it, and a run of its study with this one computes it anew beside it")
    assert store.find(ref.stage, ref.key) is None
    with pytest.raises(OlderSchema, match=r"written under schema version 0, .* pasdedeux 0\.0\.9 reads it"):
        open_table("scores:released@1", store)
    kept = find_unneeded(store, [(ref.stage, ref.key)], datetime.max.replace(tzinfo=UTC)).kept
    assert {artifact.place[0] for artifact in kept} == {"ingest", "evaluation"}


def test_a_dataset_of_other_columns_names_the_release_that_reads_them(store: Store) -> None:
    ref = commit_rows(store)
    create_dataset(store, "released", [ref])
    (table, part), *_ = json.loads((store.folder(ref.stage, ref.key) / "manifest.json").read_text())["tables"].items()
    as_of(store, ref, tables={table: {**part, "schema": "0" * 16}})
    report = verify(store)
    assert (report.problems, len(report.notes)) == ((), 1)
    assert "scores of it have columns of another version; pasdedeux 0.0.9 reads them" in report.notes[0]
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


def test_an_input_is_found_by_its_table_though_one_after_it_is_gone(store: Store) -> None:
    first, last = (commit_rows(store, table, stage=table) for table in ("poses", "seeds"))
    draws = commit_rows(store, "draws", stage="chains", inputs=(first, last))
    assert [*inputs_with(store, draws, "seeds")] == [last]
    store.discard(last)
    assert next(inputs_with(store, draws, "poses")) == first


def test_an_input_that_is_gone_ends_its_branch(store: Store) -> None:
    first = commit_rows(store, "poses", stage="ingest")
    seeds = commit_rows(store, "seeds", stage="seeds", inputs=(first,))
    store.discard(first)
    assert [(step.ref, step.manifest is None) for step in lineage(store, seeds)] == [(seeds, False), (first, True)]
    with pytest.raises(MissingArtifact):
        lineage(store, first)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("built")
    (folder / "source.txt").write_bytes(b"source")
    run_toys(write_study(folder), folder / "store", f"grow.source={folder / 'source.txt'}")
    store = Store(folder / "store")
    assert verify(store).is_ok
    return store


def edited(values: dict[str, Any], name: str) -> Any:
    """Return another value of the same kind."""
    value = values[name]
    if not value and name in _ADDED:
        return _ADDED[name]
    if isinstance(value, dict):
        return {key: edited(value, key) if at == 0 else part for at, (key, part) in enumerate(value.items())}
    if isinstance(value, list):
        return value[1:]
    return value + 1 if isinstance(value, int | float) else f"{value}x"


_ADDED = {
    "files": [["a", "0" * 64]],
    "reads": {"a": [0]},
    "after": ["0" * 64],
    "parameters": {"a": 1},
    "facts": {"a": 1},
}
_KEYED = {"partition", "name", "version", "parameters", "seed", "inputs", "files", "reads", "after"}
_NOT_FOUND = {"timings", "created_at"}


def test_every_word_of_a_manifest_that_is_edited_alone_is_found(built: Store) -> None:
    paths = sorted(built.root.glob("*/??/*/manifest.json"))
    with_inputs = next(path for path in paths if json.loads(path.read_text())["reads"])
    with_files = next(path for path in paths if json.loads(path.read_text())["files"])
    for path in (with_inputs, with_files):
        text = path.read_text()
        values = json.loads(text)
        for name in sorted(values.keys() - {"ref", "schema_version", "tables", "attachments"}):
            if (value := edited(values, name)) == values[name]:
                continue
            path.write_text(json.dumps(values | {name: value}))
            problems = [problem.file_name for problem in verify(built).problems]
            assert problems == ([] if name in _NOT_FOUND else ["manifest.json"]), name
            if name in _KEYED and (name != "inputs" or values["reads"]):  # those it follows enter it by `after`
                path.write_text(signed(json.dumps(values | {name: value, "digest": ""})))
                assert "its key is not that of" in str(verify(built).problems), f"{name}, with a new digest"
        path.write_text(text)
    assert verify(built).is_ok


@pytest.mark.parametrize(
    ("names", "changes"),
    [
        ((), {"sources": [{"name": "a", "licence": "public domain", "credit": "nobody"}]}),
        (("parameters",), {"noise_px": 3.0}),
        (("package_versions",), {"numpy": "0"}),
        (("tables", "scores"), {"rows": 4}),
        (("tables", "scores"), {"schema": "0" * 16}),
    ],
)
def test_edits_of_parts_of_a_manifest_are_found(store: Store, names: tuple[str, ...], changes: dict[str, Any]) -> None:
    ref = commit_rows(store)
    edit_json(store.folder(ref.stage, ref.key) / "manifest.json", *names, **changes)
    assert [problem.file_name for problem in verify(store).problems] == ["manifest.json"]


def test_manifests_of_a_release_without_digests_are_read_and_counted_in_one_note(store: Store) -> None:
    refs = [commit_rows(store, name=str(number)) for number in range(2)]
    for ref in refs:
        path = store.folder(ref.stage, ref.key) / "manifest.json"
        before = store.manifest(ref)
        values = json.loads(path.read_text())
        for name in ("digest", "reads", "after"):
            del values[name]
        path.write_text(json.dumps(values))
        assert store.load(ref.stage, ref.key) == before
    report = verify(store)
    assert report.is_ok
    (note,) = report.notes
    assert note.startswith("manifests without a digest of themselves, as earlier releases wrote them: 2; ")


def test_copies_of_reports_are_compared_with_what_they_were_copied_from(store: Store) -> None:
    page = {"report.html": b"<p>pass</p>", "card.md": b"# Card"}
    ref = commit_rows(store, attachments=page)
    run = new_run(store, "duets")
    artifact = {"key": ref.key, "content_digest": ref.content_digest}
    run.write("run.json", {"status": "finished", "stages": [{"stage": ref.stage, "artifacts": [artifact]}]})
    (run.path / "report").mkdir()
    for name, content in {**page, "profile.html": b"not of an artifact"}.items():
        (run.path / "report" / name).write_bytes(content)
    assert verify(store).is_ok
    (run.path / "report" / "report.html").write_bytes(b"<p>fail</p>")
    (run.path / "report" / "card.md").unlink()
    assert {problem.file_name: problem.kind for problem in verify(store).problems} == {
        "report/report.html": ProblemKind.CHANGED,
        "report/card.md": ProblemKind.MISSING,
    }


def test_the_copy_of_the_last_report_is_compared_with_the_reports_of_runs(store: Store) -> None:
    for study in ("duets", "duets-2.5"):
        run = new_run(store, study)
        (run.path / "report").mkdir()
        (run.path / "report" / "report.html").write_bytes(study.encode())
        copy = record_page(store, study, study.encode())
        assert copy == store.root / "runs" / "latest" / f"{study}.html"
    assert verify(store).is_ok
    copy.write_bytes(b"edited")
    (problem,) = verify(store).problems
    assert (problem.kind, problem.file_name) == (ProblemKind.CHANGED, "duets-2.5.html")
    record_page(store, study, study.encode())
    assert verify(store).is_ok
    (copy.parent / "unreadable.html").mkdir()
    assert [problem.file_name for problem in verify(store).problems] == ["unreadable.html"]
