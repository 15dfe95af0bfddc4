"""Garbage collection: keeps all ancestors of kept artifacts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from graphlib import TopologicalSorter
from pathlib import Path

from storage_schema.errors import CorruptArtifact, MissingArtifact, OlderSchema
from storage_schema.manifest import MANIFEST_NAME, Manifest
from storage_schema.store import Store

StageKey = tuple[str, str]
"""An artifact with any content."""

_KEY = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Stored:
    """The artifact under a key: creation time, inputs, and bytes on the disk with the manifest's.

    A folder with a damaged manifest counts with the time of its last change; its inputs are unknown.
    """

    place: StageKey
    num_bytes: int
    made_at: datetime
    inputs: tuple[StageKey, ...] = ()
    is_damaged: bool = False


@dataclass(frozen=True)
class Sweep:
    """The kept and the removable artifacts of a store, each of the latter before its inputs."""

    kept: tuple[Stored, ...]
    going: tuple[Stored, ...]


def find_unneeded(store: Store, needed: Iterable[StageKey], since: datetime) -> Sweep:
    """Select needed artifacts: these, those made at or after a time, and all ancestors of either.

    Raises:
        NewerSchema: The store was written by a newer program.
        CorruptArtifact: A manifest may not be read, or that of a kept artifact is damaged, so that its needs are
            unknown.
    """
    store.check_version()
    store.clear_leftovers()
    by_place = {stored.place: stored for stored in _all(store)}
    waiting = [place for place in needed if place in by_place]
    waiting += [place for place, stored in by_place.items() if stored.made_at >= since]
    kept: set[StageKey] = set()
    while waiting:
        place = waiting.pop()
        if place not in kept:
            if by_place[place].is_damaged:
                raise CorruptArtifact(
                    f"artifact {place[0]}@{place[1][:12]} is to be kept and its manifest is damaged, so what it was "
                    f"computed from is not known and nothing is removed; remove its folder {store.folder(*place)} and "
                    "run its study"
                )
            kept.add(place)
            waiting += [read for read in by_place[place].inputs if read in by_place]
    reads = {place: [read for read in stored.inputs if read in by_place] for place, stored in by_place.items()}
    order = reversed(list(TopologicalSorter(reads).static_order()))
    return Sweep(
        kept=tuple(stored for place, stored in by_place.items() if place in kept),
        going=tuple(by_place[place] for place in order if place not in kept),
    )


def remove_unneeded(store: Store, sweep: Sweep) -> None:
    """Remove the garbage. After a kill at any moment the store is intact, and the same call finishes the work."""
    store.remove_folders(store.folder(*stored.place) for stored in sweep.going)
    store.clear_leftovers()
    store.sweep()


def folder_bytes(folder: Path) -> int:
    """Return the bytes of all files in a folder and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _all(store: Store) -> Iterator[Stored]:
    for folder in store.folders():
        place = (folder.parent.parent.name, folder.name)
        if not _KEY.fullmatch(folder.name) or folder != store.folder(*place):
            continue  # a foreign folder: a store may be among other files
        inputs: tuple[StageKey, ...] = ()
        is_damaged = True
        manifest: Manifest | None = None
        with suppress(FileNotFoundError):  # removed by another process
            made_at = datetime.fromtimestamp(folder.stat().st_mtime, UTC)
            try:
                manifest = store.load(*place)
                made_at = datetime.fromisoformat(manifest.created_at)
                inputs = tuple((ref.stage, ref.key) for ref in manifest.inputs)
                is_damaged = False
            except OlderSchema:  # only fields that all schemas have are known
                with suppress(ValueError, KeyError, TypeError):
                    values = json.loads((folder / MANIFEST_NAME).read_bytes())
                    made_at = datetime.fromisoformat(values["created_at"])
                    inputs = tuple((ref["stage"], ref["key"]) for ref in values["inputs"])
                    is_damaged = False
            except (MissingArtifact, ValueError):
                pass
            except CorruptArtifact as error:
                if isinstance(error.__cause__, OSError):
                    raise
            if manifest is None:
                num_bytes = folder_bytes(folder)
            else:
                num_bytes = manifest.num_bytes + (folder / MANIFEST_NAME).stat().st_size
            yield Stored(place, num_bytes, made_at, inputs, is_damaged)
