"""Writes an artifact: tables row by row, attachments, facts. It appears only when it is complete."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from storage_schema.columns import Table
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.durable import write_errors, write_file
from storage_schema.errors import StorageError
from storage_schema.keys import content_digest, plain_json
from storage_schema.manifest import MANIFEST_NAME, ArtifactRef, FileEntry, Manifest
from storage_schema.parquet_files import TableWriter
from storage_schema.provenance import code_version, package_versions, source_digest
from storage_schema.tables import TABLES
from storage_schema.version import SCHEMA_VERSION


class ArtifactFields(TypedDict):
    """Description of an artifact, stated when it is written."""

    stage: str
    """Name of the stage."""
    key: str
    """Key of the artifact, from `artifact_key`."""
    partition: str
    """The step that people see: a take, a seed, a split."""
    name: str
    """Name of the shard in its partition."""
    version: int
    """Version of the stage."""
    parameters: Mapping[str, Any]
    """JSON values that determine the result."""
    seed: int
    """Seed of the study."""
    inputs: Sequence[ArtifactRef]
    """Artifacts that were read."""
    files: Sequence[tuple[str, str]]
    """Outside files that were read: (file name, sha256)."""
    reads: NotRequired[Mapping[str, Sequence[int]]]
    """Indices into `inputs` that enter the key, by their role in the shard; `verify` computes the key again."""
    after: NotRequired[Sequence[str]]
    """Keys of other shards that enter the key."""
    replaces: NotRequired[bool]
    """Whether it replaces an existing artifact whose content differs or is damaged."""


class ArtifactWriter:
    """Writer of an artifact (`Store.writer`): append rows, attach files, set facts; `ref` is set at the block's end.

    Args:
        folder: Empty folder for the files.
        where: Name of the place in messages about a full disk.
        facts: Small JSON facts for later planning; may be changed until the block ends.
        sources: Licence and credit of new sources, without those of the inputs.

    `timings` are seconds by name and enter no digest; they may be set until the block ends.
    """

    def __init__(self, folder: Path, *, where: Path, facts: Mapping[str, Any], sources: Sequence[SourceCredit]) -> None:
        self.facts: dict[str, Any] = dict(facts)
        self.timings: dict[str, float] = {}
        self.sources: list[SourceCredit] = list(sources)
        self.ref: ArtifactRef
        self._folder = folder
        self._where = where
        self._tables: dict[str, TableWriter] = {}
        self._attachments: dict[str, FileEntry] = {}

    def append(self, table: str, columns: Mapping[str, Any]) -> None:
        """Add rows to the artifact's part of a table, in the order given; no rows make an empty part.

        Raises:
            StorageError: The table is unknown.
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            FullDisk: There is no room left.
        """
        with write_errors(self._where):
            if table not in self._tables:
                self._tables[table] = TableWriter(self._folder / f"{table}.parquet", _known(table))
            self._tables[table].append(columns)

    def attach(self, name: str, data: bytes) -> None:
        """Add a file of its own format: a report, a clip, a motion file.

        Raises:
            StorageError: The name is no plain file name, or is taken.
            FullDisk: There is no room left.
        """
        if (
            not name
            or Path(name).name != name
            or name.startswith(".")
            or name == MANIFEST_NAME
            or not name.isprintable()
        ):
            raise StorageError(f"'{name}' cannot name an attachment: a plain file name is needed, not {MANIFEST_NAME}")
        if name in self._attachments or name.removesuffix(".parquet") in TABLES:
            raise StorageError(f"'{name}' is already the name of a file of this artifact")
        with write_errors(self._where):
            file = write_file(self._folder / name, data)
        self._attachments[name] = FileEntry(file.num_bytes, file.sha256)

    def finish(self, spent: Mapping[str, float], described: ArtifactFields) -> Manifest:
        """Sync every file to the disk, and return the manifest, with `spent` timings. Called by the store."""
        with write_errors(self._where):
            tables = {name: self._tables[name].finish() for name in sorted(self._tables)}
        attachments = dict(sorted(self._attachments.items()))
        facts: dict[str, Any] = plain_json(self.facts, "facts")
        digests = {f"{table}.parquet": part.sha256 for table, part in tables.items()}
        digests |= {file_name: entry.sha256 for file_name, entry in attachments.items()}
        place = {"partition": described["partition"], "name": described["name"]}
        digest = content_digest(**place, facts=facts, files=digests)
        reads = described.get("reads")
        return Manifest(
            ref=ArtifactRef(described["stage"], described["key"], digest),
            **place,
            version=described["version"],
            parameters=plain_json(dict(described["parameters"]), "parameters"),
            seed=described["seed"],
            inputs=tuple(described["inputs"]),
            files=tuple((file_name, sha256) for file_name, sha256 in described["files"]),
            tables=tables,
            attachments=attachments,
            facts=facts,
            sources=merge_credits(self.sources),
            schema_version=SCHEMA_VERSION,
            code_version=code_version(),
            source_digest=source_digest(),
            package_versions=package_versions(),
            timings=plain_json({**self.timings, **spent}, "timings"),
            created_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            reads=None if reads is None else {what: [*ats] for what, ats in reads.items()},
            after=tuple(described.get("after", ())),
        )

    def close(self) -> None:
        """Release the files, finished or not. Called by the store."""
        for table in self._tables.values():
            table.abandon()


def _known(table: str) -> Table:
    if table not in TABLES:
        raise StorageError(f"unknown table '{table}'; known tables: {', '.join(TABLES)}")
    return TABLES[table]
