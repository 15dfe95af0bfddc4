"""Runs an action on a store again and again in child processes that die by SIGKILL, each a step later than the last.

A step is a call that opens, makes, renames or removes something under the store, or brings a file to the disk.  After
every death the store is looked at, then the action is run to its end and the store is looked at again.  Prints one JSON
object.

Usage: `python -m tests.builders.storage_killer ACTION FOLDER`
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from storage_schema import (
    ShardRecord,
    Store,
    create_dataset,
    list_datasets,
    read_latest,
    record_latest,
    staging,
    verify,
)
from storage_schema.garbage import find_unneeded, remove_unneeded
from tests.builders.storage_rows import commit_rows

EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree"}


def commit(store: Store) -> str:
    """Commit an artifact with a table and an attachment."""
    return commit_rows(store, "poses", 30, stage="ingest", attachments={"note.txt": b"note"}).content_digest


def prepare_damaged(store: Store) -> None:
    """Leave an artifact whose table is cut short under the key that `commit` uses."""
    ref = commit_rows(store, "poses", 30, stage="ingest", attachments={"note.txt": b"note"})
    path = store.folder(ref.stage, ref.key) / "poses.parquet"
    path.write_bytes(path.read_bytes()[:-7])


def replace(store: Store) -> str:
    """Commit other bytes under the key that `commit` uses, in the place of what is there."""
    more: dict[str, Any] = {"attachments": {"note.txt": b"a longer note"}, "replaces": True}
    return commit_rows(store, "poses", 30, stage="ingest", **more).content_digest


def replace_in_two_steps(store: Store) -> str:
    """Do so on a file system that cannot exchange folders."""
    staging.exchange_folders = lambda folder, target: False
    return replace(store)


def prepare_record(store: Store) -> None:
    """Leave a record of an earlier run."""
    record_latest(store, "duets", "old", {"ingest": [_shard("a")]})


def record(store: Store) -> str:
    """Record a later run."""
    record_latest(store, "duets", "new", {"seeds": [_shard("b")]})
    return str(read_latest(store, "duets"))


def prepare_refs(store: Store) -> None:
    """Leave an artifact to make a dataset of."""
    commit_rows(store)


def make_dataset(store: Store) -> str:
    """Make version 1 of a dataset, when it is not there."""
    if not list_datasets(store):
        create_dataset(store, "released", [commit_rows(store)], attachments={"card.md": b"# Card"})
    return list_datasets(store)[0].digest


def prepare_unneeded(store: Store) -> None:
    """Leave two artifacts that stay, one read by the other, and three that go, in a chain."""
    take = commit_rows(store, "poses", stage="ingest")
    commit_rows(store, inputs=(take,))
    end = commit_rows(store, "poses", stage="ingest", name="old")
    for stage in ("seeds", "chains"):
        end = commit_rows(store, "seeds", stage=stage, name="old", inputs=(end,))


def sweep(store: Store) -> str:
    """Remove what the score of `prepare_unneeded` was not computed from."""
    needed = [("evaluation", folder.name) for folder in store.folders("evaluation")]
    remove_unneeded(store, find_unneeded(store, needed, datetime.max.replace(tzinfo=UTC)))
    return str([manifest.ref for manifest in store.artifacts()])


def _shard(key: str) -> ShardRecord:
    return ShardRecord("p", "n", key * 64, key * 64, 1, 0, {})


ACTIONS: dict[str, tuple[Callable[[Store], object], Callable[[Store], str]]] = {
    "commit": (lambda store: None, commit),
    "heal": (prepare_damaged, commit),
    "replace": (commit, replace),
    "replace_in_two_steps": (commit, replace_in_two_steps),
    "record": (prepare_record, record),
    "sweep": (prepare_unneeded, sweep),
    "dataset": (prepare_refs, make_dataset),
}


def die_at(step: int, root: Path) -> None:
    """Kill this process when it comes to this step, counted from 0."""
    count = 0

    def next_step() -> None:
        nonlocal count
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in EVENTS and str(arguments[0]).startswith(str(root)):
            next_step()

    def fsync(handle: int) -> None:
        next_step()
        real_fsync(handle)

    real_fsync = os.fsync
    os.fsync = fsync
    sys.addaudithook(hook)


def look(store: Store) -> dict[str, Any]:
    """Say what a reader sees."""
    latest = read_latest(store, "duets")
    manifests = list(store.artifacts())
    refs = [manifest.ref for manifest in manifests]
    return {
        "artifacts": [ref.content_digest for ref in refs],
        "lost_inputs": [ref.key for manifest in manifests for ref in manifest.inputs if ref not in refs],
        "problems": [str(problem) for problem in verify(store).problems],
        "datasets": [dataset.label for dataset in list_datasets(store)],
        "latest": latest and latest.run_id,
    }


def run(action: str, folder: Path) -> dict[str, Any]:
    """Kill the action at every step; gives what was seen after each death and after each rerun."""
    prepare, act = ACTIONS[action]
    quiet = Store(folder / "undisturbed")
    prepare(quiet)
    expected = act(quiet)
    deaths: list[dict[str, Any]] = []
    while True:
        step = len(deaths)
        root = folder / str(step)
        prepare(Store(root))
        child = os.fork()
        if child == 0:
            die_at(step, root)
            act(Store(root))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if action == "replace_in_two_steps":
            Store(root).prepare()
        after_death = look(Store(root))
        said = act(Store(root))
        after_rerun = look(Store(root)) | {"is_same": said == expected, "tmp": _names(root / "tmp")}
        deaths.append({"death": after_death, "rerun": after_rerun})
        if os.WIFEXITED(status):
            return {"deaths": deaths, "exit": os.WEXITSTATUS(status), "undisturbed": look(quiet)}


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


if __name__ == "__main__":
    json.dump(run(sys.argv[1], Path(sys.argv[2])), sys.stdout)
