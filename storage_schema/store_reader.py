"""Finding and reading: what a program may do with a store that it must not change.

A store in S3-compatible storage is read through a folder of this machine, its mirror: artifacts come when asked for.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Self

from storage_schema.arrow import schema_digest
from storage_schema.errors import CorruptArtifact, MissingArtifact, NotAStore, StorageError
from storage_schema.keys import file_sha256
from storage_schema.manifest import MANIFEST_NAME, RESERVED_NAMES, ArtifactRef, FileEntry, Manifest, refuse_newer
from storage_schema.parquet_files import iter_table, read_table
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES

if TYPE_CHECKING:
    from storage_schema.mirror import Mirror

STORE_FILE = "store.json"
_S3 = re.compile(r"s3:/*(.*)")
"""An address in S3-compatible storage, also as a path says it, with one stroke."""


class StoreReader:
    """Finds and reads the artifacts under `root`, a folder or `s3://BUCKET/PREFIX`; as text it is that path or URL."""

    def __init__(self, root: str | Path) -> None:
        self.mirror: Mirror | None = None
        if there := _S3.fullmatch(str(root)):
            from storage_schema.mirror import open_mirror  # here: a client that stores in folders need not load

            self.mirror = open_mirror(f"s3://{there[1]}")
        self.root = self.mirror.root if self.mirror is not None else Path(root).absolute()
        self._is_checked = False
        # Texts, where a plan asks for 100,000 artifacts: paths take longer to make than files to open.
        self._prefix, self._version_file = f"{self.root}/", f"{self.root}/{STORE_FILE}"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __str__(self) -> str:
        return self.mirror.url if self.mirror is not None else str(self.root)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.root == other.root

    def __hash__(self) -> int:
        return hash(self.root)

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (str(self),)

    def refresh(self) -> None:
        """Look at what the store holds now, where it does not lie here; RemoteError where it does not answer."""
        if self.mirror is not None:
            self.mirror.refresh()

    @property
    def staging_root(self) -> Path:
        """Folder that holds what is being written."""
        return self.root / "tmp"

    def folder(self, stage: str, key: str) -> Path:
        """Return the folder that holds, or would hold, the artifact of this key."""
        return self.root / stage / key[:2] / key

    def find(self, stage: str, key: str) -> Manifest | None:
        """Return the artifact's manifest when it is valid and its files are there with the right size, else None.

        An artifact whose tables have other columns than this program declares is not valid either.  NewerSchema where
        the store was written by a newer program.
        """
        self.check_version()
        if self.mirror is not None and not self.mirror.is_current:
            self.mirror.bring(stage, key)
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
        if self.mirror is not None:
            self.mirror.bring(ref.stage, ref.key, known=ref)
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
        """Return the folders that stand under a key, valid or not, in the order of stage and key."""
        found = self.root.glob(
            f"{stage or '*'}/{key_prefix[:2] or '*'}{'*' if len(key_prefix) == 1 else ''}/{key_prefix}*"
        )
        return sorted(path for path in found if path.parent.parent.name not in RESERVED_NAMES and path.is_dir())

    def read(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None, rows: slice | None = None
    ) -> TableData:
        """Read the artifact's part of a table, or some of its columns and rows, with the declared schema.

        Raises:
            MissingArtifact: The artifact, or this table of it, is not in the store.
            CorruptArtifact: A file is not what its manifest says.
            SchemaError: A column is unknown, or the file was written with other columns.
        """
        found = read_table(self.table_path(ref, table), TABLES[table], columns=columns, rows=rows)
        self.manifest(ref)  # another may have taken its place before the file was opened
        return found

    def iter_batches(
        self, ref: ArtifactRef, table: str, *, columns: Sequence[str] | None = None
    ) -> Iterator[TableData]:
        """Read the artifact's part of a table some 10,000 rows at a time; raises what `read` raises."""
        yield from iter_table(self.table_path(ref, table), TABLES[table], columns=columns)
        self.manifest(ref)  # as in `read`

    def attachment(self, ref: ArtifactRef, name: str) -> bytes:
        """Return the bytes of an attached file; MissingArtifact without it, CorruptArtifact where the file is gone."""
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
        """Return the manifest that stands under a key, whether or not its files are there.

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

    def has_files(self, manifest: Manifest) -> bool:
        """Tell whether every file of an artifact is there with the right size."""
        if self.mirror is not None:
            return True  # its manifest came last
        folder = f"{self._prefix}{manifest.ref.stage}/{manifest.ref.key[:2]}/{manifest.ref.key}"
        sizes = {f"{name}.parquet": part.bytes for name, part in manifest.tables.items()}
        sizes |= {name: entry.bytes for name, entry in manifest.attachments.items()}
        try:
            return all(os.stat(f"{folder}/{name}").st_size == size for name, size in sizes.items())  # noqa: PTH116
        except OSError:
            return False

    def outdated_tables(self, manifest: Manifest) -> list[str]:
        """Return the tables of an artifact that were written with other columns than this program declares."""
        return [
            table for table, part in manifest.tables.items() if table not in TABLES or part.schema != _declared(table)
        ]

    def table_path(self, ref: ArtifactRef, table: str) -> Path:
        """Return the path of the artifact's part of a table, for reading only; MissingArtifact where it has none."""
        manifest = self.manifest(ref)
        if table not in manifest.tables or table not in TABLES:
            there = ", ".join(manifest.tables) or "none"
            raise MissingArtifact(f"artifact {ref.stage}@{ref.key[:12]} holds no table '{table}'; it holds: {there}")
        name = f"{table}.parquet"
        return self.data_file(ref, name, manifest.data_files[name])

    def data_file(self, ref: ArtifactRef, name: str, entry: FileEntry) -> Path:
        """Return the path of a data file of an artifact, which comes now where the store does not lie here.

        CorruptArtifact where it is gone or damaged, or its name would lead out of the artifact's folder.
        """
        if "/" in name or name.startswith("."):
            raise CorruptArtifact(
                f"artifact {ref.stage}@{ref.key[:12]} names a file '{name}' that is not in its folder"
            )
        path = self.folder(ref.stage, ref.key) / name
        if self.mirror is not None:
            self.mirror.bring_part(path, entry)
        return path

    def file_sha256(self, ref: ArtifactRef, name: str, entry: FileEntry) -> str:
        """Return the sha256 of the bytes of a data file as they lie in the store; OSError where they cannot be read."""
        if self.mirror is not None:
            return self.mirror.part_sha256(entry.sha256)
        return file_sha256(self.folder(ref.stage, ref.key) / name)

    def damaged_files(self, manifest: Manifest) -> list[str]:
        """Return the files that are gone or whose bytes are others, twice read; not those that cannot be read."""

        def is_damaged(name: str, entry: FileEntry) -> bool:
            try:
                return self.file_sha256(manifest.ref, name, entry) != entry.sha256
            except FileNotFoundError:
                return True
            except (OSError, StorageError):
                return False

        return [n for n, entry in manifest.data_files.items() if is_damaged(n, entry) and is_damaged(n, entry)]

    def check_version(self) -> None:
        """Refuse a store of a newer program (NewerSchema) and what is none (NotAStore); looked up once per object."""
        if self._is_checked:
            return
        try:
            with open(self._version_file, "rb") as file:  # noqa: PTH123
                found = json.load(file)["schema_version"]
        except FileNotFoundError:
            return
        except NotADirectoryError:
            raise NotAStore(f"{self.root} is not a store: it is a file, not a folder") from None
        except (ValueError, KeyError, TypeError) as error:
            raise NotAStore(f"{self.root} is not a store: {STORE_FILE} cannot be read ({error})") from error
        refuse_newer(found, f"the store {self}")
        self._is_checked = True


@cache
def _declared(table: str) -> str:
    """Return the digest of a table's columns; by name, as hashing all columns takes longer than anything else of it."""
    return schema_digest(TABLES[table])
