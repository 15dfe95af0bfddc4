"""Runs that are killed, interrupted or lose a worker: the same command finishes the job, bit for bit.

Real store, real two-process Dask cluster, real Prefect, in a process of its own as a person would start it.
"""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import psutil
import pytest
from distributed import Client

from flows.outcomes import Outcome
from flows.records import describe_runs
from storage_schema import Store
from tasks.shards import ClusterError, ClusterPool, ClusterSettings, connect
from tasks.shards.cluster import DEATHS_ALLOWED
from tests.builders.real_study import wait_until_gone
from tests.builders.toy_runs import ROOT, Outside, Started, digests, run_toys, wait_until, write_study

pytestmark = pytest.mark.slow

EVERYTHING = 14
_KILLED_IN_A_RUN = """
import os, sys
from tasks.shards import ClusterSettings, connect
with connect(ClusterSettings(scheduler=sys.argv[1]), store_root=sys.argv[2]):
    os.kill(os.getpid(), 9)
"""
Start = Callable[..., Started]


@pytest.fixture
def start(tmp_path: Path, prefect_home: Path) -> Start:
    """Return a function that starts the run of the toy study, with two workers if nothing else is said."""
    study = write_study(tmp_path)

    def start(*more: str) -> Started:
        arguments = ["run", str(study), "--store", str(tmp_path / "store"), *(more or ("--workers", "2"))]
        return Started([*arguments, "--oversubscribe"], gates=tmp_path / "gates", prefect_home=prefect_home)

    return start


def hold(folder: Path, name: str) -> Path:
    (folder / "gates").mkdir(exist_ok=True)
    gate = folder / "gates" / f"hold-{name}"
    gate.touch()
    return gate


def descendants(run: Started) -> list[psutil.Process]:
    return psutil.Process(run.process.pid).children(recursive=True)


def test_a_run_killed_in_mid_stage_leaves_no_process_and_the_next_one_computes_only_the_rest(
    start: Start, tmp_path: Path, undisturbed: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = hold(tmp_path, "grow-t1-s1")
    first = start()
    first.wait_for("grow-t1-s1")
    wait_until(lambda: len(list((tmp_path / "store").glob("*/*/*/manifest.json"))) == 9, "the other shards")
    left = descendants(first)
    assert len(left) >= 3, "two workers and Prefect's server"
    first.process.kill()
    first.finish()
    wait_until_gone(left)
    begun = first.ran()
    gate.unlink()

    monkeypatch.setenv("TOY_FOLDER", str(first.gates))
    assert run_toys(tmp_path / "toy.toml", tmp_path / "store").num_computed == EVERYTHING - 9
    again = first.ran()[len(begun) :]
    assert len(again) == EVERYTHING - 9, "aside, four segments and what is made of these were committed"
    assert {"grow-t1-s1", "grow-t1-s2"} <= set(again)
    assert not {"grow-t0-s0", "grow-t0-s1", "grow-t0-s2", "grow-t1-s0", "aside-aside-all", "bend-t0-s0"} & set(again)
    assert digests(tmp_path / "store") == undisturbed


@pytest.mark.parametrize(
    ("number", "is_for_all"),
    [(signal.SIGINT, True), (signal.SIGTERM, True), (signal.SIGHUP, True), (signal.SIGTERM, False)],
    ids=["SIGINT", "SIGTERM", "SIGHUP", "SIGTERM to the command alone"],
)
def test_what_ends_a_run_from_outside_ends_everything_and_the_next_run_goes_on(
    start: Start, tmp_path: Path, undisturbed: dict[str, list[str]], number: signal.Signals, is_for_all: bool
) -> None:
    gate = hold(tmp_path, "bend-t0-s1")
    if signal.getsignal(number) is signal.SIG_IGN:  # tests that run under `nohup` ignore SIGHUP, and so would the run
        signal.signal(number, signal.SIG_DFL)
    first = start("--workers", "1")
    first.wait_for("bend-t0-s1")
    left = descendants(first)
    (os.killpg if is_for_all else os.kill)(first.process.pid, number)
    code, _, err = first.finish()
    assert (code, err.splitlines()[-1]) == (130, "interrupted; the same command continues the work")
    assert not [word for word in ("Traceback", "resource_tracker", "Warning") if word in err], err
    wait_until_gone(left, limit_s=5.0)
    gate.unlink()

    kept = len(list(Store(tmp_path / "store").artifacts()))
    assert kept >= 2, "what the shard in work was computed from"
    assert run_toys(tmp_path / "toy.toml", tmp_path / "store").num_computed == EVERYTHING - kept
    assert digests(tmp_path / "store") == undisturbed


def test_all_workers_killed_in_mid_shard_cost_their_shards_a_second_try_and_nothing_else(
    start: Start, tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    held = ("grow-t0-s1", "grow-t1-s1")
    gates = [hold(tmp_path, name) for name in held]
    run = start()
    for name in held:
        run.wait_for(name)
    for name in held:
        os.kill(run.worker_of(name), signal.SIGKILL)
    wait_until(lambda: all(run.ran().count(name) == 2 for name in held), "the shards' second try")
    for gate in gates:
        gate.unlink()
    code, _, err = run.finish()
    assert code == 0, err
    assert len(set(run.ran())) == EVERYTHING
    assert len(run.ran()) <= EVERYTHING + 4, "the killed workers may have held one more shard each"
    assert digests(tmp_path / "store") == undisturbed


def test_prefects_locked_database_and_its_killed_server_cost_the_run_nothing(
    start: Start, tmp_path: Path, undisturbed: dict[str, list[str]], prefect_home: Path
) -> None:
    gate = hold(tmp_path, "grow-t0-s1")
    run = start()
    run.wait_for("grow-t0-s1")
    (server,) = [p for p in descendants(run) if "flows.prefect_server" in p.cmdline()]
    with closing(sqlite3.connect(prefect_home / "prefect.db", timeout=60)) as database:
        database.execute("BEGIN IMMEDIATE")
        gate.unlink()
        wait_until(lambda: "judge-all-all" in run.ran(), "all other work")
        database.rollback()
    server.kill()
    code, out, err = run.finish()
    assert code == 0, err
    assert f"done: {EVERYTHING} shards computed" in out
    assert digests(tmp_path / "store") == undisturbed


def test_a_killed_scheduler_is_one_sentence_and_the_run_can_be_finished(
    tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    with in_mid_shard_elsewhere(tmp_path) as (outside, run):
        outside.scheduler.kill()
        with pytest.raises(ClusterError, match=r"^the Dask scheduler is gone; the same command continues the work$"):
            run.result(timeout=60)
    finish_here(tmp_path, undisturbed)


def test_shards_of_late_workers_with_another_package_go_to_one_that_is_fit_and_that_is_said(
    tmp_path: Path, undisturbed: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.shards.running._COUNT_AGAIN_S", 0.1)
    said: list[str] = []
    with in_mid_shard_elsewhere(tmp_path, note=said.append) as (outside, run):
        outside.worker.kill()
        for late in [outside.start("worker", "--preload", str(unfit(tmp_path))) for _ in range(DEATHS_ALLOWED + 1)]:
            late.wait(timeout=60)
        assert " has numpy 1.0, here it is " in (tmp_path / "processes.log").read_text(), "in the worker's log"
        wait_until(lambda: any(" has numpy 1.0, here it is " in words for words in said), "a word of the run")
        another = outside.start("worker")
        (tmp_path / "gates" / "hold-grow-t0-s1").unlink()
        assert run.result(timeout=60).num_computed == EVERYTHING
    ran = (tmp_path / "gates" / "ran.txt").read_text().split()
    assert set(ran[1::2]) == {str(outside.worker.pid), str(another.pid)}
    assert digests(tmp_path / "store") == undisturbed


def test_a_run_whose_last_worker_had_to_leave_says_why(
    tmp_path: Path, undisturbed: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.shards.running._COUNT_AGAIN_S", 0.1)
    monkeypatch.setattr("tasks.shards.running._NO_WORKER_S", 0.1)
    with in_mid_shard_elsewhere(tmp_path) as (outside, run):
        outside.start("worker", "--preload", str(unfit(tmp_path))).wait(timeout=60)
        assert not run.done(), "the first worker is there"
        outside.worker.kill()
        with pytest.raises(
            ClusterError,
            match=r"^worker tcp://.* has numpy 1\.0, here it is .*: results would differ; .*; no other worker came",
        ):
            run.result(timeout=60)
    finish_here(tmp_path, undisturbed)


def test_workers_that_come_after_a_killed_run_need_not_have_its_store(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir()
    with Outside(tmp_path) as outside:
        probe = [sys.executable, "-c", _KILLED_IN_A_RUN, outside.address, str(store)]
        killed = subprocess.run(probe, cwd=ROOT, check=False)
        assert killed.returncode == -signal.SIGKILL
        store.rmdir()
        outside.worker.kill()
        outside.worker.wait()
        late, another = outside.start("worker"), tmp_path / "another"
        another.mkdir()
        with Client(outside.address, set_as_default=False) as client:
            wait_until(lambda: is_alone(client, late.pid), "the late worker")
        with connect(ClusterSettings(scheduler=outside.address), store_root=str(another)) as client:
            assert client.submit(os.getpid).result(timeout=30) == late.pid


def is_alone(client: Client, pid: int) -> bool:
    """Tell whether the only worker is this one."""
    return list(client.run(os.getpid, on_error="ignore").values()) == [pid]


def unfit(folder: Path) -> Path:
    """Return what a worker loads first to have another version of a package."""
    file = folder / "unfit.py"
    file.write_text(
        "import tasks.shards.cluster as cluster\n"
        "mine = cluster.package_versions()\n"
        "cluster.package_versions = lambda: {**mine, 'numpy': '1.0'}\n"
    )
    return file


def finish_here(folder: Path, undisturbed: dict[str, list[str]]) -> None:
    """Build in this process what a run left that failed."""
    study, store = folder / "toy.toml", folder / "store"
    (folder / "gates" / "hold-grow-t0-s1").unlink()
    assert [one["status"] for one in describe_runs(Store(store))] == ["failed"]
    assert run_toys(study, store).num_computed < EVERYTHING
    assert digests(store) == undisturbed


@contextmanager
def in_mid_shard_elsewhere(
    folder: Path, *, note: Callable[[str], None] | None = None
) -> Iterator[tuple[Outside, Future[Outcome]]]:
    """Run the toys on somebody's cluster, one shard of them held in work."""
    hold(folder, "grow-t0-s1")
    study, store, ran = write_study(folder), folder / "store", folder / "gates" / "ran.txt"
    store.mkdir()
    with Outside(folder) as outside:
        settings = ClusterSettings(scheduler=outside.address)
        with ThreadPoolExecutor(1) as here, connect(settings, store_root=str(store)) as client:
            run = here.submit(run_toys, study, store, pool=ClusterPool(client, str(store), is_shared=True, note=note))
            wait_until(lambda: ran.exists() and "grow-t0-s1" in ran.read_text(), "a shard in work")
            yield outside, run


def test_shards_and_stages_that_need_nothing_of_what_failed_are_finished(
    start: Start, tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    (tmp_path / "gates").mkdir()
    faults = [tmp_path / "gates" / f"fail-grow-{name}" for name in ("t0-s1", "t1-s2")]
    for fault in faults:
        fault.touch()
    first = start()
    code, _, err = first.finish()
    assert code == 1
    last = err.strip().splitlines()[-1]
    assert "stage grow, t0, shard s1: [Errno 28]" in last
    assert "stage grow, t1, shard s2: [Errno 28]" in last
    assert "not run, as they need what failed: bend, judge, grow t0 s2" in err
    begun = first.ran()
    committed = ("t0-s0", "t1-s0", "t1-s1")
    assert set(begun) == {f"grow-{name}" for name in (*committed, "t0-s1", "t1-s2")} | {
        "aside-aside-all",
        *(f"bend-{name}" for name in committed),
    }
    for fault in faults:
        fault.unlink()
    assert run_toys(tmp_path / "toy.toml", tmp_path / "store").num_computed == EVERYTHING - 1 - 2 * len(committed)
    assert digests(tmp_path / "store") == undisturbed
