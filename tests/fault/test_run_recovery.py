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

import pytest
from distributed import Client

from flows.outcomes import Outcome
from flows.progress import Listener
from flows.records import describe_runs
from storage_schema import Store
from tasks.shards import ClusterError, ClusterPool, ClusterSettings, connect
from tests.builders.real_study import RealRun, wait_until_gone
from tests.builders.toy_runs import ROOT, Gates, Outside, call, digests, run_toys, wait_until, write_study

pytestmark = pytest.mark.slow

EVERYTHING = 14
_KILLED_IN_A_RUN = """
import os, sys
from tasks.shards import ClusterSettings, connect
with connect(ClusterSettings(scheduler=sys.argv[1]), store_root=sys.argv[2]):
    os.kill(os.getpid(), 9)
"""
Start = Callable[..., RealRun]


@pytest.fixture
def start(tmp_path: Path, gates: Gates, prefect_home: Path) -> Start:
    """Return a function that starts the run of the toy study with some workers, in a process of its own."""
    study = write_study(tmp_path)

    def start(num_workers: int) -> RealRun:
        return RealRun(
            *("run", study, "--store", tmp_path / "store", "--workers", str(num_workers), "--oversubscribe"),
            prefect_home=prefect_home,
            program=("-m", "tests.builders.toys"),
        )

    return start


def test_a_run_killed_in_mid_stage_leaves_no_process_and_the_next_one_computes_only_the_rest(
    start: Start, gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    gates.close("grow-t1-s1")
    run = start(2)
    gates.wait_for("grow-t1-s1", run=run.process)
    run.wait_for_artifacts(tmp_path / "store", 9)
    left = run.kill()
    assert len(left) >= 3, "two workers and Prefect's server"
    wait_until_gone(left)
    begun = gates.ran()
    gates.open()

    assert run_toys(tmp_path / "toy.toml", tmp_path / "store").num_computed == EVERYTHING - 9
    again = gates.ran()[len(begun) :]
    assert len(again) == EVERYTHING - 9, "aside, four segments and what is made of these were committed"
    assert {"grow-t1-s1", "grow-t1-s2"} <= set(again)
    assert not {"grow-t0-s0", "grow-t0-s1", "grow-t0-s2", "grow-t1-s0", "aside-aside-all", "bend-t0-s0"} & set(again)
    assert digests(tmp_path / "store") == undisturbed


@pytest.mark.parametrize(
    ("number", "is_for_all"),
    [(signal.SIGINT, True), (signal.SIGTERM, True), (signal.SIGHUP, False)],
    ids=["SIGINT", "SIGTERM", "SIGHUP to the command alone"],
)
def test_what_ends_a_run_from_outside_ends_everything_and_the_next_run_goes_on(
    start: Start,
    gates: Gates,
    tmp_path: Path,
    undisturbed: dict[str, list[str]],
    number: signal.Signals,
    is_for_all: bool,
) -> None:
    gates.close("bend-t0-s1")
    if signal.getsignal(number) is signal.SIG_IGN:  # tests that run under `nohup` ignore SIGHUP, and so would the run
        signal.signal(number, signal.SIG_DFL)
    run = start(1)
    gates.wait_for("bend-t0-s1", run=run.process)
    left = run.descendants()
    (os.killpg if is_for_all else os.kill)(run.process.pid, number)
    answer = run.finish()
    assert (answer.code, answer.err.splitlines()[-1]) == (130, "interrupted; the same command continues the work")
    assert not [word for word in ("Traceback", "resource_tracker", "Warning") if word in answer.err], answer.err
    wait_until_gone(left, limit_s=5.0)
    gates.open()

    kept = len(list(Store(tmp_path / "store").artifacts()))
    assert kept >= 2, "what the shard in work was computed from"
    assert run_toys(tmp_path / "toy.toml", tmp_path / "store").num_computed == EVERYTHING - kept
    assert digests(tmp_path / "store") == undisturbed


def test_prefects_locked_database_and_its_killed_server_cost_the_run_nothing(
    start: Start, gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]], prefect_home: Path
) -> None:
    gates.close("grow-t0-s1")
    run = start(0)
    gates.wait_for("grow-t0-s1", run=run.process)
    (server,) = [p for p in run.descendants() if "flows.prefect_server" in p.cmdline()]
    with closing(sqlite3.connect(prefect_home / "prefect.db", timeout=60)) as database:
        database.execute("BEGIN IMMEDIATE")
        gates.open()
        gates.wait_for("judge-all-all", run=run.process)
        database.rollback()
    server.kill()
    answer = run.finish()
    assert answer.code == 0, answer.err
    assert f"done: {EVERYTHING} shards computed" in answer.out
    assert digests(tmp_path / "store") == undisturbed


def test_all_workers_killed_in_mid_shard_cost_their_shards_a_second_try_and_nothing_else(
    gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    held = ("grow-t0-s1", "grow-t1-s1")
    with in_mid_shard(tmp_path, gates, ClusterSettings(num_workers=2), *held) as run:
        for _, worker in [note for note in gates.begun() if note[0] in held]:
            os.kill(worker, signal.SIGKILL)
        wait_until(lambda: all(gates.ran().count(shard) == 2 for shard in held), "the shards' second try")
        gates.open()
        assert run.result(timeout=60).num_computed == EVERYTHING
    assert len(set(gates.ran())) == EVERYTHING
    assert len(gates.ran()) <= EVERYTHING + 4, "the killed workers may have held one more shard each"
    assert digests(tmp_path / "store") == undisturbed


def test_a_killed_scheduler_is_one_sentence_and_the_run_can_be_finished(
    gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]]
) -> None:
    with in_mid_shard_elsewhere(tmp_path, gates) as (outside, run):
        outside.scheduler.kill()
        with pytest.raises(ClusterError, match=r"^the Dask scheduler is gone; the same command continues the work$"):
            run.result(timeout=60)
    finish_here(tmp_path, gates, undisturbed)


def test_a_shard_of_a_late_worker_with_another_package_goes_to_one_that_is_fit_and_that_is_said(
    gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "1")  # the death of the first worker
    monkeypatch.setattr("tasks.shards.running._COUNT_AGAIN_S", 0.1)
    said: list[str] = []
    with in_mid_shard_elsewhere(tmp_path, gates, note=said.append) as (outside, run):
        outside.worker.kill()
        outside.start("worker", "--preload", str(unfit(tmp_path))).wait(timeout=60)
        assert " has numpy 1.0, here it is " in (tmp_path / "processes.log").read_text(), "in the worker's log"
        wait_until(lambda: any(" has numpy 1.0, here it is " in words for words in said), "a word of the run")
        another = outside.start("worker")
        gates.open()
        assert run.result(timeout=60).num_computed == EVERYTHING
    assert {worker for _, worker in gates.begun()} == {outside.worker.pid, another.pid}
    assert digests(tmp_path / "store") == undisturbed


def test_a_run_whose_last_worker_had_to_leave_says_why(
    gates: Gates, tmp_path: Path, undisturbed: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.shards.running._COUNT_AGAIN_S", 0.1)
    monkeypatch.setattr("tasks.shards.running._NO_WORKER_S", 0.1)
    with in_mid_shard_elsewhere(tmp_path, gates) as (outside, run):
        outside.start("worker", "--preload", str(unfit(tmp_path))).wait(timeout=60)
        assert not run.done(), "the first worker is there"
        outside.worker.kill()
        with pytest.raises(
            ClusterError,
            match=r"^worker tcp://.* has numpy 1\.0, here it is .*: results would differ; .*; no other worker came",
        ):
            run.result(timeout=60)
    finish_here(tmp_path, gates, undisturbed)


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


def finish_here(folder: Path, gates: Gates, undisturbed: dict[str, list[str]]) -> None:
    """Build in this process what a run left that failed."""
    store = folder / "store"
    gates.open()
    assert [run["status"] for run in describe_runs(Store(store))] == ["failed"]
    assert run_toys(folder / "toy.toml", store).num_computed < EVERYTHING
    assert digests(store) == undisturbed


@contextmanager
def in_mid_shard(
    folder: Path, gates: Gates, settings: ClusterSettings, *held: str, note: Callable[[str], None] | None = None
) -> Iterator[Future[Outcome]]:
    """Run the toys on a cluster in a thread, some shards of them held in work."""
    gates.close(*held)
    study, store = write_study(folder), folder / "store"
    store.mkdir()
    with ThreadPoolExecutor(1) as here, connect(settings, store_root=str(store)) as client:
        pool = ClusterPool(client, str(store), is_shared=settings.is_shared, note=note)
        run = here.submit(run_toys, study, store, pool=pool)
        gates.wait_for(*held)
        yield run


@contextmanager
def in_mid_shard_elsewhere(
    folder: Path, gates: Gates, *, note: Callable[[str], None] | None = None
) -> Iterator[tuple[Outside, Future[Outcome]]]:
    """Run the toys on somebody's cluster, one shard of them held in work."""
    with Outside(folder) as outside:
        settings = ClusterSettings(scheduler=outside.address)
        with in_mid_shard(folder, gates, settings, "grow-t0-s1", note=note) as run:
            yield outside, run


def test_shards_and_stages_that_need_nothing_of_what_failed_are_finished_and_what_needs_it_is_named(
    gates: Gates,
    tmp_path: Path,
    in_this_process: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    said: list[str] = []
    monkeypatch.setattr(Listener, "note", lambda _, words: said.append(words))
    gates.close("grow-t0-s1", "grow-t1-s2", what="fail")
    assert call("run", str(write_study(tmp_path)), "--store", str(tmp_path / "store")) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "stage grow, t0, shard s1: [Errno 28]" in error
    assert "stage grow, t1, shard s2: [Errno 28]" in error
    assert said == ["not run, as they need what failed: bend, judge, grow t0 s2"]
    committed = ("t0-s0", "t1-s0", "t1-s1")
    assert set(gates.ran()) == {f"grow-{shard}" for shard in (*committed, "t0-s1", "t1-s2")} | {
        "aside-aside-all",
        *(f"bend-{shard}" for shard in committed),
    }
