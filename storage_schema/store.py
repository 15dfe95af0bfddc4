"""The artifact store: finds, reads and commits artifacts, shared by many processes.

Layout of a store's folder: `<root>/<stage>/<key[:2]>/<key>/` holds `<table>.parquet` files, attachments and
`manifest.json`; `tmp/` holds unfinished files, `runs/` and `datasets/` the records of runs and datasets. An artifact
appears under its key in one step, after all its files are synced to the disk, so it is complete or absent after any
kill. A store in S3-compatible storage is read through such a folder on this machine, its mirror.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Unpack

from storage_schema.arrow import schema_digest
from storage_schema.artifact_writer import ArtifactFields, ArtifactWriter
from storage_schema.credits import SourceCredit
from storage_schema.datasets import datasets_with
from storage_schema.durable import sync_folder, write_errors, write_file
from storage_schema.errors import CorruptArtifact, MissingArtifact, NamedByDataset, NotAStore, StorageError
from storage_schema.manifest import MANIFEST_NAME, RESERVED_NAMES, ArtifactRef, FileEntry, Manifest, refuse_newer
from storage_schema.parquet_files import iter_table, read_table
from storage_schema.staging import StagingFolder, clean_leftovers
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES

SHARD_S, PROCESSOR_S = "shard_s", "processor_s"
"""Timings of a measured artifact, from the start of its shard to its commit."""
STORE_FILE = "store.json"

_STAGE_NAME = re.compile(r"[a-z][a-z0-9_]*")
_S3 = re.compile(r"s3:/*(.*)")
"""An address in S3-compatible storage, also as a path, with one slash."""
_log = logging.getLogger(__name__)


class Store:
    """Finds, reads and commits artifacts: `Store(place)` is a `FolderStore` or a `BucketStore`, by the place.

    Picklable by its place, which is also its text.

    Args:
        place: Folder of the store, or `s3://BUCKET/PREFIX`; created at the first write.
    """

    root: Path
    """Folder with the layout of a store: its own, or its local mirror."""
    place: str

    def __new__(cls, place: str | Path) -> Store:
        """Open the kind of store that the place names."""
        if cls is not Store:
            return super().__new__(cls)
        if there := _S3.fullmatch(str(place)):
            from storage_schema.bucket_store import BucketStore  # here, as folders need no client

            return BucketStore(f"s3://{there[1]}")
        from storage_schema.folder_store import FolderStore

        return super().__new__(FolderStore)

    def _set_up(self, root: Path, place: str) -> None:
        self.root, self.place = root, place
        self._is_checked = False
        self._begun = threading.local()
        # Strings, because a plan reads 100,000 artifacts: making a path takes longer than opening a file.
        self._prefix, self._version_file = f"{root}/", f"{root}/{STORE_FILE}"

    def __repr__(self) -> str:
        return f"Store({self.place!r})"

    def __str__(self) -> str:
        return self.place

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Store) and self.root == other.root

    def __hash__(self) -> int:
        return hash(self.root)

    def __reduce__(self) -> tuple[type[Store], tuple[str]]:
        return Store, (self.place,)

    # Operations of the kinds of stores

    def refresh(self) -> None:
        """Bring the view of the store up to date, where it is not read directly; RemoteError if it does not answer."""

    def in_use(self, *, alone: bool = False) -> AbstractContextManager[None]:
        """Protect the store from garbage collection in this block; `alone`: nobody else may plan or build meanwhile.

        Raises:
            StorageError: Another process uses the store, and `alone` was requested.
            RemoteError: It does not answer.
        """
        raise NotImplementedError

    def bring(self, stage: str, key: str, *, known: ArtifactRef | None = None) -> None:
        """Bring the manifest of an artifact into `root` as it is now, if `known` is not there."""

    def has_files(self, manifest: Manifest) -> bool:
        """Return whether every file of an artifact is there with the right size."""
        raise NotImplementedError

    def data_file(self, ref: ArtifactRef, name: str, entry: FileEntry) -> Path:
        """Return the local path of a data file of an artifact, for reading only.

        It is fetched if necessary. CorruptArtifact if it is missing or damaged, or its name would lead out of the
        artifact's folder.
        """
        raise NotImplementedError

    def file_sha256(self, ref: ArtifactRef, name: str, entry: FileEntry) -> str:
        """Return the sha256 of the bytes of a data file in the store; OSError if they cannot be read."""
        raise NotImplementedError

    def drop_copies(self, manifest: Manifest) -> bool:
        """Remove local copies of data files whose bytes are not the store's; return whether there were any."""
        return False

    def prepare(self) -> None:
        """Create the store if necessary, and remove leftovers of dead processes; once per object."""
        raise NotImplementedError

    def can_write(self) -> bool:
        """Return whether this process, a worker, can write to the existing store."""
        raise NotImplementedError

    def put_in_place(self, staging: StagingFolder, new: Manifest, *, replaces: bool = False) -> ArtifactRef:
        """Put the staged files of this manifest under its key; return the artifact that is there in the end.

        Raises:
            NamedByDataset: A dataset refers to the artifact of this key, which has different bytes.
        """
        raise NotImplementedError

    def add_dataset(self, staged: Path, label: str) -> bool:
        """Rename the staged folder of a dataset to its name in one step; return false if the name is taken."""
        raise NotImplementedError

    def remove_folders(self, targets: Iterable[Path]) -> None:
        """Remove artifacts and runs by their folders, in this order, each in one step; missing ones are skipped."""
        raise NotImplementedError

    def sweep(self) -> None:
        """Remove files that belong to no artifact."""

    # Finding and reading

    @property
    def staging_root(self) -> Path:
        """Folder of unfinished artifacts."""
        return self.root / "tmp"

    def folder(self, stage: str, key: str) -> Path:
        """Return the folder that holds, or would hold, the artifact of this key."""
        return self.root / stage / key[:2] / key

    def find(self, stage: str, key: str) -> Manifest | None:
        """Return the artifact's manifest if it is valid and its files have the right sizes, else None.

        An artifact whose tables have other columns than this program declares is not valid either. NewerSchema if the
        store was written by a newer program.
        """
        self.check_version()
        self.bring(stage, key)
        try:
            manifest = self.load(stage, key)
        except (MissingArtifact, CorruptArtifact):
            return None
        return manifest if not self.outdated_tables(manifest) and self.has_files(manifest) else None

    def manifest(self, ref: ArtifactRef) -> Manifest:
        """Return the manifest of an artifact.

        Raises:
            MissingArtifact: It is not in the store.
            CorruptArtifact: Its manifest cannot be read, or its content is not the one that `ref` names.
            NewerSchema: The store was written by a newer program.
        """
        self.check_version()
        self.bring(ref.stage, ref.key, known=ref)
        manifest = self.load(ref.stage, ref.key)
        if manifest.ref != ref:
            raise CorruptArtifact(
                f"artifact {ref.stage}@{ref.key[:12]} holds the content {manifest.ref.content_digest[:12]}, "
                f"not {ref.content_digest[:12]}: it was rebuilt with other bytes"
            )
        return manifest

    def artifacts(self, stage: str | None = None) -> Iterator[Manifest]:
        """Return the manifests of all valid artifacts, of one stage or of all, in the order of stage and key."""
        for folder in self.folders(stage):
            manifest = self.find(folder.parent.parent.name, folder.name)
            if manifest is not None:
                yield manifest

    def folders(self, stage: str | None = None, key_prefix: str = "") -> list[Path]:
        """Return the folders of artifacts, valid or not, in the order of stage and key."""
        paths = self.root.glob(
            f"{stage or '*'}/{key_prefix[:2] or '*'}{'*' if len(key_prefix) == 1 else ''}/{key_prefix}*"
        )
        return sorted(path for path in paths if path.parent.parent.name not in RESERVED_NAMES and path.is_dir())

    def read(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None, rows: slice | None = None
    ) -> TableData:
        """Read the artifact's part of a table, or some of its columns and rows, with the declared schema.

        Raises:
            MissingArtifact: The artifact, or this table of it, is not in the store.
            CorruptArtifact: A file does not match its manifest.
            SchemaError: A column is unknown, or the file was written with other columns.
        """
        table_data = read_table(self.table_path(ref, table), TABLES[table], columns=columns, rows=rows)
        self.manifest(ref)  # another may have taken its place before the file was opened
        return table_data

    def iter_batches(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None
    ) -> Iterator[TableData]:
        """Read the artifact's part of a table some 10,000 rows at a time; raises what `read` raises."""
        yield from iter_table(self.table_path(ref, table), TABLES[table], columns=columns)
        self.manifest(ref)  # as in `read`

    def attachment(self, ref: ArtifactRef, name: str) -> bytes:
        """Return the bytes of an attached file; MissingArtifact without it, CorruptArtifact if the file is gone."""
        manifest = self.manifest(ref)
        if name not in manifest.attachments:
            there = ", ".join(manifest.attachments) or "none"
            raise MissingArtifact(f"artifact {ref.stage}@{ref.key[:12]} has no attachment '{name}'; it has: {there}")
        path = self.data_file(ref, name, manifest.attachments[name])
        if not path.is_file():
            raise CorruptArtifact(f"{path} is missing though its manifest names it")
        data = path.read_bytes()
        self.manifest(ref)  # as in `read`
        return data

    def load(self, stage: str, key: str) -> Manifest:
        """Return the manifest under a key in `root`, whether or not its files exist.

        Raises:
            MissingArtifact: There is none.
            CorruptArtifact: It cannot be read, or belongs to another artifact.
            NewerSchema: It was written by a newer program.
        """
        path = f"{self._prefix}{stage}/{key[:2]}/{key}/{MANIFEST_NAME}"
        try:
            with open(path, "rb", buffering=0) as file:  # noqa: PTH123
                text = file.read()
        except (FileNotFoundError, NotADirectoryError):
            raise MissingArtifact(f"artifact {stage}@{key[:12]} is not in the store {self}") from None
        except OSError as error:
            raise CorruptArtifact(f"{path} cannot be read: {error}") from error
        manifest = Manifest.from_json(text, where=path)
        if (manifest.ref.stage, manifest.ref.key) != (stage, key):
            raise CorruptArtifact(
                f"{path} is the manifest of another artifact: {manifest.ref.stage}@{manifest.ref.key[:12]}"
            )
        return manifest

    def outdated_tables(self, manifest: Manifest) -> list[str]:
        """Return the tables of an artifact that were written with other columns than this program declares."""
        return [
            table for table, part in manifest.tables.items() if table not in TABLES or part.schema != _declared(table)
        ]

    def table_path(self, ref: ArtifactRef, table: str) -> Path:
        """Return the path of the artifact's part of a table, for reading only; MissingArtifact without one."""
        manifest = self.manifest(ref)
        if table not in manifest.tables or table not in TABLES:
            there = ", ".join(manifest.tables) or "none"
            raise MissingArtifact(f"artifact {ref.stage}@{ref.key[:12]} holds no table '{table}'; it holds: {there}")
        name = f"{table}.parquet"
        return self.data_file(ref, name, manifest.data_files[name])

    def damaged_files(self, manifest: Manifest) -> list[str]:
        """Return the files that are missing or differ, each read twice; not those that cannot be read."""

        def is_damaged(name: str, entry: FileEntry) -> bool:
            try:
                return self.file_sha256(manifest.ref, name, entry) != entry.sha256
            except FileNotFoundError:
                return True
            except (OSError, StorageError):
                return False

        return [n for n, entry in manifest.data_files.items() if is_damaged(n, entry) and is_damaged(n, entry)]

    def check_version(self) -> None:
        """Refuse a store of a newer program (NewerSchema) and other files (NotAStore); checked once per object."""
        if self._is_checked:
            return
        try:
            with open(self._version_file, "rb") as file:  # noqa: PTH123
                version = json.load(file)["schema_version"]
        except FileNotFoundError:
            return
        except NotADirectoryError:
            raise NotAStore(f"{self.root} is not a store: it is a file, not a folder") from None
        except (ValueError, KeyError, TypeError) as error:
            raise NotAStore(f"{self.root} is not a store: {STORE_FILE} cannot be read ({error})") from error
        refuse_newer(version, f"the store {self}")
        self._is_checked = True

    # Committing and removing

    def commit(
        self,
        *,
        tables: Mapping[str, Mapping[str, Any]],
        attachments: Mapping[str, bytes] | None = None,
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        **described: Unpack[ArtifactFields],
    ) -> ArtifactRef:
        """Write an artifact under its key in one step.

        If a valid artifact is already there (another process was first), this one is discarded and the other returned,
        unless this one `replaces` it: then they are exchanged in one step, and readers always find one of them
        complete.

        Args:
            tables: For each table its columns: name to list or array, rows first (see `encoding.encode`).
            attachments: Files of their own format, by file name.
            facts: Small JSON facts for later stages.
            sources: Licence and credit of new sources, not of the inputs.
            described: The description of the artifact.

        Raises:
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            MissingArtifact: An input is not in the store.
            FullDisk: There is no room left.
            NewerSchema: The store was written by a newer program.
            NamedByDataset: A dataset refers to the artifact of this key, which has different bytes.
        """
        with self.writer(facts=facts, sources=sources, **described) as writer:
            for table, columns in tables.items():
                writer.append(table, columns)
            for file_name, data in (attachments or {}).items():
                writer.attach(file_name, data)
        return writer.ref

    def measure(self) -> None:
        """Start the clocks for `timings` of artifacts: wall clock and processor time from now, seconds.

        Both are those of this thread, so that other shards in the same worker do not count.
        """
        self._begun.at_s = (time.perf_counter(), time.thread_time())

    @contextmanager
    def writer(
        self,
        *,
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        **described: Unpack[ArtifactFields],
    ) -> Iterator[ArtifactWriter]:
        """Write an artifact piece by piece: rows are streamed to the disk, and the end of the block commits.

        If the block raises, nothing is left. Arguments and errors are those of `commit`.
        """
        stage = described["stage"]
        if not _STAGE_NAME.fullmatch(stage) or stage in RESERVED_NAMES:
            raise StorageError(f"'{stage}' cannot name a stage: lower-case letters, digits and _ are allowed")
        self.prepare()
        with write_errors(self.root):
            staging = StagingFolder(self.staging_root)
        with closing(staging):
            with closing(ArtifactWriter(staging.path, where=self.root, facts=facts or {}, sources=sources)) as writer:
                yield writer
                manifest = writer.finish(self._spent(), described)
            for ref in described["inputs"]:
                self.manifest(ref)
            with write_errors(self.root):
                write_file(staging.path / MANIFEST_NAME, manifest.to_json().encode())
                sync_folder(staging.path)
                writer.ref = self.put_in_place(staging, manifest, replaces=described.get("replaces", False))

    def discard(self, ref: ArtifactRef) -> None:
        """Remove an artifact, if it is there."""
        with write_errors(self.root):
            self.remove_folders([self.folder(ref.stage, ref.key)])

    def drop_damaged(self, manifest: Manifest) -> bool:
        """Remove an artifact whose files do not match its manifest, so that the next run computes it again.

        For builds. Return whether anything was removed; of a damaged local copy only the copy is removed.
        """
        if self.drop_copies(manifest):
            return True
        is_damaged = bool(self.damaged_files(manifest))
        if is_damaged:
            self.discard(manifest.ref)
        return is_damaged

    def clear_leftovers(self) -> None:
        """Remove unfinished files of dead processes; those of a dying process stay until the next time."""
        clean_leftovers(self.staging_root)

    def stays(self, present: Manifest, new: Manifest, *, replaces: bool, are_files_new: bool = False) -> bool:
        """Return whether an existing artifact keeps its place against a new one under its key.

        `are_files_new`: its files, if they are the same, have just been written again.

        Raises:
            NamedByDataset: It would be replaced, and a dataset needs it.
        """
        ref, is_valid = new.ref, not self.outdated_tables(present)
        if present.ref.content_digest == ref.content_digest:
            if not replaces or not is_valid:
                return is_valid
            has_same_keys = [ref.key for ref in present.inputs] == [ref.key for ref in new.inputs]
            is_as_described = present.computed_digest == ref.content_digest
            return has_same_keys and is_as_described and (are_files_new or not self.damaged_files(present))
        if is_valid and not replaces:
            _log.warning(
                "artifact %s@%s was computed a second time with other bytes (%s, kept is %s)",
                *(ref.stage, ref.key[:12], ref.content_digest[:12], present.ref.content_digest[:12]),
            )
            return True
        if (dataset := next(datasets_with(self, present.ref), None)) is not None:
            raise NamedByDataset(
                f"artifact {ref.stage}@{ref.key[:12]} was computed again with other bytes, and dataset {dataset.label} "
                "needs the old one, which stays; raise the version of the stage in its `Stage(...)` to have both"
            )
        return False

    def _spent(self) -> dict[str, float]:
        began = getattr(self._begun, "at_s", None)
        if began is None:
            return {}
        now = (time.perf_counter(), time.thread_time())
        return {name: round(now[i] - began[i], 4) for i, name in enumerate((SHARD_S, PROCESSOR_S))}


@cache
def _declared(table: str) -> str:
    """Return the digest of a table's columns, cached by name, because hashing all columns is slow."""
    return schema_digest(TABLES[table])
