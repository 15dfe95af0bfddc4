"""Reads a dataset's folder into a store, and builds it again from its record."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flows.dataset_folder.contents import find_contents
from flows.dataset_folder.describing import ARTIFACTS_FILE, attachment_name
from flows.dataset_folder.layout import RECORD, FolderManifest, read_manifest, read_sides
from flows.dataset_folder.writing import fill_folder, plan_files
from flows.finished_builds import Recorded
from flows.planning import PlanError
from flows.records import ENVIRONMENT_FILE
from storage_schema import TABLES, ArtifactRef, CorruptArtifact, Dataset, Manifest, Store, in_use, source_credits
from storage_schema.arrow import arrow_schema
from storage_schema.credits import merge_credits
from storage_schema.datasets import DATASET_FILE, add_dataset, dataset_digest, dataset_from_json, open_dataset
from storage_schema.durable import sync_folder, write_errors, write_file
from storage_schema.errors import DatasetExists
from storage_schema.keys import file_sha256
from storage_schema.manifest import MANIFEST_NAME
from storage_schema.parquet_files import TableWriter
from storage_schema.remote import check_ids
from storage_schema.runs import STUDY_FILE
from storage_schema.staging import StagingFolder

_Place = tuple[str, int]
"""A data file and the number of a row group in it."""


def is_folder(name: str) -> bool:
    """Return whether this is the path of a dataset's folder."""
    return read_manifest(Path(name)) is not None


def read_folder(folder: Path, store: Store) -> tuple[Dataset, int]:
    """Read a dataset's folder into a store.

    An artifact that is complete in the folder keeps its bytes; one without some rows or inputs becomes another
    artifact, with its own key and digest.

    Returns:
        The dataset in the store, and the number of artifacts that were new there.

    Raises:
        PlanError: It is no folder of a dataset.
        CorruptArtifact: A file is not what the manifest says, or the store has other bytes under a key.
        DatasetExists: The store has another dataset of this name and version.
        FullDisk: There is no room left.
    """
    manifest = _checked(folder)
    listed, files = read_record(folder)
    artifacts = _artifacts(folder)
    path = store.root / "datasets" / manifest.label
    store.prepare()
    parts = _parts_of(manifest)
    known: dict[ArtifactRef, ArtifactRef] = {}
    num_new = 0
    with in_use(store):
        for artifact in _in_order(artifacts):
            known[artifact.ref], is_new = _bring(artifact, known, parts, folder, store)
            num_new += is_new
        refs = tuple(known[ref] for ref in listed.refs)
        dataset = replace(listed, refs=refs, digest=dataset_digest(refs, listed.sources), path=path)
        if not add_dataset(store, dataset, files) and open_dataset(store, dataset.label).digest != dataset.digest:
            raise DatasetExists(f"the store {store} has another {dataset.label} already, which never changes")
    return dataset, num_new


def read_record(folder: Path) -> tuple[Dataset, dict[str, bytes]]:
    """Return a folder's dataset and its files by name: study and environment."""
    record = folder / RECORD
    listed = dataset_from_json((record / DATASET_FILE).read_bytes, record)
    return listed, {
        name: (record / name).read_bytes() for name in (STUDY_FILE, ENVIRONMENT_FILE) if (record / name).is_file()
    }


def read_recorded_folder(folder: Path) -> Recorded:
    """Return the record of a folder's dataset; PlanError if it lacks the study."""
    listed, files = read_record(folder)
    if missing := [name for name in (STUDY_FILE, ENVIRONMENT_FILE) if name not in files]:
        raise PlanError(f"{folder / RECORD / missing[0]} is not there, so the dataset cannot be built again")
    artifacts = {(artifact.ref.stage, artifact.partition, artifact.name): artifact for artifact in _artifacts(folder)}
    named = frozenset(ref.stage for ref in listed.refs)
    sections, environment = (json.loads(files[name]) for name in (STUDY_FILE, ENVIRONMENT_FILE))
    return Recorded(listed.label, sections, environment, artifacts, named, listed.sources)


def rebuild_folder(folder: Path, store: Store, refs: tuple[ArtifactRef, ...]) -> list[str]:
    """Write a folder again from rebuilt artifacts, and return the names of the files that differ.

    Afterwards the store has the dataset of this name and version.

    Raises:
        DatasetExists: The store has another one already.
    """
    manifest = _checked(folder)
    listed, files = read_record(folder)
    order = {ref: at for at, ref in enumerate(listed.refs)}  # the plan may order stages differently
    refs = tuple(sorted(refs, key=lambda ref: order.get(ref, len(order))))
    names = {source.name for source in listed.sources}
    sources = merge_credits(listed.sources, (new for new in source_credits(store, *refs) if new.name not in names))
    path = store.root / "datasets" / listed.label
    dataset = replace(listed, refs=refs, sources=sources, digest=dataset_digest(refs, sources), path=path)
    if not add_dataset(store, dataset, files) and open_dataset(store, dataset.label).digest != dataset.digest:
        raise DatasetExists(f"the store {store} has another {dataset.label} already; --store names another one")
    contents = find_contents(store, dataset, withheld=manifest.withheld, known=read_sides(folder))
    with closing(StagingFolder(store.staging_root)) as staging:
        again = fill_folder(
            store, contents, plan_files(contents, manifest), staging.path / "again", withheld=manifest.withheld
        )
    every = {*manifest.files, *again.files}
    if [artifact.ref for artifact in _artifacts(folder)] == [manifest.ref for manifest in contents.manifests]:
        every -= {f"{RECORD}/{ARTIFACTS_FILE}"}  # the same content, from another program or machine
    return [name for name in sorted(every) if _sha256(manifest, name) != _sha256(again, name)]


def _sha256(manifest: FolderManifest, name: str) -> str:
    return manifest.files[name].sha256 if name in manifest.files else ""


def _checked(folder: Path) -> FolderManifest:
    """Return the manifest of a folder, after checking its files."""
    manifest = read_manifest(folder)
    if manifest is None:
        raise PlanError(f"{folder} is no folder of a dataset; `pasdedeux dataset write` writes one")
    for name, file in manifest.files.items():
        try:
            is_same = (folder / name).stat().st_size == file.bytes and file_sha256(folder / name) == file.sha256
        except OSError:
            is_same = False
        if not is_same:
            raise CorruptArtifact(f"{folder / name} is missing, or is not what the manifest of the folder says")
    return manifest


def _artifacts(folder: Path) -> list[Manifest]:
    """Return the manifests of a folder's artifacts."""
    path = folder / RECORD / ARTIFACTS_FILE
    try:
        listed = json.loads(path.read_bytes())["artifacts"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorruptArtifact(f"{path} cannot be read: {error!r}") from error
    return [Manifest.from_json(json.dumps(values).encode(), where=str(path)) for values in listed]


def _read_group(folder: Path, table: str, place: _Place) -> Any:
    """Return the rows of a row group.

    Raises:
        CorruptArtifact: The group cannot be read, or has other columns than this program declares.
    """
    try:
        with pq.ParquetFile(folder / place[0]) as file:
            return file.read_row_group(place[1], use_threads=False).cast(arrow_schema(TABLES[table]))
    except (OSError, ValueError, pa.ArrowException) as error:
        raise CorruptArtifact(f"{folder / place[0]} cannot be read: {error}") from error


def _in_order(artifacts: list[Manifest]) -> Iterator[Manifest]:
    """Yield artifacts after their inputs."""
    waiting = {artifact.ref: artifact for artifact in artifacts}
    while waiting:
        ready = [artifact for artifact in waiting.values() if waiting.keys().isdisjoint(artifact.inputs)]
        if not ready:
            raise CorruptArtifact("the artifacts of the folder were computed from each other in a circle")
        yield from ready
        for artifact in ready:
            del waiting[artifact.ref]


def _parts_of(manifest: FolderManifest) -> dict[tuple[str, str, str], list[_Place]]:
    """Return the row groups of each artifact's table in order, by stage, content and table."""
    parts = defaultdict[tuple[str, str, str], list[tuple[Any, _Place]]](list)
    for name, file in manifest.files.items():
        for number, (stage, digest, rows) in enumerate(file.parts):
            if rows:
                parts[stage, digest, name.split("/")[1]].append((rows, (name, number)))
    return {key: [place for _, place in sorted(places)] for key, places in parts.items()}


def _bring(
    recorded: Manifest,
    known: Mapping[ArtifactRef, ArtifactRef],
    parts: Mapping[tuple[str, str, str], list[_Place]],
    folder: Path,
    store: Store,
) -> tuple[ArtifactRef, bool]:
    """Put an artifact of a folder into a store, and return whether it is new there."""
    inputs = tuple(known[ref] for ref in recorded.inputs if ref in known)
    with write_errors(store.root), closing(StagingFolder(store.staging_root)) as staging:
        tables = {}
        for table in recorded.tables:
            writer = TableWriter(staging.path / f"{table}.parquet", TABLES[table])
            for place in parts.get((recorded.ref.stage, recorded.ref.content_digest, table), ()):
                writer.append_rows(_read_group(folder, table, place))
            tables[table] = writer.finish()
        for name in recorded.attachments:
            if Path(name).name != name:
                raise CorruptArtifact(f"{folder} names an attachment '{name}' that it does not have")
            shutil.copyfile(folder / attachment_name(recorded, name), staging.path / name)
        brought = replace(recorded, tables=tables, inputs=inputs)
        if brought != recorded or [ref.key for ref in inputs] != [ref.key for ref in recorded.inputs]:
            brought = replace(brought, digest="")
        if brought.computed_digest != recorded.ref.content_digest or inputs != recorded.inputs:
            key = hashlib.sha256(f"{recorded.ref.key} {brought.computed_digest}".encode()).hexdigest()
            brought = replace(brought, ref=ArtifactRef(brought.ref.stage, key, brought.computed_digest), reads=None)
        check_ids(brought, staging.path, str(folder))
        there = store.find(*brought.ref.place)
        if there is not None:
            if there.ref != brought.ref:
                raise CorruptArtifact(
                    f"the store {store} has other bytes for artifact {brought.ref.stage}@{brought.ref.key[:12]}"
                )
            return there.ref, False
        write_file(staging.path / MANIFEST_NAME, brought.to_json().encode())
        sync_folder(staging.path)
        return store.put_in_place(staging, brought), True
