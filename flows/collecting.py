"""Garbage collection of a store: keeps what datasets, studies and recent runs need."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

from flows.records import PLAN_FILE, describe_runs, made_by, run_file, run_record
from storage_schema import Store, in_use, latest_studies, list_runs, read_latest
from storage_schema.datasets import dataset_labels, named_places
from storage_schema.folder_store import FolderStore
from storage_schema.garbage import StageKey, Sweep, find_unneeded, folder_bytes, remove_unneeded
from storage_schema.unpacked import unused_clips

_BEGUN = re.compile(r"\d{8}T\d{6}(?=-)")


class StoreInUseError(Exception):
    """A run is in progress in the store, so nothing is removed from it; the message names it."""


@dataclass(frozen=True)
class Collection:
    """Artifacts to keep and to remove, and folders of runs by id with their bytes.

    Also the folders of unpacked clips in the cache, of any store.
    """

    artifacts: Sweep
    kept_runs: dict[str, int]
    going_runs: dict[str, int]
    kept_clips: dict[Path, int]
    going_clips: dict[Path, int]
    num_datasets: int

    @property
    def num_bytes(self) -> int:
        """Return the bytes to remove."""
        folders = chain(self.going_runs.values(), self.going_clips.values())
        return sum(stored.num_bytes for stored in self.artifacts.going) + sum(folders)


def find_garbage(store: Store, since: datetime) -> Collection:
    """Return the needed and the removable artifacts of a store.

    Needed are the artifacts of datasets, of the record of each study, of the last finished run of each of its stages,
    of runs begun at or after `since`, all artifacts made since, and all ancestors of these. Unpacked clips are needed
    if they were used since.

    Raises:
        CorruptArtifact: A dataset or the record of a study cannot be read, so that its needs are unknown.
    """
    needed: set[StageKey] = named_places(store)
    runs = set()
    latest = [last for study in latest_studies(store) if (last := read_latest(store, study)) is not None]
    for last in latest:
        runs.add(last.run_id)
        needed.update((stage, shard.key) for stage, shards in last.stages.items() for shard in shards)
    last_of: dict[tuple[str, str], str] = {}
    for folder in list_runs(store):
        record = run_record(store, folder.run_id)
        if record.get("status") == "finished":
            last_of |= {(record["study"], stage["stage"]): folder.run_id for stage in record["stages"]}
        begun = _BEGUN.match(folder.run_id)
        if begun is None or datetime.strptime(begun[0], "%Y%m%dT%H%M%S").replace(tzinfo=UTC) >= since:
            runs.add(folder.run_id)
    runs.update(last_of.values())
    needed.update(place for run_id in runs for place in _made_or_found(store, run_id))
    kept_clips, going_clips = ({path: folder_bytes(path) for path in paths} for paths in unused_clips(since))
    sizes = {folder.run_id: folder_bytes(folder.path) for folder in list_runs(store)}
    return Collection(
        artifacts=find_unneeded(store, needed, since),
        kept_runs={run_id: size for run_id, size in sizes.items() if run_id in runs},
        going_runs={run_id: size for run_id, size in sizes.items() if run_id not in runs},
        kept_clips=kept_clips,
        going_clips=going_clips,
        num_datasets=len(dataset_labels(store)),
    )


def collect(store: Store, since: datetime) -> Collection:
    """Remove what `find_garbage` finds unneeded. After a kill at any moment, the same call finishes the work.

    Raises:
        StoreInUseError: A run is in progress.
        StorageError: Another process is planning or building here.
        CorruptArtifact: As `find_garbage`.
    """
    with in_use(store, alone=True):
        for run in describe_runs(store):
            if run["status"] == "running" and isinstance(store, FolderStore):  # a build in a bucket holds its lease
                raise StoreInUseError(
                    f"run {run['run_id']} is in progress on {run['host']}, so nothing is removed; wait until it ends, "
                    "or stop it (it continues later); if it died there, remove its folder in runs/"
                )
        sweep = find_garbage(store, since)
        remove_unneeded(store, sweep.artifacts)
        store.remove_folders(store.root / "runs" / run_id for run_id in sweep.going_runs)
    for path in sweep.going_clips:
        shutil.rmtree(path, ignore_errors=True)  # another process may remove files of it, too
    return sweep


def _made_or_found(store: Store, run_id: str) -> Iterator[StageKey]:
    """Yield what a run made and what it planned: an unfinished run found and began more than it recorded."""
    yield from (ref.place for ref in made_by(store, run_id))
    for stage in run_file(store, run_id, PLAN_FILE).get("stages", []):
        yield from ((stage["stage"], shard["key"]) for shard in stage.get("shards", []))
