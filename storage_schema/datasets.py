"""Datasets: named, immutable lists of artifacts, `datasets/<name>@<version>/`."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from storage_schema.durable import make_folder, sync_folder, write_errors, write_file
from storage_schema.errors import BadName, CorruptArtifact, DatasetExists, StorageError, UnknownReference
from storage_schema.keys import canonical_json
from storage_schema.manifest import ArtifactRef, refuse_newer
from storage_schema.staging import StagingFolder
from storage_schema.store import Store
from storage_schema.version import SCHEMA_VERSION

__all__ = ["Dataset", "add_dataset", "create_dataset", "dataset_from_json", "list_datasets", "open_dataset"]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_FILE = "dataset.json"


@dataclass(frozen=True)
class Dataset:
    """A named, immutable list of artifacts.

    Args:
        name: Name of the dataset.
        version: Its version; datasets made without one are numbered from 1.
        refs: The artifacts, in order.
        digest: sha256 over the artifacts' stages, keys and content digests.
        note: What the maker says about it.
        created_at: When, in UTC.
        path: Its folder; attached files such as the dataset card lie there.
    """

    name: str
    version: str
    refs: tuple[ArtifactRef, ...]
    digest: str
    note: str
    created_at: str
    path: Path

    @property
    def label(self) -> str:
        """Return `name@version`."""
        return f"{self.name}@{self.version}"


def create_dataset(
    store: Store,
    name: str,
    refs: Sequence[ArtifactRef],
    *,
    version: str | None = None,
    note: str = "",
    attachments: Mapping[str, bytes] | None = None,
) -> Dataset:
    """Return a list of artifacts a name and a version that never change.

    Args:
        store: Store that holds the artifacts.
        name: Name of the dataset.
        refs: The artifacts.
        version: Version; the next free number when None.
        note: What to say about it.
        attachments: Files to lie beside the list, such as a dataset card.

    Raises:
        DatasetExists: This name and version are taken.
        MissingArtifact: An artifact is not in the store.
        StorageError: The list is empty.
        BadName: A name is not allowed.
        FullDisk: There is no room left.
    """
    _check_names(name, version or "1", *(attachments or {}))
    if not refs:
        raise StorageError(f"dataset '{name}': a dataset needs at least one artifact")
    for ref in refs:
        store.manifest(ref)
    store.prepare()
    while True:
        chosen = version or _next_version(store, name)
        path = store.root / "datasets" / f"{name}@{chosen}"
        digest = hashlib.sha256(canonical_json([asdict(ref) for ref in refs])).hexdigest()
        created_at = datetime.now(UTC).isoformat(timespec="milliseconds")
        dataset = Dataset(name, chosen, tuple(refs), digest, note, created_at, path)
        if add_dataset(store, dataset, attachments or {}):
            return dataset
        if version is not None:
            raise DatasetExists(f"dataset {dataset.label} was already made and never changes; name another version")


def list_datasets(store: Store) -> list[Dataset]:
    """Return all datasets of a store, by name and version."""
    return sorted(
        (dataset_from_json((path / _FILE).read_bytes, path) for path in (store.root / "datasets").glob("*@*")),
        key=_order,
    )


def open_dataset(store: Store, label: str) -> Dataset:
    """Return the dataset `name@version`, or the newest version of `name`.

    Raises:
        UnknownReference: There is no such dataset; says which there are.
        CorruptArtifact: Its list cannot be read.
    """
    named = [dataset for dataset in list_datasets(store) if label in (dataset.label, dataset.name)]
    if not named:
        there = ", ".join(dataset.label for dataset in list_datasets(store)) or "none"
        raise UnknownReference(f"there is no dataset '{label}' in the store {store.root}; there are: {there}")
    return named[-1]


def add_dataset(store: Store, dataset: Dataset, attachments: Mapping[str, bytes]) -> bool:
    """Write the dataset's folder and give it its name in one rename; false when the name is taken.

    Raises:
        BadName: A name is not allowed.
        FullDisk: There is no room left.
    """
    _check_names(dataset.name, dataset.version, *attachments)
    values = {**asdict(dataset), "schema_version": SCHEMA_VERSION}
    del values["path"]
    with write_errors(store.root), closing(StagingFolder(store.staging_root)) as staging:
        for name, data in attachments.items():
            write_file(staging.path / name, data)
        write_file(staging.path / _FILE, (json.dumps(values, indent=1, ensure_ascii=False) + "\n").encode())
        sync_folder(staging.path)
        make_folder(dataset.path.parent)
        try:
            staging.path.rename(dataset.path)
        except OSError:
            if dataset.path.is_dir():
                return False
            raise
        sync_folder(dataset.path.parent)
    return True


def dataset_from_json(read: Callable[[], bytes], path: Path, *, less: Collection[str] = ()) -> Dataset:
    """Return the dataset of a list that `read` gives, `less` keys that are no part of it, as one in a folder.

    Raises:
        CorruptArtifact: It cannot be read.
        NewerSchema: It was written by a newer program.
    """
    try:
        values: dict[str, Any] = {name: value for name, value in json.loads(read()).items() if name not in less}
        refuse_newer(values.pop("schema_version"), str(path))
        return Dataset(**{**values, "refs": tuple(ArtifactRef(**ref) for ref in values["refs"]), "path": path})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptArtifact(f"dataset {path.name} cannot be read: {error!r}") from error


def _next_version(store: Store, name: str) -> str:
    numbers = [int(dataset.version) for dataset in list_datasets(store) if dataset.name == name and _is_number(dataset)]
    return str(max(numbers, default=0) + 1)


def _order(dataset: Dataset) -> tuple[str, bool, int, str]:
    """Numbered versions by number, after those with names."""
    return (dataset.name, _is_number(dataset), int(dataset.version) if _is_number(dataset) else 0, dataset.version)


def _is_number(dataset: Dataset) -> bool:
    return dataset.version.isdecimal()


def _check_names(*names: str) -> None:
    for name in names:
        if not _NAME.fullmatch(name) or name == _FILE:
            raise BadName(f"'{name}' cannot name a dataset, its version or its files: use letters, digits, . _ -")
