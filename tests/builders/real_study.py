"""Small studies over every real stage, and the command line as a person calls it: here, or in a process of its own.

What the command line refuses, it refuses before it imports Prefect, so such calls are made in this process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from flows.console.app import run_command_line
from storage_schema import Store, read_latest
from tasks.graph import Graph, load_graph
from tests.builders.command_line import Answer
from tests.builders.toy_runs import ROOT, run_toys, wait_until

STUDIES = Path(__file__).with_name("studies")
SMALL = (STUDIES / "small.toml").read_text()
"""Every stage on two duets of a second or two, one of them held out; computed in some 20 s of processor time."""


def graph() -> Graph:
    """Return the graph of all real stages."""
    return load_graph()


def build_here(study: Path, store: Path, *settings: str) -> dict[str, int]:
    """Bring a study up to date in this process, without Prefect and Dask; gives the shards computed per stage."""
    outcome = run_toys(study, store, *settings, graph=graph())
    return {stage.name: stage.num_computed for stage in outcome.stages}


def digests(store: Path, study: str = "small") -> dict[tuple[str, str, str], str]:
    """Return the content digest of every artifact of the last run by (stage, partition, shard)."""
    latest = read_latest(Store(store), study)
    assert latest is not None, f"nothing was built in {store}"
    return {
        (stage, shard.partition, shard.name): shard.content_digest
        for stage, shards in latest.stages.items()
        for shard in shards
    }


def committed(store: Path) -> dict[tuple[str, str, str], str]:
    """Return when each artifact of a store was made, by (stage, partition, shard): a new time means computed again."""
    return {(m.ref.stage, m.partition, m.name): m.created_at for m in Store(store).artifacts()}


def never_begun(store: Path) -> bool:
    """Tell whether nothing was computed or recorded in a store."""
    return not store.exists() or (not committed(store) and not list((store / "runs").glob("*-*")))


def call_in_process(capsys: Any, *arguments: str | Path) -> Answer:
    """Call the command line in this process: for what does not get as far as computing."""
    code = run_command_line([str(argument) for argument in arguments], graph=graph())
    said = capsys.readouterr()
    return Answer(code, said.out, said.err)


def refused(capsys: Any, study: Path, *more: str | Path, commands: Sequence[str] = ("run",)) -> str:
    """Return the one sentence with which commands refuse a study; nothing may have been begun in `store` beside it."""
    store, sentences = study.parent / "store", set()
    for command in commands:
        answer = call_in_process(capsys, command, study, "--store", store, *more)
        assert (answer.code, answer.out, answer.err.count("\n")) == (2, "", 1), answer
        assert answer.err.startswith("error: ")
        sentences.add(answer.err.removeprefix("error: ").rstrip())
    assert never_begun(store)
    assert len(sentences) == 1
    return sentences.pop()


@dataclass(frozen=True)
class BuiltStudy:
    """A study that was built: its file, its store, and what the command said."""

    study: Path
    store: Path
    answer: Answer

    def copy_store(self, folder: Path) -> Path:
        """Return a copy of the store to compute in: an artifact's place is not in its key."""
        return Path(shutil.copytree(self.store, folder / "copy"))


class RealRun:
    """The command line in a process of its own, as the leader of a process group like a job of a shell."""

    def __init__(
        self,
        *arguments: str | Path,
        prefect_home: Path,
        program: Sequence[str] = ("-m", "flows.console"),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        surroundings = {**os.environ, "PREFECT_HOME": str(prefect_home), **(environment or {})}
        surroundings.pop("PREFECT_API_URL", None)
        self.process = subprocess.Popen(
            [sys.executable, *program, *(str(argument) for argument in arguments)],
            cwd=ROOT,
            env=surroundings,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def finish(self, *, limit_s: float = 600.0) -> Answer:
        """Wait for the end."""
        out, err = self.process.communicate(timeout=limit_s)
        return Answer(self.process.returncode, out, err)

    def wait_for_artifacts(self, store: Path, count: int) -> None:
        """Wait until this many artifacts are committed."""
        wait_until(
            lambda: len(list(store.glob("*/??/*/manifest.json"))) >= count or self.process.poll() is not None,
            f"{count} artifacts",
            limit_s=240.0,
        )
        assert self.process.poll() is None, self.process.communicate()

    def kill(self) -> list[psutil.Process]:
        """Do `kill -9` to the process alone; gives the processes that it had started, which must now end too."""
        left = self.descendants()
        self.process.kill()
        self.process.communicate()
        return left

    def descendants(self) -> list[psutil.Process]:
        """Return every process that this one has started."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def workers(self) -> list[psutil.Process]:
        """Return the Dask workers: processes that Python's multiprocessing spawned and that listen to the scheduler."""
        return [p for p in self.descendants() if command_of(p).find("spawn_main") >= 0]


def wait_until_gone(processes: Sequence[psutil.Process], *, limit_s: float = 60.0) -> None:
    """Wait until none of these processes runs any more."""
    wait_until(lambda: not any(_is_running(p) for p in processes), "the run's processes to end", limit_s=limit_s)


def command_of(process: psutil.Process) -> str:
    """Return the command line of a process, empty where it is gone."""
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def _is_running(process: psutil.Process) -> bool:
    # A killed process whose first thread is gone looks dead while another still waits for the disk, with its locks.
    try:
        return process.is_running() and (process.status() != psutil.STATUS_ZOMBIE or process.num_threads() > 1)
    except psutil.NoSuchProcess:
        return False
