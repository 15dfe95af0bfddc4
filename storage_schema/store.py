"""The artifact store: finds, reads and commits artifacts in a folder that many processes share.

Layout: `<root>/<stage>/<key[:2]>/<key>/` holds `<table>.parquet` files, attachments and `manifest.json`; `tmp/` holds
what is being written, `runs/` and `datasets/` what runs and people say about artifacts.  A folder appears under its key
in one rename after everything in it has reached the disk, so an artifact is whole or absent, whatever is killed.
"""

from __future__ import annotations

import json
import logging
import re
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from storage_schema.arrow import schema_digest
from storage_schema.artifact_writer import ArtifactFiles
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.durable import make_folder, replace_file, sync_folder, write_errors, write_file
from storage_schema.errors import CorruptArtifact, MissingArtifact, StorageError
from storage_schema.keys import content_digest, plain_json
from storage_schema.manifest import MANIFEST_NAME, ArtifactRef, Manifest, refuse_newer
from storage_schema.parquet_files import iter_table, read_table
from storage_schema.provenance import code_version, package_versions, source_digest
from storage_schema.staging import StagingFolder, clean_leftovers
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES
from storage_schema.version import SCHEMA_VERSION

__all__ = ["ArtifactWriter", "Store"]

_STAGE_NAME = re.compile(r"[a-z][a-z0-9_]*")
_RESERVED = {"tmp", "runs", "datasets"}
_STORE_FILE = "store.json"

_log = logging.getLogger(__name__)


class ArtifactWriter:
    """What `Store.writer` gives: append rows, attach files, note facts; `ref` is there once the block has ended.

    Args:
        files: The data files as they grow.
        facts: Small JSON facts that later planning reads; may be changed until the block ends.
        timings: Seconds by name, in no digest; may be changed until the block ends.
        sources: Licence and credit of new sources; those of the inputs are added by themselves.
    """

    def __init__(
        self,
        files: ArtifactFiles,
        facts: Mapping[str, Any],
        timings: Mapping[str, float],
        sources: Sequence[SourceCredit],
    ) -> None:
        self._files = files
        self.facts: dict[str, Any] = dict(facts)
        self.timings: dict[str, float] = dict(timings)
        self.sources: list[SourceCredit] = list(sources)
        self._ref: ArtifactRef | None = None

    def append(self, table: str, columns: Mapping[str, Any]) -> None:
        """Add rows to the artifact's part of a table, in the order given.

        Raises:
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            FullDisk: There is no room left.
        """
        self._files.append(table, columns)

    def attach(self, name: str, data: bytes) -> None:
        """Add a file of its own format: a report, a clip, a motion file."""
        self._files.attach(name, data)

    @property
    def ref(self) -> ArtifactRef:
        """The committed artifact.

        Raises:
            StorageError: The block has not ended yet.
        """
        if self._ref is None:
            raise StorageError("the artifact is not committed before its block has ended")
        return self._ref


class Store:
    """The artifacts under one folder.  Picklable: it is only the folder's path.

    Args:
        root: Folder of the store; made when something is first written.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).absolute()
        self._is_checked = False

    def __repr__(self) -> str:
        return f"Store({str(self.root)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Store) and self.root == other.root

    def __hash__(self) -> int:
        return hash(self.root)

    def __reduce__(self) -> tuple[type[Store], tuple[str]]:
        return Store, (str(self.root),)

    # Finding

    def folder(self, stage: str, key: str) -> Path:
        """Give the folder that holds, or would hold, the artifact of this key."""
        return self.root / stage / key[:2] / key

    def find(self, stage: str, key: str) -> Manifest | None:
        """Give the artifact's manifest when it is valid and its files are there with the right size, else None.

        An artifact whose tables have other columns than this program declares is not valid either.

        Raises:
            NewerSchema: The store was written by a newer program.
        """
        self._check_version()
        try:
            manifest = self._load(stage, key)
        except (MissingArtifact, CorruptArtifact):
            return None
        return manifest if self._is_whole(manifest) else None

    def manifest(self, ref: ArtifactRef) -> Manifest:
        """Give the manifest of an artifact.

        Raises:
            MissingArtifact: It is not in the store.
            CorruptArtifact: Its manifest cannot be read, or its content is not the one that `ref` names.
            NewerSchema: The store was written by a newer program.
        """
        self._check_version()
        manifest = self._load(ref.stage, ref.key)
        if manifest.ref != ref:
            raise CorruptArtifact(
                f"artifact {ref.stage}@{ref.key[:12]} holds the content {manifest.ref.content_digest[:12]}, "
                f"not {ref.content_digest[:12]}: it was rebuilt with other bytes"
            )
        return manifest

    def artifacts(self, stage: str | None = None) -> Iterator[Manifest]:
        """Give the manifests of all valid artifacts, of one stage or of all, in the order of stage and key."""
        for folder in self.folders(stage):
            manifest = self.find(folder.parent.parent.name, folder.name)
            if manifest is not None:
                yield manifest

    def folders(self, stage: str | None = None, key_prefix: str = "") -> list[Path]:
        """Give the folders that stand under a key, valid or not, in the order of stage and key."""
        found = self.root.glob(
            f"{stage or '*'}/{key_prefix[:2] or '*'}{'*' if len(key_prefix) == 1 else ''}/{key_prefix}*"
        )
        return sorted(path for path in found if path.parent.parent.name not in _RESERVED and path.is_dir())

    # Reading

    def read(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None, rows: slice | None = None
    ) -> TableData:
        """Read the artifact's part of a table, or some of its columns and rows, with the declared schema.

        Raises:
            MissingArtifact: The artifact, or this table of it, is not in the store.
            CorruptArtifact: A file is not what its manifest says.
            SchemaError: A column is unknown, or the file was written with other columns.
        """
        return read_table(self._table_path(ref, table), TABLES[table], columns=columns, rows=rows)

    def iter_batches(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None
    ) -> Iterator[TableData]:
        """Read the artifact's part of a table some 10,000 rows at a time; raises what `read` raises."""
        return iter_table(self._table_path(ref, table), TABLES[table], columns=columns)

    def attachment(self, ref: ArtifactRef, name: str) -> bytes:
        """Give the bytes of an attached file.

        Raises:
            MissingArtifact: The artifact, or this attachment of it, is not in the store.
            CorruptArtifact: The file is not there though the manifest names it.
        """
        return self.attachment_path(ref, name).read_bytes()

    def attachment_path(self, ref: ArtifactRef, name: str) -> Path:
        """Give the path of an attached file, for reading only; raises what `attachment` raises."""
        manifest = self.manifest(ref)
        if name not in manifest.attachments:
            there = ", ".join(manifest.attachments) or "none"
            raise MissingArtifact(f"artifact {ref.stage}@{ref.key[:12]} has no attachment '{name}'; it has: {there}")
        path = self.folder(ref.stage, ref.key) / name
        if not path.is_file():
            raise CorruptArtifact(f"{path} is missing though its manifest names it")
        return path

    # Writing

    def commit(
        self,
        *,
        stage: str,
        key: str,
        partition: str,
        name: str,
        version: int,
        parameters: Mapping[str, Any],
        seed: int,
        inputs: Sequence[ArtifactRef],
        files: Sequence[tuple[str, str]],
        tables: Mapping[str, Mapping[str, Any]],
        attachments: Mapping[str, bytes] | None = None,
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        timings: Mapping[str, float] | None = None,
    ) -> ArtifactRef:
        """Write an artifact under its key, whole or not at all.

        When a valid artifact is already there (another process was first) this one is discarded and that one is given.

        Args:
            stage: Name of the stage.
            key: Key of the artifact, from `artifact_key`.
            partition: What a person sees as one step.
            name: Name of the shard in its partition.
            version: Version of the stage.
            parameters: JSON values that decided the result.
            seed: Seed of the study.
            inputs: Artifacts that were read; their sources are added to this one's.
            files: Outside files that were read: (file name, sha256).
            tables: For each table its columns: name to list or array, rows first (see `encoding.encode`).
            attachments: Files of their own format, by file name.
            facts: Small JSON facts that later planning reads.
            sources: Licence and credit of new sources.
            timings: Seconds by name, in no digest.

        Raises:
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            MissingArtifact: An input is not in the store.
            FullDisk: There is no room left.
            NewerSchema: The store was written by a newer program.
        """
        with self.writer(
            stage=stage,
            key=key,
            partition=partition,
            name=name,
            version=version,
            parameters=parameters,
            seed=seed,
            inputs=inputs,
            files=files,
            facts=facts,
            sources=sources,
            timings=timings,
        ) as writer:
            for table, columns in tables.items():
                writer.append(table, columns)
            for file_name, data in (attachments or {}).items():
                writer.attach(file_name, data)
        return writer.ref

    @contextmanager
    def writer(
        self,
        *,
        stage: str,
        key: str,
        partition: str,
        name: str,
        version: int,
        parameters: Mapping[str, Any],
        seed: int,
        inputs: Sequence[ArtifactRef],
        files: Sequence[tuple[str, str]],
        facts: Mapping[str, Any] | None = None,
        sources: Sequence[SourceCredit] = (),
        timings: Mapping[str, float] | None = None,
    ) -> Iterator[ArtifactWriter]:
        """Write an artifact piece by piece: rows are streamed to the disk, and the block's end commits.

        When the block raises, nothing stays behind.  Arguments and errors are those of `commit`.
        """
        if not _STAGE_NAME.fullmatch(stage) or stage in _RESERVED:
            raise StorageError(f"'{stage}' cannot name a stage: lower-case letters, digits and _ are allowed")
        self._prepare()
        with write_errors(self.root):
            staging = StagingFolder(self.root / "tmp")
        try:
            with ArtifactFiles(staging.path, self.root) as data:
                writer = ArtifactWriter(data, facts or {}, timings or {}, sources)
                yield writer
                parts, attachments = data.finish()
            digests = {f"{table}.parquet": part.sha256 for table, part in parts.items()}
            digests |= {file_name: entry.sha256 for file_name, entry in attachments.items()}
            inherited = [self.manifest(ref).sources for ref in inputs]
            manifest = Manifest(
                ref=ArtifactRef(stage, key, content_digest(digests)),
                partition=partition,
                name=name,
                version=version,
                parameters=plain_json(dict(parameters)),
                seed=seed,
                inputs=tuple(inputs),
                files=tuple((file_name, digest) for file_name, digest in files),
                tables=parts,
                attachments=attachments,
                facts=plain_json(writer.facts),
                sources=merge_credits(writer.sources, *inherited),
                schema_version=SCHEMA_VERSION,
                code_version=code_version(),
                source_digest=source_digest(),
                package_versions=package_versions(),
                timings=plain_json(writer.timings),
                created_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            )
            with write_errors(self.root):
                write_file(staging.path / MANIFEST_NAME, manifest.to_json().encode())
                sync_folder(staging.path)
                writer._ref = self._publish(staging.path, manifest.ref)
        finally:
            staging.close()

    def discard(self, ref: ArtifactRef) -> None:
        """Remove an artifact, so that its key is missing; nothing happens when it is not there."""
        with write_errors(self.root):
            self._move_away(self.folder(ref.stage, ref.key))

    # Helpers

    def _load(self, stage: str, key: str) -> Manifest:
        path = self.folder(stage, key) / MANIFEST_NAME
        try:
            text = path.read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):
            raise MissingArtifact(f"artifact {stage}@{key[:12]} is not in the store {self.root}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise CorruptArtifact(f"{path} cannot be read: {error}") from error
        manifest = Manifest.from_json(text, where=str(path))
        if (manifest.ref.stage, manifest.ref.key) != (stage, key):
            raise CorruptArtifact(f"{path} speaks of another artifact: {manifest.ref.stage}@{manifest.ref.key[:12]}")
        return manifest

    def _is_whole(self, manifest: Manifest) -> bool:
        """Tell whether every file is there with the right size, and every table has the declared columns."""
        folder = self.folder(manifest.ref.stage, manifest.ref.key)
        for table, part in manifest.tables.items():
            if table not in TABLES or part.schema != schema_digest(TABLES[table]):
                return False
        try:
            return all((folder / name).stat().st_size == entry.bytes for name, entry in manifest.data_files.items())
        except OSError:
            return False

    def _table_path(self, ref: ArtifactRef, table: str) -> Path:
        manifest = self.manifest(ref)
        if table not in manifest.tables or table not in TABLES:
            there = ", ".join(manifest.tables) or "none"
            raise MissingArtifact(f"artifact {ref.stage}@{ref.key[:12]} holds no table '{table}'; it holds: {there}")
        return self.folder(ref.stage, ref.key) / f"{table}.parquet"

    def _publish(self, staged: Path, ref: ArtifactRef) -> ArtifactRef:
        """Give the staged folder its name in one rename; gives the artifact that stands there in the end."""
        target = self.folder(ref.stage, ref.key)
        make_folder(target.parent)
        while True:
            found = self.find(ref.stage, ref.key)
            if found is not None:
                if found.ref != ref:
                    _log.warning(
                        "artifact %s@%s was computed a second time with other bytes (%s, kept is %s)",
                        *(ref.stage, ref.key[:12], ref.content_digest[:12], found.ref.content_digest[:12]),
                    )
                return found.ref
            self._move_away(target)
            try:
                staged.rename(target)
            except OSError:
                if not target.exists():
                    raise
                # Another process was first: look at what it wrote.
                continue
            sync_folder(target.parent)
            return ref

    def _move_away(self, target: Path) -> None:
        """Remove a folder under a key; it vanishes in one rename, so nobody sees it half removed."""
        if not target.exists():
            return
        staging = StagingFolder(self.root / "tmp")
        try:
            target.rename(staging.path / uuid.uuid4().hex)
            sync_folder(target.parent)
        except FileNotFoundError:
            _log.debug("%s was already moved away", target)
        finally:
            staging.close()

    def _prepare(self) -> None:
        """Make the store's folder when it is not there, and clear away what dead processes left; once per object."""
        if self._is_checked and (self.root / _STORE_FILE).is_file():
            return
        with write_errors(self.root):
            make_folder(self.root)
            if not (self.root / _STORE_FILE).is_file():
                replace_file(self.root / _STORE_FILE, json.dumps({"schema_version": SCHEMA_VERSION}).encode() + b"\n")
        self._check_version()
        clean_leftovers(self.root / "tmp")

    def _check_version(self) -> None:
        """Raise NewerSchema when the store was made by a newer program; looked up once per object."""
        if self._is_checked:
            return
        path = self.root / _STORE_FILE
        try:
            found = json.loads(path.read_bytes())["schema_version"]
        except FileNotFoundError:
            return
        except (ValueError, KeyError, TypeError) as error:
            raise StorageError(f"{self.root} is not a store: {path.name} cannot be read ({error})") from error
        refuse_newer(found, f"the store {self.root}")
        self._is_checked = True
