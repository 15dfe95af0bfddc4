"""Datasets: named, immutable lists of artifacts, `datasets/<name>@<version>/`."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from storage_schema.ancestry import source_credits
from storage_schema.credits import SourceCredit
from storage_schema.durable import make_folder, sync_folder, write_errors, write_file
from storage_schema.errors import (
    BadName,
    CorruptArtifact,
    DatasetExists,
    MissingArtifact,
    OlderSchema,
    StorageError,
    UnknownReference,
)
from storage_schema.keys import canonical_json
from storage_schema.manifest import ArtifactRef, Manifest, refuse_newer, refuse_older
from storage_schema.staging import StagingFolder
from storage_schema.store import Store
from storage_schema.version import SCHEMA_VERSION

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
DATASET_FILE = "dataset.json"

Place = tuple[str, str, str]
"""Stage, key and content of an artifact."""
Needed = Mapping[Place, Manifest | None]


@dataclass(frozen=True)
class Dataset:
    """A named, immutable list of artifacts.

    Args:
        name: Name of the dataset.
        version: Its version; datasets made without one are numbered from 1.
        refs: The artifacts, in order.
        sources: Licence and credit of every source, as they stood when it was made: they never change either.
        digest: sha256 over the artifacts' stages, keys and content digests, and the sources.
        note: What the maker says about it.
        created_at: When, in UTC.
        path: Its folder; attached files such as the dataset card lie there.
    """

    name: str
    version: str
    refs: tuple[ArtifactRef, ...]
    sources: tuple[SourceCredit, ...]
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
        MissingArtifact: An artifact, or one that it came from, is not in the store.
        StorageError: The list is empty.
        BadName: A name is not allowed.
        FullDisk: There is no room left.
    """
    _check_names(name, version or "1", *(attachments or {}))
    if not refs:
        raise StorageError(f"dataset '{name}': a dataset needs at least one artifact")
    sources = source_credits(store, *refs)
    digest = digest_of(refs, sources)
    store.prepare()
    while True:
        chosen = version or next_version(store, name)
        path = store.root / "datasets" / f"{name}@{chosen}"
        created_at = datetime.now(UTC).isoformat(timespec="milliseconds")
        dataset = Dataset(name, chosen, tuple(refs), sources, digest, note, created_at, path)
        if add_dataset(store, dataset, attachments or {}):
            return dataset
        if version is not None:
            raise DatasetExists(f"dataset {dataset.label} was already made and never changes; name another version")


def list_datasets(store: Store, name: str = "*") -> list[Dataset]:
    """Return the datasets of a store, or the versions of one, but those of an older schema (`dataset_labels` has all).

    Raises:
        CorruptArtifact: The list of one cannot be read.
    """
    found = []
    for path in _folders(store, name):
        with suppress(OlderSchema):
            found.append(_read(path))
    return found


def named_places(store: Store) -> set[tuple[str, str]]:
    """Return stage and key of all that the datasets of a store name, also those of an older schema.

    Raises:
        CorruptArtifact: The list of one cannot be read: what it names is not known.
    """
    found = set[tuple[str, str]]()
    for path in _folders(store):
        try:
            found.update(ref.place for ref in _read(path).refs)
        except OlderSchema:  # whose form is not known, but for what all have
            try:
                found.update(
                    (ref["stage"], ref["key"]) for ref in json.loads((path / DATASET_FILE).read_bytes())["refs"]
                )
            except (KeyError, TypeError) as error:
                raise CorruptArtifact(f"dataset {path.name} cannot be read: {error!r}") from error
    return found


def dataset_labels(store: Store) -> list[str]:
    """Return `name@version` of all datasets of a store, also of those that cannot be read."""
    return [path.name for path in _folders(store)]


def newest_version(store: Store, name: str) -> Dataset | None:
    """Return the numbered version of a dataset with the greatest number; None without one, or of an older schema.

    Raises:
        CorruptArtifact: Its list cannot be read.
    """
    numbered = [path for path in _folders(store, name) if _version(path).isdecimal()]
    with suppress(OlderSchema):
        return _read(numbered[-1]) if numbered else None
    return None


def open_dataset(store: Store, label: str) -> Dataset:
    """Return the dataset `name@version`, or the newest version of `name`.

    Raises:
        UnknownReference: There is no such dataset; says which there are.
        CorruptArtifact: Its list cannot be read.
    """
    named = [path for path in _folders(store) if label in (path.name, path.name.rpartition("@")[0])]
    if not named:
        there = ", ".join(path.name for path in _folders(store)) or "none"
        raise UnknownReference(f"there is no dataset '{label}' in the store {store}; there are: {there}")
    return _read(named[-1])


def datasets_with(store: Store, ref: ArtifactRef) -> Iterator[Dataset]:
    """Return the datasets that name this content of an artifact or were computed from it.

    Those of an older schema need other artifacts.

    Raises:
        CorruptArtifact: The list of a dataset cannot be read: what it needs is not known.
    """
    for path in _folders(store):
        with suppress(OlderSchema):
            dataset, needed = _read_with_needs(store, path)
            if _place(ref) in needed:
                yield dataset


def needed_by(store: Store, dataset: Dataset) -> Needed:
    """Return what a dataset names and all that it was computed from by stage, key, content; None for what is lost."""
    waiting, found = list(dataset.refs), dict[Place, Manifest | None]()
    while waiting:
        ref = waiting.pop()
        if _place(ref) not in found:
            found[_place(ref)] = None
            with suppress(MissingArtifact, CorruptArtifact):
                found[_place(ref)] = manifest = store.manifest(ref)
                waiting += manifest.inputs
    return found


@lru_cache(maxsize=64)
def _read_with_needs(store: Store, path: Path) -> tuple[Dataset, frozenset[Place]]:
    """Return a dataset and the places of what it needs, which never change."""
    dataset = _read(path)
    return dataset, frozenset(needed_by(store, dataset))


def _place(ref: ArtifactRef) -> Place:
    return ref.stage, ref.key, ref.content_digest


def digest_of(refs: Sequence[ArtifactRef], sources: Sequence[SourceCredit]) -> str:
    """Return the sha256 over the stages, keys and content digests of artifacts, and the licences and credits."""
    return hashlib.sha256(canonical_json([[asdict(one) for one in part] for part in (refs, sources)])).hexdigest()


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
        write_file(staging.path / DATASET_FILE, (json.dumps(values, indent=1, ensure_ascii=False) + "\n").encode())
        sync_folder(staging.path)
        make_folder(dataset.path.parent)
        if store.mirror is not None and not store.mirror.add_dataset(staging.path, dataset.label):
            return False
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
        OlderSchema: It was written under an older schema, and has another form.
    """
    version = SCHEMA_VERSION
    try:
        values: dict[str, Any] = {name: value for name, value in json.loads(read()).items() if name not in less}
        version = int(values.pop("schema_version"))
        refuse_newer(version, str(path))
        lists = {
            "refs": tuple(ArtifactRef(**ref) for ref in values["refs"]),
            "sources": tuple(SourceCredit(**source) for source in values["sources"]),
        }
        return Dataset(**{**values, **lists, "path": path})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        refuse_older(version, f"dataset {path.name}", "")
        raise CorruptArtifact(f"dataset {path.name} cannot be read: {error!r}") from error


def _read(path: Path) -> Dataset:
    return dataset_from_json((path / DATASET_FILE).read_bytes, path)


def next_version(store: Store, name: str) -> str:
    """Return the version that follows the numbered ones of a dataset."""
    numbers = [int(_version(path)) for path in _folders(store, name) if _version(path).isdecimal()]
    return str(max(numbers, default=0) + 1)


def _folders(store: Store, name: str = "*") -> list[Path]:
    """Return the folders of datasets: by name, versions that are numbers by number, after those with names.

    Their lists, of 100,000 artifacts perhaps, are not read.
    """
    return sorted((store.root / "datasets").glob(f"{name}@*"), key=_order)


def _order(path: Path) -> tuple[str, bool, int, str]:
    version = _version(path)
    is_number = version.isdecimal()
    return (path.name.rpartition("@")[0], is_number, int(version) if is_number else 0, version)


def _version(path: Path) -> str:
    return path.name.rpartition("@")[2]


def _check_names(*names: str) -> None:
    for name in names:
        if not _NAME.fullmatch(name) or name == DATASET_FILE:
            raise BadName(f"'{name}' cannot name a dataset, its version or its files: use letters, digits, . _ -")
