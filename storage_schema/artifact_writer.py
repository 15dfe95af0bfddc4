"""An artifact while it is written: tables row by row, attachments, facts; whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from storage_schema.columns import Table
from storage_schema.durable import write_errors, write_file
from storage_schema.errors import StorageError
from storage_schema.manifest import MANIFEST_NAME, FileEntry, TableFile
from storage_schema.parquet_files import TableWriter
from storage_schema.tables import TABLES

__all__ = ["ArtifactFiles"]


class ArtifactFiles:
    """The data files of an artifact, growing in a folder.

    Args:
        folder: Empty folder that the files grow in.
        where: What a message calls the place when the disk is full.
    """

    def __init__(self, folder: Path, where: Path) -> None:
        self._folder = folder
        self._where = where
        self._writers: dict[str, TableWriter] = {}
        self._attachments: dict[str, FileEntry] = {}

    def append(self, table: str, columns: Mapping[str, Any]) -> None:
        """Add rows to the artifact's part of a table; appending no rows makes an empty part.

        Raises:
            StorageError: The table is unknown.
            SchemaError: A column is missing, unknown, of another length, shape or kind.
            FullDisk: There is no room left.
        """
        with write_errors(self._where):
            if table not in self._writers:
                self._writers[table] = TableWriter(self._folder / f"{table}.parquet", _known(table))
            self._writers[table].append(columns)

    def attach(self, name: str, data: bytes) -> None:
        """Add a file of its own format: a report, a clip, a motion file.

        Raises:
            StorageError: The name is no plain file name, or is taken.
            FullDisk: There is no room left.
        """
        if Path(name).name != name or name.startswith(".") or name == MANIFEST_NAME or not name.isprintable():
            raise StorageError(f"'{name}' cannot name an attachment: a plain file name is needed, not {MANIFEST_NAME}")
        if name in self._attachments or name.removesuffix(".parquet") in TABLES:
            raise StorageError(f"'{name}' is already the name of a file of this artifact")
        with write_errors(self._where):
            file = write_file(self._folder / name, data)
        self._attachments[name] = FileEntry(file.num_bytes, file.sha256)

    def finish(self) -> tuple[dict[str, TableFile], dict[str, FileEntry]]:
        """Bring every file to the disk; gives the parts of tables and the attachments, by name."""
        with write_errors(self._where):
            tables = {name: self._writers[name].finish() for name in sorted(self._writers)}
        return tables, dict(sorted(self._attachments.items()))

    def __enter__(self) -> ArtifactFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for writer in self._writers.values():
            writer.abandon()


def _known(table: str) -> Table:
    if table not in TABLES:
        raise StorageError(f"unknown table '{table}'; known tables: {', '.join(TABLES)}")
    return TABLES[table]
