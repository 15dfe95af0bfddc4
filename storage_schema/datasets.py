"""Datasets: named, immutable lists of artifacts, `datasets/<name>@<version>/`."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage_schema.ancestry import walk_stored
from storage_schema.credits import SourceCredit
from storage_schema.durable import sync_folder, write_errors, write_file
from storage_schema.errors import BadName, CorruptArtifact, OlderSchema, UnknownReference
from storage_schema.keys import canonical_json, json_file
from storage_schema.manifest import ArtifactRef, Identity, refuse_newer, refuse_older
from storage_schema.staging import StagingFolder
from storage_schema.version import SCHEMA_VERSION

if TYPE_CHECKING:
    from storage_schema.store import Store

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
DATASET_FILE = "dataset.json"


@dataclass(frozen=True)
class Dataset:
    """A named, immutable list of artifacts.

    Datasets without a stated version are numbered from 1. Licences and credits are those of its creation, and never
    change either. The digest is over stages, keys and content digests of the artifacts, and the sources. `created_at`
    is in UTC; attached files, such as the dataset card, are in `path`.
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

    def to_json(self, **more: Any) -> bytes:
        """Return the bytes of its file, with `more` keys."""
        values = {**asdict(self), "schema_version": SCHEMA_VERSION, **more}
        del values["path"]
        return json_file(values)


def list_datasets(store: Store, name: str = "*") -> list[Dataset]:
    """Return the datasets of a store or the versions of one, without those of an older schema.

    CorruptArtifact if the list of one cannot be read; `dataset_labels` has all datasets.
    """
    datasets = []
    for path in _folders(store, name):
        with suppress(OlderSchema):
            datasets.append(_read(path))
    return datasets


def named_places(store: Store) -> set[tuple[str, str]]:
    """Return stage and key of all artifacts in the datasets of a store, also those of an older schema.

    CorruptArtifact if the list of one cannot be read, because its artifacts are unknown.
    """
    places = set[tuple[str, str]]()
    for path in _folders(store):
        try:
            values = json.loads((path / DATASET_FILE).read_bytes())
            refuse_newer(values["schema_version"], str(path))
            places.update((ref["stage"], ref["key"]) for ref in values["refs"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CorruptArtifact(f"dataset {path.name} cannot be read: {error!r}") from error
    return places


def dataset_labels(store: Store) -> list[str]:
    """Return `name@version` of all datasets of a store, readable or not."""
    return [path.name for path in _folders(store)]


def newest_version(store: Store, name: str) -> Dataset | None:
    """Return the highest numbered version of a dataset; None without one, or if it has an older schema."""
    numbered = [path for path in _folders(store, name) if _version(path).isdecimal()]
    with suppress(OlderSchema):
        return _read(numbered[-1]) if numbered else None
    return None


def open_dataset(store: Store, label: str) -> Dataset:
    """Return the dataset `name@version`, or the newest version of `name`; UnknownReference lists those that exist."""
    named = [path for path in _folders(store) if label in (path.name, path.name.rpartition("@")[0])]
    if not named:
        there = ", ".join(path.name for path in _folders(store)) or "none"
        raise UnknownReference(f"there is no dataset '{label}' in the store {store}; there are: {there}")
    return _read(named[-1])


def datasets_with(store: Store, ref: ArtifactRef) -> Iterator[Dataset]:
    """Yield the datasets that name this content of an artifact or were computed from it.

    Datasets of an older schema need other artifacts. CorruptArtifact if the list of one cannot be read.
    """
    for path in _folders(store):
        with suppress(OlderSchema):
            dataset, needed = _read_with_needs(store, path)
            if ref.identity in needed:
                yield dataset


@lru_cache(maxsize=64)
def _read_with_needs(store: Store, path: Path) -> tuple[Dataset, frozenset[Identity]]:
    """Return a dataset and the identities of its artifacts and their ancestors, which never change."""
    dataset = _read(path)
    return dataset, frozenset(step.ref.identity for step in walk_stored(store, dataset.refs))


def dataset_digest(refs: Sequence[ArtifactRef], sources: Sequence[SourceCredit]) -> str:
    """Return the sha256 over the stages, keys and content digests of artifacts, and the licences and credits."""
    return hashlib.sha256(canonical_json([[asdict(credit) for credit in part] for part in (refs, sources)])).hexdigest()


def add_dataset(store: Store, dataset: Dataset, attachments: Mapping[str, bytes]) -> bool:
    """Write the dataset's folder and rename it to its name in one step; return false if the name is taken."""
    check_names(dataset.name, dataset.version, *attachments)
    with write_errors(store.root), closing(StagingFolder(store.staging_root)) as staging:
        for name, data in attachments.items():
            write_file(staging.path / name, data)
        write_file(staging.path / DATASET_FILE, dataset.to_json())
        sync_folder(staging.path)
        return store.add_dataset(staging.path, dataset.label)


def dataset_from_json(read: Callable[[], bytes], path: Path, *, less: Collection[str] = ()) -> Dataset:
    """Return the dataset in the folder `path` from the JSON that `read` returns, without the `less` keys.

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
    """Return the folders of datasets by name, with numbered versions by number after the others.

    Their lists, which may have 100,000 artifacts, are not read.
    """
    return sorted((store.root / "datasets").glob(f"{name}@*"), key=_order)


def _order(path: Path) -> tuple[str, int, str]:
    version = _version(path)
    return (path.name.rpartition("@")[0], int(version) if version.isdecimal() else -1, version)


def _version(path: Path) -> str:
    return path.name.rpartition("@")[2]


def check_names(*names: str) -> None:
    """Refuse names that a dataset, its version or its files cannot have; BadName says which."""
    for name in names:
        if not _NAME.fullmatch(name) or name == DATASET_FILE:
            raise BadName(f"'{name}' cannot name a dataset, its version or its files: use letters, digits, . _ -")
