"""The artifact store: finds, reads and commits artifacts in a folder that many processes share.

Layout: `<root>/<stage>/<key[:2]>/<key>/` holds `<table>.parquet` files, attachments and `manifest.json`; `tmp/` holds
what is being written, `runs/` and `datasets/` what runs and people say about artifacts.  A folder appears under its key
in one rename after everything in it has reached the disk, so an artifact is whole or absent, whatever is killed.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NotRequired, TypedDict, Unpack

from storage_schema.artifact_writer import ArtifactWriter
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.datasets import datasets_with
from storage_schema.durable import make_folder, sync_folder, write_errors, write_file
from storage_schema.errors import CorruptArtifact, MissingArtifact, NamedByDataset, StorageError
from storage_schema.keys import content_digest, plain_json
from storage_schema.manifest import MANIFEST_NAME, RESERVED_NAMES, ArtifactRef, Manifest
from storage_schema.provenance import code_version, package_versions, source_digest
from storage_schema.staging import StagingFolder, clean_leftovers, replace_file
from storage_schema.store_reader import STORE_FILE, StoreReader
from storage_schema.version import SCHEMA_VERSION

SHARD_S, PROCESSOR_S = "shard_s", "processor_s"
"""Timings of an artifact that was measured: from the shard's beginning to its commit."""

_STAGE_NAME = re.compile(r"[a-z][a-z0-9_]*")

_log = logging.getLogger(__name__)


class ArtifactFields(TypedDict):
    """What an artifact says about itself when it is written."""

    stage: str
    """Name of the stage."""
    key: str
    """Key of the artifact, from `artifact_key`."""
    partition: str
    """What a person sees as one step."""
    name: str
    """Name of the shard in its partition."""
    version: int
    """Version of the stage."""
    parameters: Mapping[str, Any]
    """JSON values that decided the result."""
    seed: int
    """Seed of the study."""
    inputs: Sequence[ArtifactRef]
    """Artifacts that were read."""
    files: Sequence[tuple[str, str]]
    """Outside files that were read: (file name, sha256)."""
    reads: NotRequired[Mapping[str, Sequence[int]]]
    """Places in `inputs` of what enters the key, by what it is to the shard: `verify` computes the key again."""
    after: NotRequired[Sequence[str]]
    """Keys of other shards that enter the key."""
    replaces: NotRequired[bool]
    """Whether it takes the place of a valid artifact that is there, where its content is another or damaged."""


class Store(StoreReader):
    """Finds, reads and commits the artifacts under one folder.  Picklable: it is only the folder's path.

    Args:
        root: Folder of the store, or `s3://BUCKET/PREFIX`; made when something is first written.
    """

    _begun_s: tuple[float, float] | None = None

    def commit(
        self,
        *,
        tables: Mapping[str, Mapping[str, Any]],
        attachments: Mapping[str, bytes] | None = None,
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        **described: Unpack[ArtifactFields],
    ) -> ArtifactRef:
        """Write an artifact under its key, whole or not at all.

        When a valid artifact is already there (another process was first) this one is discarded and that one is given,
        unless this one `replaces` it: then both change places in one step, and a reader always finds one of them whole.

        Args:
            tables: For each table its columns: name to list or array, rows first (see `encoding.encode`).
            attachments: Files of their own format, by file name.
            facts: Small JSON facts that whatever is downstream may read.
            sources: Licence and credit of what comes in with this artifact, not of its inputs.
            described: What the artifact says about itself.

        Raises:
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            MissingArtifact: An input is not in the store.
            FullDisk: There is no room left.
            NewerSchema: The store was written by a newer program.
            NamedByDataset: A dataset needs what is there, and this has other bytes.
        """
        with self.writer(facts=facts, sources=sources, **described) as writer:
            for table, columns in tables.items():
                writer.append(table, columns)
            for file_name, data in (attachments or {}).items():
                writer.attach(file_name, data)
        return writer.ref

    def measure(self) -> None:
        """Begin to measure: artifacts say in `timings` what it took since now, wall clock and processor, seconds.

        The processor's is of this thread, so that shards beside it in the same worker do not count.
        """
        self._begun_s = (time.perf_counter(), time.thread_time())

    @contextmanager
    def writer(
        self,
        *,
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        **described: Unpack[ArtifactFields],
    ) -> Iterator[ArtifactWriter]:
        """Write an artifact piece by piece: rows are streamed to the disk, and the block's end commits.

        When the block raises, nothing stays behind.  Arguments and errors are those of `commit`.
        """
        stage, key = described["stage"], described["key"]
        if not _STAGE_NAME.fullmatch(stage) or stage in RESERVED_NAMES:
            raise StorageError(f"'{stage}' cannot name a stage: lower-case letters, digits and _ are allowed")
        self.prepare()
        with write_errors(self.root):
            staging = StagingFolder(self.staging_root)
        with closing(staging):
            with closing(ArtifactWriter(staging.path, where=self.root, facts=facts or {}, sources=sources)) as writer:
                yield writer
                parts, attachments = writer.finish()
            for ref in described["inputs"]:
                self.manifest(ref)
            plain_facts: dict[str, Any] = plain_json(writer.facts, "facts")
            digests = {f"{table}.parquet": part.sha256 for table, part in parts.items()}
            digests |= {file_name: entry.sha256 for file_name, entry in attachments.items()}
            place = {"partition": described["partition"], "name": described["name"]}
            manifest = Manifest(
                ref=ArtifactRef(stage, key, content_digest(**place, facts=plain_facts, files=digests)),
                partition=described["partition"],
                name=described["name"],
                version=described["version"],
                parameters=plain_json(dict(described["parameters"]), "parameters"),
                seed=described["seed"],
                inputs=tuple(described["inputs"]),
                files=tuple((file_name, digest) for file_name, digest in described["files"]),
                tables=parts,
                attachments=attachments,
                facts=plain_facts,
                sources=merge_credits(writer.sources),
                schema_version=SCHEMA_VERSION,
                code_version=code_version(),
                source_digest=source_digest(),
                package_versions=package_versions(),
                timings=plain_json({**writer.timings, **self._spent()}, "timings"),
                created_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
                reads=None
                if (reads := described.get("reads")) is None
                else {what: [*ats] for what, ats in reads.items()},
                after=tuple(described.get("after", ())),
            )
            with write_errors(self.root):
                write_file(staging.path / MANIFEST_NAME, manifest.to_json().encode())
                sync_folder(staging.path)
                writer.ref = self.put_in_place(staging, manifest, replaces=described.get("replaces", False))

    def discard(self, ref: ArtifactRef) -> None:
        """Remove an artifact, so that its key is missing; nothing happens when it is not there."""
        with write_errors(self.root):
            self.remove_folders([self.folder(ref.stage, ref.key)])

    def drop_damaged(self, manifest: Manifest) -> bool:
        """Remove an artifact where files of it are not what it says, so that the next run computes it again.

        For who builds; tells whether anything was removed.  In a mirror a damaged copy of a whole file goes alone.
        """
        if self.mirror is not None:
            folder = self.folder(manifest.ref.stage, manifest.ref.key)
            dropped = [self.mirror.drop_changed(folder / name, one) for name, one in manifest.data_files.items()]
            if any(dropped):
                return True
        is_damaged = bool(self.damaged_files(manifest))
        if is_damaged:
            self.discard(manifest.ref)
        return is_damaged

    def prepare(self) -> None:
        """Make the store's folder when it is not there, and clear away what dead processes left; once per object."""
        if self._is_checked and (self.root / STORE_FILE).is_file():
            return
        with write_errors(self.root):
            make_folder(self.root)
            if not (self.root / STORE_FILE).is_file():
                if self.mirror is not None:
                    self.mirror.remote.create(f"records/{STORE_FILE}", _store_text())
                replace_file(self.root / STORE_FILE, _store_text(), staging_root=self.staging_root)
        self.check_version()
        self.clear_leftovers()

    def can_write(self) -> bool:
        """Tell whether this process, a worker, can write to the store, which is there."""
        if self.mirror is None:
            return os.access(self.root, os.W_OK)
        with suppress(StorageError, FileNotFoundError):
            self.mirror.remote.changed_at("lease")
            self.mirror.remote.create(f"records/{STORE_FILE}", _store_text())  # which is there: asks for the right
            return True
        return False

    def clear_leftovers(self) -> None:
        """Remove what dead processes left half written; a process that is slow to die is left for the next time."""
        clean_leftovers(self.staging_root)

    def _spent(self) -> dict[str, float]:
        if self._begun_s is None:
            return {}
        now = (time.perf_counter(), time.thread_time())
        return {name: round(now[i] - self._begun_s[i], 4) for i, name in enumerate((SHARD_S, PROCESSOR_S))}

    def put_in_place(self, staging: StagingFolder, new: Manifest, *, replaces: bool = False) -> ArtifactRef:
        """Rename the staged folder of this manifest to its place; returns the artifact that is there in the end.

        Raises:
            NamedByDataset: A dataset needs what is there, and this has other bytes.
        """
        ref = new.ref
        target = self.folder(ref.stage, ref.key)
        if self.mirror is not None:
            kept = self.mirror.commit(staging.path, ref, lambda found: self._stays(found, new, replaces=replaces))
            if kept != ref:
                return kept
        make_folder(target.parent)
        go_there: Callable[[Path], object] = staging.path.rename
        while True:
            try:
                go_there(target)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise
            else:
                sync_folder(target.parent)
                return ref
            # Something is there: it goes only after it was seen not to stay, never for not having been there yet.
            found = self._there(ref) if self.mirror is None else None
            if found is not None and self._stays(found, new, replaces=replaces):
                return found.ref
            go_there = staging.take_place

    def _there(self, ref: ArtifactRef) -> Manifest | None:
        """Return the manifest under a key, also one of other columns, where its files are there; else None."""
        with suppress(MissingArtifact, CorruptArtifact):
            found = self.load(ref.stage, ref.key)
            return found if self.has_files(found) else None
        return None

    def _stays(self, found: Manifest, new: Manifest, *, replaces: bool) -> bool:
        """Tell whether an artifact that is there keeps its place against a new one under its key."""
        ref, is_valid = new.ref, not self.outdated_tables(found)
        if found.ref.content_digest == ref.content_digest:
            if not replaces or not is_valid:
                return is_valid
            has_same_keys = [one.key for one in found.inputs] == [one.key for one in new.inputs]
            is_as_described = found.computed_digest == ref.content_digest
            # Into a bucket the parts have just come again.
            return has_same_keys and is_as_described and (self.mirror is not None or not self.damaged_files(found))
        if is_valid and not replaces:
            _log.warning(
                "artifact %s@%s was computed a second time with other bytes (%s, kept is %s)",
                *(ref.stage, ref.key[:12], ref.content_digest[:12], found.ref.content_digest[:12]),
            )
            return True
        if self.mirror is not None:
            self.mirror.bring_datasets()
        if (dataset := next(datasets_with(self, found.ref), None)) is not None:
            raise NamedByDataset(
                f"artifact {ref.stage}@{ref.key[:12]} was computed again with other bytes, and dataset {dataset.label} "
                "needs the old one, which stays; raise the version of the stage in its `Stage(...)` to have both"
            )
        return False

    def remove_folders(self, targets: Iterable[Path]) -> None:
        """Remove folders of the store in this order, each in one rename; those that are not there are skipped."""
        targets = list(targets)
        if self.mirror is not None:
            self.mirror.withdraw(targets)
        if not any(target.exists() for target in targets):
            return
        parents = set()
        with closing(StagingFolder(self.staging_root)) as staging:
            for target in targets:
                with suppress(FileNotFoundError):  # moved away by another
                    target.rename(staging.path / uuid.uuid4().hex)
                    parents.add(target.parent)
            for parent in parents:
                sync_folder(parent)


def _store_text() -> bytes:
    return f"{json.dumps({'schema_version': SCHEMA_VERSION})}\n".encode()
