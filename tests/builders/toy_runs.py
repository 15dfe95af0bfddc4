"""Runs of the toy stages for tests: in this process without Prefect and Dask, or as a person would start them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import pytest
from distributed import Client

from flows.console.app import run_command_line
from flows.execution import begin, execute
from flows.outcomes import Outcome, Run
from flows.planning import Plan, StageSelection, make_plan
from flows.study import load_study
from storage_schema import Store, read_latest
from tasks.graph import Graph
from tasks.shards import HerePool, Pool
from tests.builders.toys import TOYS

ROOT = Path(__file__).parents[2]
STUDY = '[study]\nname = "toy"\nseed = 7\n'


def write_study(folder: Path, text: str = STUDY) -> Path:
    path = folder / "toy.toml"
    path.write_text(text)
    return path


def plan_toys(
    study: Path, store: Path, *settings: str, selection: StageSelection | None = None, graph: Graph = TOYS
) -> Plan:
    chosen, stages = load_study(str(study), graph, settings=settings, environment={})
    return make_plan(chosen, stages, Store(store), selection)


def run_toys(
    study: Path,
    store: Path,
    *settings: str,
    selection: StageSelection | None = None,
    graph: Graph = TOYS,
    pool: Pool | None = None,
) -> Outcome:
    """Run in this process, without Prefect and Dask."""
    chosen, stages = load_study(str(study), graph, settings=settings, environment={})
    run = Run(chosen, stages, Store(store), selection or StageSelection())
    plan = make_plan(chosen, stages, run.store, selection)
    return execute(run, begin(run, plan), plan, pool or HerePool(str(store)))


def call(*arguments: str) -> int:
    """Call the command line with the graph of the toys; gives its exit code."""
    return run_command_line(arguments, graph=TOYS)


def build_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command line build in this process, without Prefect and Dask."""
    monkeypatch.setattr(
        "flows.console.run._build",
        lambda run, plan, *_, **__: execute(run, begin(run, plan), plan, HerePool(str(run.store))),
    )


def digests(store: Path, study: str = "toy") -> dict[str, list[str]]:
    """Return the content digests of every stage of the last run."""
    latest = read_latest(Store(store), study)
    assert latest is not None
    return {stage: [ref.content_digest for ref in latest.refs(stage)] for stage in latest.stages}


def computed(outcome: Outcome) -> dict[str, int]:
    """Return how many shards were computed of each stage of which any was."""
    return {stage.name: stage.num_computed for stage in outcome.stages if stage.num_computed}


def states(plan: Plan) -> dict[str, str]:
    """Return each stage's state in a word, or its counts."""
    words = {}
    for stage in plan.stages:
        counts: dict[str, int] = {}
        for item in stage.shards:
            counts[item.state.value] = counts.get(item.state.value, 0) + 1
        words[stage.stage.name] = (
            "pending" if stage.is_pending else ", ".join(f"{counts[name]} {name}" for name in sorted(counts))
        )
    return words


class Gates:
    """The folder in which toy shards note that they begin, and at whose gates they wait or fail."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "gates"
        self.folder.mkdir()

    def close(self, *shards: str, what: Literal["hold", "fail"] = "hold") -> None:
        """Let shards wait, or "fail"."""
        for shard in shards:
            (self.folder / f"{what}-{shard}").touch()

    def open(self) -> None:
        """Let all shards go on."""
        for gate in self.folder.glob("*-*"):
            gate.unlink()

    def begun(self) -> list[tuple[str, int]]:
        """Return shards and the processes that began to compute them, in that order."""
        notes = self.folder / "ran.txt"
        lines = [line.split() for line in notes.read_text().splitlines()] if notes.exists() else []
        return [(shard, int(process)) for shard, process in lines]

    def ran(self) -> list[str]:
        """Return the shards whose computation began, in that order."""
        return [shard for shard, _ in self.begun()]

    def wait_for(self, *shards: str, run: subprocess.Popen[str] | None = None) -> None:
        """Wait until these shards' computation began; fail at once if the process that runs them ends before."""
        wait_until(
            lambda: {*shards} <= {*self.ran()} or (run is not None and run.poll() is not None), f"{shards} to begin"
        )
        assert run is None or run.poll() is None, run.communicate()


class Outside:
    """A scheduler and a worker that no run has started."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        self._file.unlink(missing_ok=True)
        self._environment = {**os.environ, "TOY_FOLDER": str(folder / "gates")}
        self.processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self.start("scheduler", "--host", "127.0.0.1", "--port", "0")
        wait_until(lambda: self._file.exists() and "}" in self._file.read_text(), "the scheduler")
        self.address: str = json.loads(self._file.read_text())["address"]
        self.worker = self.start("worker")

    def start(self, kind: str, *more: str) -> subprocess.Popen[bytes]:
        """Start a scheduler or one more worker."""
        more = (*more, "--nthreads", "1", "--no-nanny") if kind == "worker" else more
        log = self._file.with_name("processes.log").open("ab")
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", kind, "--scheduler-file", str(self._file), "--no-dashboard", *more],
            cwd=ROOT,
            env=self._environment,
            stdout=log,
            stderr=log,
        )
        log.close()
        self.processes.append(process)
        return process

    def __enter__(self) -> Outside:
        """Wait for the worker."""
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(1)
        return self

    def __exit__(self, *_: object) -> None:
        """End all of it."""
        for process in self.processes:
            process.kill()
            process.wait()


def wait_until(is_so: Callable[[], bool], what: str, *, limit_s: float = 120.0) -> None:
    deadline = time.monotonic() + limit_s
    while not is_so():
        assert time.monotonic() < deadline, f"waited {limit_s:.0f} s for {what}"
        time.sleep(0.02)
