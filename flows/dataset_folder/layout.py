"""The manifest of a dataset's folder, which is written last: its files, and the artifacts that they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.dataset_folder.contents import Ranges
from storage_schema import CorruptArtifact
from storage_schema.keys import json_file
from storage_schema.manifest import refuse_newer
from storage_schema.version import SCHEMA_VERSION
from tasks.rows.sides import Side

MANIFEST, RECORD, SPLITS_FILE = "manifest.json", "record", "splits.json"

PartKey = tuple[str, str, Ranges]
"""Origin of a row group: stage and content digest of the artifact, and its rows; no rows for contacts of a take."""


@dataclass(frozen=True)
class FolderFile:
    """A file of a folder; for a data file also its number of rows and the origin of each row group."""

    bytes: int
    sha256: str
    rows: int = 0
    parts: tuple[PartKey, ...] = ()


@dataclass(frozen=True)
class FolderManifest:
    """The contents of a folder: files by name, and the names of withheld sources."""

    name: str
    version: str
    digest: str
    withheld: tuple[str, ...]
    files: Mapping[str, FolderFile]

    @property
    def label(self) -> str:
        """Return `name@version`."""
        return f"{self.name}@{self.version}"

    def to_json(self) -> bytes:
        """Return the bytes of its file."""
        return json_file({"schema_version": SCHEMA_VERSION, **asdict(self)})


def read_manifest(folder: Path) -> FolderManifest | None:
    """Return the manifest of a dataset's folder; None without one.

    Raises:
        CorruptArtifact: It cannot be read, or names files elsewhere.
        NewerSchema: A newer program wrote it.
    """
    path = folder / MANIFEST
    try:
        values: dict[str, Any] = json.loads(path.read_bytes())
        refuse_newer(values.pop("schema_version"), str(path))
        files = {name: FolderFile(**{**file, "parts": _parts(file)}) for name, file in values["files"].items()}
        if any(Path(name).is_absolute() or ".." in Path(name).parts for name in files):
            raise ValueError("it names files that are not in its folder")
        return FolderManifest(**{**values, "withheld": tuple(values["withheld"]), "files": files})
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptArtifact(f"{path} cannot be read: {error!r}") from error


def read_sides(folder: Path) -> dict[str, Side]:
    """Return the side of each take of a folder."""
    return {name: Side(**side) for name, side in json.loads((folder / SPLITS_FILE).read_bytes())["takes"].items()}


def _parts(file: Mapping[str, Any]) -> tuple[PartKey, ...]:
    return tuple((stage, digest, tuple((a, b) for a, b in rows)) for stage, digest, rows in file["parts"])
