"""`gc`: what datasets, studies and recent runs need stays, whatever else was ever built; the rest goes."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from flows.collecting import StoreInUseError, collect, find_garbage
from flows.console.run import build
from flows.outcomes import Run
from flows.planning import StageSelection
from flows.study import load_study
from storage_schema import (
    CorruptArtifact,
    StorageError,
    Store,
    create_dataset,
    in_use,
    lineage,
    list_runs,
    read_latest,
    verify,
)
from storage_schema.unpacked import unpacked
from tasks.shards import ClusterSettings, HerePool
from tests.builders.command_line import CommandLine
from tests.builders.storage_rows import commit_rows, list_as_of_schema_1
from tests.builders.toy_runs import STUDY, call, plan_toys, run_toys, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("own_cache")

NOW = datetime(9999, 1, 1, tzinfo=UTC)
"""A time after which nothing was made: nothing is kept for being young."""

NOW_S = time.time()


def files(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return write_study(tmp_path, STUDY + "[bend]\nstep = 1\n")


@pytest.fixture
def gc(store: Store, invoke_toys: CommandLine) -> CommandLine:
    """Return the command on the store, which takes what is of no use today."""
    return invoke_toys.of("gc", "--days", "0").at(store)


@pytest.fixture
def store(store: Store, study: Path) -> Store:
    """Three runs of the toy study at three scales; the first is a dataset."""
    run_toys(study, store.root)
    latest = read_latest(store, "toy")
    create_dataset(store, "first", latest.refs("judge"))
    for scale in (2.0, 3.0):
        run_toys(study, store.root, f"grow.scale={scale}")
    return store


def test_unused_unpacked_clips_go(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.unpacked.cache_folder", lambda: tmp_path / "cache")
    rows = np.zeros((3, 22, 3), np.float32)
    used, old = (
        unpacked(digit * 64, lambda writer: writer.append("positions", rows) and None).folder for digit in "ab"
    )
    (tmp_path / "cache" / "unpacked" / "notes").mkdir()
    for folder in (old, used):
        os.utime(folder, (NOW_S - 8 * 86400,) * 2)
    assert unpacked("a" * 64, lambda writer: None).folder == used
    since = datetime.fromtimestamp(NOW_S - 86400, UTC)
    garbage = find_garbage(store, since)
    assert (list(garbage.kept_clips), list(garbage.going_clips)) == ([used], [old])
    assert garbage.num_bytes >= garbage.going_clips[old] == sum(files(old).values()) > rows.nbytes
    assert used.is_dir()
    assert old.is_dir(), "nothing goes before it is asked for"
    collect(store, since)
    assert {path.name for path in old.parent.iterdir() if path.is_dir()} == {used.name, "notes"}


def test_what_a_dataset_and_the_last_run_were_computed_from_stays_and_the_rest_goes(store: Store, study: Path) -> None:
    before = {manifest.ref for manifest in store.artifacts()}
    collect(store, NOW)
    left = {manifest.ref for manifest in store.artifacts()}
    latest = read_latest(store, "toy")
    roots = [ref for stage in latest.stages for ref in latest.refs(stage)]
    with_dataset = {step.ref for ref in roots for step in lineage(store, ref)} | {
        manifest.ref for manifest in Store(store.root).artifacts() if manifest.parameters.get("scale") == 1.0
    }
    assert with_dataset <= left
    assert len(before - left) == 13, "grow, bend and judge of the second run; aside is the same in all three"
    assert all(manifest.parameters.get("scale") != 2.0 for manifest in store.artifacts())
    assert verify(store).is_ok
    assert plan_toys(study, store.root, "grow.scale=3.0").is_fresh
    assert plan_toys(study, store.root).is_fresh, "the dataset keeps what its run needs"
    assert not plan_toys(study, store.root, "grow.scale=2.0").is_fresh
    assert collect(store, NOW).num_bytes == 0


def test_a_damaged_record_of_a_run_hinders_neither_gc_nor_new_datasets(store: Store, invoke_toys: CommandLine) -> None:
    (list_runs(store)[0].path / "run.json").write_text("[]")
    assert find_garbage(store, NOW).num_datasets == 1
    invoke_toys("dataset", "create", "again", "--study", "toy", "--store", store)


def test_what_a_dataset_of_an_older_schema_names_stays(store: Store) -> None:
    going = {artifact.place for artifact in find_garbage(store, NOW).artifacts.going}
    list_as_of_schema_1(store.root / "datasets" / "first@1")
    garbage = find_garbage(store, NOW)
    assert ({artifact.place for artifact in garbage.artifacts.going}, garbage.num_datasets) == (going, 1)


def test_a_run_of_some_stages_does_not_push_out_the_last_one_of_the_others(store: Store, study: Path) -> None:
    whole = [folder.run_id for folder in list_runs(store)][-1]
    some = run_toys(study, store.root, "grow.scale=4.0", selection=StageSelection(until="grow")).run_id
    kept = find_garbage(store, NOW).kept_runs
    assert {whole, some} <= set(kept)
    last = run_toys(study, store.root, "grow.scale=5.0").run_id
    assert list(find_garbage(store, NOW).kept_runs) == [last]


def test_a_first_run_protects_its_new_store(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path / "new")

    def collect_instead(*_: object, is_quiet: bool) -> None:
        collect(store, NOW)

    monkeypatch.setattr("flows.console.run._build", collect_instead)
    with pytest.raises(StorageError, match="plans or builds in the store"):
        build(Run(*load_study(str(study), TOYS), store), ClusterSettings(), is_quiet=True)
    assert collect(store, NOW).num_bytes == 0, "the lock is held no longer than the run"


def test_an_unfinished_run_does_not_push_out_the_last_finished_one(store: Store, study: Path) -> None:
    class Interrupted(HerePool):
        def work(self) -> NoReturn:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_toys(study, store.root, "grow.scale=4.0", pool=Interrupted(str(store.root)))
    run_toys(study, store.root, "grow.scale=3.0", selection=StageSelection(until="grow"))
    collect(store, NOW)
    assert plan_toys(study, store.root, "grow.scale=3.0").is_fresh


def test_what_runs_and_writers_of_the_last_days_left_stays(store: Store) -> None:
    week = datetime.now(UTC) - timedelta(days=7)
    assert find_garbage(store, week).num_bytes == 0
    folder = next(path for path in (store.root / "runs").iterdir() if path.name not in ("latest", ".in_use.lock"))
    folder.rename(folder.with_name("20010101T000000-toy-abcdef"))
    garbage = find_garbage(store, week)
    assert list(garbage.going_runs) == ["20010101T000000-toy-abcdef"]
    assert garbage.artifacts.going == (), "artifacts are young though their run is old"


def test_a_dry_run_is_the_default_and_counts_what_yes_frees(store: Store, gc: CommandLine) -> None:
    before = files(store.root)
    lines = gc().out.splitlines()
    assert "nothing was removed; --yes removes" in lines[-1]
    assert [line.split()[0] for line in lines[2:-1]] == ["aside", "bend", "grow", "judge", "runs", "all"]
    described = gc("--json").json
    assert files(store.root) == before
    gc("--yes")
    after = {name: size for name, size in files(store.root).items() if not name.endswith(".lock")}
    assert set(after) < set(before)
    assert sum(before.values()) - sum(after.values()) == described["stages"]["all"]["bytes_going"]
    assert described["stages"]["grow"]["num_going"] == 6
    assert len(described["runs"]) == 2


def test_an_unneeded_damaged_manifest_goes_a_damaged_record_stops_gc(store: Store, gc: CommandLine) -> None:
    stray = commit_rows(store)
    (store.folder(stray.stage, stray.key) / "manifest.json").write_text("{")
    collect(store, NOW)
    assert not store.folder(stray.stage, stray.key).exists()
    before = files(store.root)
    (store.root / "runs" / "latest" / "toy.json").write_text("{")
    gc("--yes", code=1)
    assert set(files(store.root)) == set(before)


def test_folders_of_somebody_else_beside_the_artifacts_stay(store: Store) -> None:
    foreign = [store.root / place / "own.bvh" for place in ("subjects/60/60_03", "subjects/aa/" + "b" * 64)]
    for path in foreign:
        path.parent.mkdir(parents=True)
        path.write_text("mine")
    collect(store, NOW)
    assert all(path.is_file() for path in foreign)


def test_nothing_goes_where_what_is_kept_does_not_say_what_it_was_computed_from(tmp_path: Path) -> None:
    store = Store(tmp_path)
    take = commit_rows(store, "poses", stage="ingest")
    score = commit_rows(store, inputs=(take,))
    create_dataset(store, "first", [score])
    manifest = store.folder(score.stage, score.key) / "manifest.json"
    manifest.write_text("{")
    with pytest.raises(CorruptArtifact, match="is to be kept and its manifest is damaged"):
        collect(store, NOW)
    manifest.unlink()
    manifest.mkdir()
    with pytest.raises(CorruptArtifact, match="cannot be read"):
        collect(store, NOW)
    assert store.find(take.stage, take.key) is not None


@pytest.fixture
def running(store: Store) -> Iterator[Path]:
    """Return the record of a run of the second study whose process lives."""
    run = store.root / "runs" / "20010101T000000-toy-abcdef"
    run.mkdir()
    process = subprocess.Popen(["sleep", "60"])
    values = {"study": "toy", "run_id": run.name, "pid": process.pid, "host": platform.node(), "status": "running"}
    (run / "run.json").write_text(json.dumps(values))
    yield run
    process.kill()
    process.wait()


def test_nothing_is_removed_while_a_run_is_in_progress(store: Store, running: Path, gc: CommandLine) -> None:
    before = files(store.root)
    assert f"run {running.name} is in progress" in gc("--yes", code=1).err
    assert before.keys() == files(store.root).keys() - {"runs/.in_use.lock"}
    values = json.loads((running / "run.json").read_text())
    (running / "run.json").write_text(json.dumps({**values, "host": "elsewhere", "pid": 1}))
    with pytest.raises(StoreInUseError, match="on elsewhere"):
        collect(store, NOW)
    (running / "run.json").write_text(json.dumps({**values, "pid": 2**22 + 1}))
    assert collect(store, NOW).going_runs.keys() >= {running.name}, "its process is gone"


def test_gc_and_runs_exclude_each_other(store: Store, study: Path, gc: CommandLine) -> None:
    with in_use(store), in_use(store):
        assert "a run plans or builds in the store" in gc("--yes", code=1).err
    codes: list[int] = []
    words = ("run", str(study), "--store", str(store), "--set", "grow.scale=3.0", "--workers", "0")
    run = threading.Thread(target=lambda: codes.append(call(*words)))
    with in_use(store, alone=True):
        run.start()
        run.join(0.5)
        assert run.is_alive()
    run.join(30.0)
    assert codes == [0]


def test_a_store_that_is_not_there_is_said(tmp_path: Path, invoke_toys: CommandLine) -> None:
    assert "there is no store in" in invoke_toys.at(tmp_path / "typo").refusal("gc", "--yes")
    assert not (tmp_path / "typo").exists()
