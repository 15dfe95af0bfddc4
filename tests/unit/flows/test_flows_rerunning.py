"""`rerun`: the same bytes from what is on record, or the first column that differs, how much, and why it may be."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.console.app import run_command_line
from flows.differences import compare_builds
from flows.recorded import Recorded, artifacts_by_place, portable_files, read_recorded
from storage_schema import ArtifactRef, Store, list_runs, read_latest
from tasks.graph import Graph
from tasks.stage import Shard, StageInputs
from tasks.stage.committing import commit
from tests.builders import toys
from tests.builders.toy_runs import run_toys, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("in_this_process")

STUDY = """
[study]
name = "toy"
seed = 7
[grow]
scale = 2.0
[bend]
step = 1
"""


def changed(*, by: float, version: int = 1) -> Graph:
    """Return the toy stages where what `bend` makes is greater, perhaps under another version."""
    old = TOYS.stage("bend")

    def plan(inputs: StageInputs, parameters: Any) -> list[Shard]:
        return [replace(shard, version=version) for shard in old.plan(inputs, parameters)]

    def run_shard(shard: Shard, store: Store) -> ArtifactRef:
        def more(shard: Shard, store: Store, *, tables: Any, facts: Any) -> ArtifactRef:
            models = {**tables["models"], "values": [values + by for values in tables["models"]["values"]]}
            return commit(shard, store, tables={"models": models}, facts=facts)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(toys, "commit", more)
            return old.run_shard(shard, store)

    new = replace(old, version=version, plan=plan, run_shard=run_shard)
    return Graph(tuple(new if stage.name == "bend" else stage for stage in TOYS.stages))


@pytest.fixture
def built(tmp_path: Path) -> Store:
    """A store with one run of the toy study."""
    store = Store(tmp_path / "store")
    source = tmp_path / "source.txt"
    source.write_text("what it was")
    run_toys(write_study(tmp_path, STUDY), store.root, f"grow.source={source}")
    return store


def rerun(name: str, built: Store, *more: str, graph: Graph = TOYS) -> int:
    other = str(built.root.parent / "other")
    return run_command_line(["rerun", name, "--from", str(built.root), "--store", other, *more], graph=graph)


def run_id(store: Store) -> str:
    return list_runs(store)[-1].run_id


def test_a_rerun_on_the_same_machine_gives_the_same_bytes(built: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert rerun(run_id(built), built) == 0
    out = capsys.readouterr().out
    assert "same bytes: 14 of 14 artifacts" in out
    assert "->" not in out
    assert rerun(run_id(built), built, "--json") == 0, "the same command again finds it fresh"
    answer = json.loads(capsys.readouterr().out)
    assert (answer["is_same"], answer["num_same_bytes"], answer["differing"]) == (True, 14, {})


def test_a_rerun_takes_settings_from_the_record_alone(
    built: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PASDEDEUX_SET__GROW__SCALE", "5")
    assert rerun(run_id(built), built) == 0


def test_a_rerun_of_a_part_builds_what_that_was_computed_from(built: Store, capsys: pytest.CaptureFixture[str]) -> None:
    study = str(built.root.parent / "toy.toml")
    line = ["--store", str(built.root), "--set", f"grow.source={built.root.parent / 'source.txt'}", "--workers", "0"]
    assert run_command_line(["run", study, "--only", "bend", "--force", "bend", "--json", *line], graph=TOYS) == 0
    assert rerun(json.loads(capsys.readouterr().out)["run_id"], built) == 0
    assert "same bytes: 12 of 12 artifacts" in capsys.readouterr().out


@pytest.mark.parametrize("is_old", [False, True])
def test_a_version_of_a_dataset_is_built_again_from_its_own_study(
    built: Store, is_old: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["dataset", "create", "first", "--study", "toy", "--stage", "bend", "--store", str(built.root)]
    assert run_command_line(line, graph=TOYS) == 0
    if is_old:  # datasets of earlier versions do not have the study with them
        (built.root / "datasets" / "first@1" / "study.json").unlink()
    run_toys(built.root.parent / "toy.toml", built.root, "grow.scale=3.0")
    assert rerun("first@1", built) == 0
    assert "same bytes: 12 of 12 artifacts" in capsys.readouterr().out


def test_a_dataset_that_travels_names_no_path_of_this_machine_and_is_built_again_beside_its_files(
    built: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["dataset", "create", "first", "--study", "toy", "--stage", "bend", "--store", str(built.root)]
    assert run_command_line(line, graph=TOYS) == 0
    folder = built.root / "datasets" / "first@1"
    (folder / "CHANGES.md").write_text(f'| grow.source | "{tmp_path}/other/source... | "/elsewhere/source.txt" |\n')
    for name, data in portable_files(folder).items():
        assert str(tmp_path).encode() not in data
        (folder / name).write_bytes(data)
    assert json.loads((folder / "study.json").read_bytes())["grow"]["source"] == "source.txt"
    assert (folder / "CHANGES.md").read_text() == '| grow.source | "source... | "source.txt" |\n'
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert rerun("first@1", built) == 2
    said = capsys.readouterr().err
    assert "first@1 cannot be built again in this folder: grow.source: source.txt does not exist" in said
    monkeypatch.chdir(tmp_path)
    assert rerun("first@1", built) == 0
    assert "same bytes: 12 of 12 artifacts" in capsys.readouterr().out


def test_paths_that_travel_keep_as_many_parts_as_tell_them_apart(tmp_path: Path) -> None:
    paths = ["/a/takes/one/2d.json", "/a/takes/two/2d.json", "/b/camera.toml", "/b"]
    (tmp_path / "study.json").write_text(json.dumps({"ingest": {"files": paths, "rate": "1/s"}}))
    values = json.loads(portable_files(tmp_path)["study.json"])["ingest"]
    assert values == {"files": ["one/2d.json", "two/2d.json", "camera.toml", "b"], "rate": "1/s"}


def test_what_a_dataset_was_not_computed_from_is_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = TOYS.stage("bend")

    def plan(inputs: StageInputs, parameters: Any) -> list[Shard]:
        return [shard for shard in old.plan(inputs, parameters) if shard.partition == "t0"]

    graph = Graph(tuple(replace(old, plan=plan) if stage.name == "bend" else stage for stage in TOYS.stages))
    store = Store(tmp_path / "store")
    run_toys(write_study(tmp_path, STUDY), store.root, graph=graph)
    line = ["dataset", "create", "half", "--study", "toy", "--stage", "bend", "--store", str(store.root)]
    assert run_command_line(line, graph=graph) == 0
    assert rerun("half@1", store, graph=graph) == 0
    assert "same bytes: 6 of 6 artifacts" in capsys.readouterr().out


def test_results_that_other_sources_left_in_the_other_store_are_said(
    built: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rerun(run_id(built), built) == 0
    assert "warning" not in capsys.readouterr().out
    monkeypatch.setattr("flows.planning.source_digest", lambda: "0" * 64)
    assert rerun(run_id(built), built) == 0
    assert "had results of other sources, which were compared" in capsys.readouterr().out


def test_an_attached_file_that_is_missing_is_never_rounding(
    built: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = TOYS.stage("judge")

    def run_shard(shard: Shard, store: Store) -> ArtifactRef:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(toys, "commit", lambda *args, **more: commit(*args, **{**more, "attachments": {}}))
            return old.run_shard(shard, store)

    rounded = changed(by=1e-6)
    graph = Graph(tuple(replace(old, run_shard=run_shard) if s.name == "judge" else s for s in rounded.stages))
    assert rerun(run_id(built), built, graph=graph) == 1
    assert "report.html: is only in one" in capsys.readouterr().out


def test_an_input_that_has_changed_is_refused_before_any_work(built: Store, capsys: pytest.CaptureFixture[str]) -> None:
    (built.root.parent / "source.txt").write_text("what it is now")
    assert rerun(run_id(built), built) == 2
    err = capsys.readouterr().err
    assert "source.txt is not what" in err
    (built.root.parent / "source.txt").unlink()
    assert rerun(run_id(built), built) == 2
    assert "source.txt does not exist" in capsys.readouterr().err
    assert not (built.root.parent / "other").exists()


def test_results_beyond_their_tolerance_are_named_by_table_and_column_with_the_reason(
    built: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    environment = list_runs(built)[-1].path / "environment.json"
    values = json.loads(environment.read_text())
    values["packages"]["numpy"] = "1.0"
    values["processor"]["features"] += ["amx"]
    environment.write_text(json.dumps(values))
    assert rerun(run_id(built), built, graph=changed(by=0.5, version=2)) == 1
    out = capsys.readouterr().out
    assert 'packages.numpy: "1.0" -> ' in out
    assert "processor.features: amx -> none" in out
    assert "first beyond rounding: bend t0 s0" in out
    assert "models.values, row 0: " in out
    assert "0.5 apart (allowed " in out
    assert "version of stage bend: 1 -> 2" in out


def test_rounding_is_said_and_is_no_failure(built: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert rerun(run_id(built), built, "--json", graph=changed(by=1e-7)) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["is_same"], answer["first_beyond_rounding"]) == (True, None)
    assert set(answer["differing"]) >= {"bend t0 s0", "bend t1 s2"}
    assert answer["changes"] == {}


def test_other_bytes_of_a_page_are_rounding_only_after_rounded_tables(built: Store, tmp_path: Path) -> None:
    old = read_recorded(built, run_id(built))
    run_toys(tmp_path / "toy.toml", tmp_path / "titled", f"grow.source={tmp_path / 'source.txt'}", "judge.title=else")
    titled = Store(tmp_path / "titled")
    latest = read_latest(titled, "toy")
    assert latest is not None
    new = artifacts_by_place(titled, latest.refs("judge"))
    aside = {place: manifest for place, manifest in old.artifacts.items() if place[0] != "aside"}
    found = compare_builds(built, aside, titled, new)
    assert (found.num_same, list(found.differing), found.beyond) == (
        12,
        [("judge", "all", "all")],
        ("judge", "all", "all"),
    )
    assert [str(one) for one in found.differing["judge", "all", "all"]] == ["report.html: other bytes"]
    without = {place: manifest for place, manifest in new.items() if place != ("grow", "t0", "s0")}
    assert compare_builds(built, aside, titled, without).only_one == (("grow", "t0", "s0"),)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nothing", "there is no run 'nothing' in the store"),
        ("first@1", "there is no dataset 'first@1'"),
        ("../x", "there is no run '../x'"),
    ],
)
def test_what_is_not_on_record_is_said(built: Store, name: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert rerun(name, built) == 2
    assert words in capsys.readouterr().err


def test_a_run_that_did_not_finish_and_the_same_store_are_refused(
    built: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(["rerun", run_id(built), "--from", str(built.root), "--store", str(built.root)]) == 2
    assert "--store names another one" in capsys.readouterr().err
    record = list_runs(built)[-1].path / "run.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "status": "failed"}))
    assert rerun(run_id(built), built) == 2
    assert "is no finished run (failed)" in capsys.readouterr().err


def test_the_record_of_a_run_says_what_decides_last_bits(built: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = read_recorded(built, run_id(built)).environment
    assert environment["packages"]["python"]
    assert environment["packages"]["numpy"]
    assert len(environment["sources"]) == 64
    assert environment["processor"]["name"]
    assert environment["settings"]["OMP_NUM_THREADS"] == "1"
    assert isinstance(read_recorded(built, run_id(built)), Recorded)
    assert os.sep not in json.dumps(environment["settings"]), "no paths"


def test_a_folder_of_a_dataset_is_built_again_by_its_record_alone(
    built: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place, folder, other = ["--store", str(built.root)], tmp_path / "first-1", ["--store", str(tmp_path / "other")]
    assert run_command_line(["dataset", "create", "first", "--study", "toy", *place], graph=TOYS) == 0
    assert run_command_line(["dataset", "write", "first@1", "--out", str(folder), *place], graph=TOYS) == 0
    shutil.rmtree(built.root)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert run_command_line(["rerun", str(folder), *other], graph=TOYS) == 0
    assert f"same bytes: all files of {folder}" in capsys.readouterr().out
    assert run_command_line(["dataset", "write", "first@1", "--out", str(tmp_path / "again"), *other], graph=TOYS) == 0
    assert (tmp_path / "again" / "manifest.json").read_bytes() == (folder / "manifest.json").read_bytes()
    with monkeypatch.context() as patch:  # by another program
        patch.setattr("storage_schema.artifact_writer.source_digest", lambda: "0" * 64)
        assert run_command_line(["rerun", str(folder), "--store", str(tmp_path / "second")], graph=TOYS) == 0
    (tmp_path / "source.txt").write_text("what it was not")
    assert run_command_line(["rerun", str(folder), "--store", str(tmp_path / "third")], graph=TOYS) == 2
    assert "source.txt is not what first@1 read" in capsys.readouterr().err


def test_a_folder_that_is_built_again_with_other_bytes_says_which_files(
    built: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place, folder, other = ["--store", str(built.root)], tmp_path / "first-1", ["--store", str(tmp_path / "other")]
    assert run_command_line(["dataset", "create", "first", "--study", "toy", *place], graph=TOYS) == 0
    assert run_command_line(["dataset", "write", "first@1", "--out", str(folder), *place], graph=TOYS) == 0
    monkeypatch.chdir(tmp_path)
    assert run_command_line(["rerun", str(folder), *other], graph=changed(by=1.0)) == 1
    said = capsys.readouterr().out
    assert "other bytes: " in said
    assert " data/models/t" in said
