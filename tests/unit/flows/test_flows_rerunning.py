"""`rerun`: the same bytes from what is on record, or the first column that differs, how much, and why it may be."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.differences import compare_builds
from flows.finished_builds import artifacts_by_place, portable_files, read_recorded
from storage_schema import ArtifactRef, Store, list_runs, read_latest
from tasks.graph import Graph
from tasks.stage import Shard, StageInputs
from tasks.stage.committing import commit
from tests.builders import toys as toys_module
from tests.builders.command_line import CommandLine
from tests.builders.toy_runs import run_toys, write_study
from tests.builders.toys import TOYS, toys_with

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
            patch.setattr(toys_module, "commit", more)
            return old.run_shard(shard, store)

    return toys_with("bend", version=version, plan=plan, run_shard=run_shard)


@pytest.fixture
def built(tmp_path: Path) -> Store:
    """A store with one run of the toy study."""
    store = Store(tmp_path / "store")
    source = tmp_path / "source.txt"
    source.write_text("what it was")
    run_toys(write_study(tmp_path, STUDY), store.root, f"grow.source={source}")
    return store


@pytest.fixture
def toys(built: Store, invoke_toys: CommandLine) -> CommandLine:
    """Return the commands on the store."""
    return invoke_toys.at(built)


@pytest.fixture
def rerun(built: Store, tmp_path: Path, invoke_toys: CommandLine) -> CommandLine:
    """Return the command that builds what the store has in another store."""
    return invoke_toys.of("rerun", "--from", built).at(tmp_path / "other")


@pytest.fixture
def folder(toys: CommandLine, tmp_path: Path) -> Path:
    """Return a dataset of the study, written to a folder."""
    toys("dataset", "create", "first", "--study", "toy")
    toys("dataset", "write", "first@1", "--out", tmp_path / "first-1")
    return tmp_path / "first-1"


def run_id(store: Store) -> str:
    return list_runs(store)[-1].run_id


def test_a_rerun_on_the_same_machine_gives_the_same_bytes(built: Store, rerun: CommandLine) -> None:
    out = rerun(run_id(built)).out
    assert "same bytes: 14 of 14 artifacts" in out
    assert "->" not in out
    answer = rerun(run_id(built), "--json").json
    assert (answer["is_same"], answer["num_same_bytes"], answer["differing"]) == (True, 14, {}), "again, and fresh"


def test_a_rerun_ignores_the_environment(built: Store, rerun: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PASDEDEUX_SET__GROW__SCALE", "5")
    rerun(run_id(built))


def test_a_rerun_of_a_part_builds_its_inputs(toys: CommandLine, rerun: CommandLine, tmp_path: Path) -> None:
    words = ("--set", f"grow.source={tmp_path / 'source.txt'}", "--only", "bend", "--force", "bend", "--json")
    part = toys("run", tmp_path / "toy.toml", *words).json["run_id"]
    assert "same bytes: 12 of 12 artifacts" in rerun(part).out


@pytest.mark.parametrize("is_old", [False, True])
def test_a_version_of_a_dataset_is_built_again_from_its_own_study(
    built: Store, toys: CommandLine, rerun: CommandLine, tmp_path: Path, is_old: bool
) -> None:
    toys("dataset", "create", "first", "--study", "toy", "--stage", "bend")
    if is_old:  # datasets of earlier versions do not have the study with them
        (built.root / "datasets" / "first@1" / "study.json").unlink()
    run_toys(tmp_path / "toy.toml", built.root, "grow.scale=3.0")
    assert "same bytes: 12 of 12 artifacts" in rerun("first@1").out


def test_a_dataset_that_travels_names_no_path_of_this_machine_and_is_built_again_beside_its_files(
    built: Store, toys: CommandLine, rerun: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toys("dataset", "create", "first", "--study", "toy", "--stage", "bend")
    dataset = built.root / "datasets" / "first@1"
    (dataset / "CHANGES.md").write_text(f'| grow.source | "{tmp_path}/other/source... | "/elsewhere/source.txt" |\n')
    for name, data in portable_files(dataset).items():
        assert str(tmp_path).encode() not in data
        (dataset / name).write_bytes(data)
    assert json.loads((dataset / "study.json").read_bytes())["grow"]["source"] == "source.txt"
    assert (dataset / "CHANGES.md").read_text() == '| grow.source | "source... | "source.txt" |\n'
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    said = rerun.refusal("first@1")
    assert "first@1 cannot be built again in this folder: grow.source: source.txt does not exist" in said
    monkeypatch.chdir(tmp_path)
    assert "same bytes: 12 of 12 artifacts" in rerun("first@1").out


def test_paths_that_travel_keep_as_many_parts_as_tell_them_apart(tmp_path: Path) -> None:
    paths = ["/a/takes/one/2d.json", "/a/takes/two/2d.json", "/b/camera.toml", "/b"]
    (tmp_path / "study.json").write_text(json.dumps({"ingest": {"files": paths, "rate": "1/s"}}))
    values = json.loads(portable_files(tmp_path)["study.json"])["ingest"]
    assert values == {"files": ["one/2d.json", "two/2d.json", "camera.toml", "b"], "rate": "1/s"}


def test_only_inputs_of_a_dataset_are_compared(store: Store, tmp_path: Path, invoke_toys: CommandLine) -> None:
    old = TOYS.stage("bend")

    def plan(inputs: StageInputs, parameters: Any) -> list[Shard]:
        return [shard for shard in old.plan(inputs, parameters) if shard.partition == "t0"]

    graph = toys_with("bend", plan=plan)
    run_toys(write_study(tmp_path, STUDY), store.root, graph=graph)
    command = replace(invoke_toys, graph=graph)
    command("dataset", "create", "half", "--study", "toy", "--stage", "bend", "--store", store)
    said = command("rerun", "half@1", "--from", store, "--store", tmp_path / "other").out
    assert "same bytes: 6 of 6 artifacts" in said


def test_results_of_other_sources_are_said(built: Store, rerun: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "warning" not in rerun(run_id(built)).out
    monkeypatch.setattr("flows.planning.source_digest", lambda: "0" * 64)
    assert "had results of other sources, which were compared" in rerun(run_id(built)).out


def test_an_attached_file_that_is_missing_is_never_rounding(built: Store, rerun: CommandLine) -> None:
    old = TOYS.stage("judge")

    def run_shard(shard: Shard, store: Store) -> ArtifactRef:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(toys_module, "commit", lambda *args, **more: commit(*args, **{**more, "attachments": {}}))
            return old.run_shard(shard, store)

    graph = toys_with("judge", changed(by=1e-6), run_shard=run_shard)
    assert "report.html: is only in one" in replace(rerun, graph=graph)(run_id(built), code=1).out


def test_an_input_that_has_changed_is_refused_before_any_work(built: Store, rerun: CommandLine, tmp_path: Path) -> None:
    (tmp_path / "source.txt").write_text("what it is now")
    assert "source.txt is not what" in rerun.refusal(run_id(built))
    (tmp_path / "source.txt").unlink()
    assert "source.txt does not exist" in rerun.refusal(run_id(built))
    assert not (tmp_path / "other").exists()


def test_differences_beyond_tolerance_are_named_with_the_reason(built: Store, rerun: CommandLine) -> None:
    environment = list_runs(built)[-1].path / "environment.json"
    values = json.loads(environment.read_text())
    values["packages"]["numpy"] = "1.0"
    values["processor"]["features"] += ["amx"]
    environment.write_text(json.dumps(values))
    out = replace(rerun, graph=changed(by=0.5, version=2))(run_id(built), code=1).out
    for words in (
        'packages.numpy: "1.0" -> ',
        "processor.features: amx -> none",
        "first beyond rounding: bend t0 s0",
        "models.values, row 0: ",
        "0.5 apart (allowed ",
        "version of stage bend: 1 -> 2",
    ):
        assert words in out


def test_rounding_is_said_and_is_no_failure(built: Store, rerun: CommandLine) -> None:
    answer = replace(rerun, graph=changed(by=1e-7))(run_id(built), "--json").json
    assert (answer["is_same"], answer["first_beyond_rounding"]) == (True, None)
    assert set(answer["differing"]) >= {"bend t0 s0", "bend t1 s2"}
    assert answer["changes"] == {}


def test_other_bytes_of_a_page_are_rounding_only_after_rounded_tables(built: Store, tmp_path: Path) -> None:
    old = read_recorded(built, run_id(built))
    run_toys(tmp_path / "toy.toml", tmp_path / "titled", f"grow.source={tmp_path / 'source.txt'}", "judge.title=else")
    titled = Store(tmp_path / "titled")
    latest = read_latest(titled, "toy")
    new = artifacts_by_place(titled, latest.refs("judge"))
    aside = {place: manifest for place, manifest in old.artifacts.items() if place[0] != "aside"}
    page = ("judge", "all", "all")
    comparison = compare_builds(built, aside, titled, new)
    assert (comparison.num_same, list(comparison.differing), comparison.beyond) == (12, [page], page)
    assert [str(difference) for difference in comparison.differing[page]] == ["report.html: other bytes"]
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
def test_what_is_not_on_record_is_said(rerun: CommandLine, name: str, words: str) -> None:
    assert words in rerun.refusal(name)


def test_a_run_that_did_not_finish_and_the_same_store_are_refused(built: Store, rerun: CommandLine) -> None:
    assert "--store names another one" in rerun.at(built).refusal(run_id(built))
    record = list_runs(built)[-1].path / "run.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "status": "failed"}))
    assert "is no finished run (failed)" in rerun.refusal(run_id(built))


def test_the_record_of_a_run_says_what_decides_last_bits(built: Store) -> None:
    environment = read_recorded(built, run_id(built)).environment
    assert environment["packages"]["python"]
    assert environment["packages"]["numpy"]
    assert len(environment["sources"]) == 64
    assert environment["processor"]["name"]
    assert environment["settings"]["OMP_NUM_THREADS"] == "1"
    assert os.sep not in json.dumps(environment["settings"]), "no paths"


def test_a_folder_of_a_dataset_is_built_again_by_its_record_alone(
    built: Store, folder: Path, tmp_path: Path, invoke_toys: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(built.root)
    monkeypatch.chdir(tmp_path)
    rerun, again = invoke_toys.of("rerun", folder), tmp_path / "again"
    assert f"same bytes: all files of {folder}" in rerun("--store", "other").out
    invoke_toys("dataset", "write", "first@1", "--out", again, "--store", "other")
    assert (again / "manifest.json").read_bytes() == (folder / "manifest.json").read_bytes()
    with monkeypatch.context() as patch:  # by another program
        patch.setattr("storage_schema.artifact_writer.source_digest", lambda: "0" * 64)
        rerun("--store", "second")
    (tmp_path / "source.txt").write_text("what it was not")
    assert "source.txt is not what first@1 read" in rerun.refusal("--store", "third")


def test_a_folder_that_is_built_again_with_other_bytes_says_which_files(
    folder: Path, tmp_path: Path, invoke_toys: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = replace(invoke_toys, graph=changed(by=1.0))("rerun", folder, "--store", "other", code=1).out
    assert "other bytes: " in said
    assert " data/models/t" in said
