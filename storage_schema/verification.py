"""Checks what lies in a store against the manifests: every byte is digested again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from storage_schema.datasets import list_datasets
from storage_schema.errors import CorruptArtifact, MissingArtifact
from storage_schema.keys import content_digest, file_sha256
from storage_schema.manifest import MANIFEST_NAME, Manifest
from storage_schema.store import Store

__all__ = ["Problem", "ProblemKind", "Verification", "verify"]


class ProblemKind(Enum):
    """What can be wrong with a file of an artifact."""

    MISSING = "missing"
    CHANGED = "changed"
    EXTRA = "extra"
    UNREADABLE = "unreadable"


@dataclass(frozen=True)
class Problem:
    """Something in the store that is not as a manifest, or a dataset, says."""

    kind: ProblemKind
    stage: str
    key: str
    file_name: str
    detail: str

    def __str__(self) -> str:
        return f"{self.stage}@{self.key[:12]}/{self.file_name}: {self.kind.value}: {self.detail}"


@dataclass(frozen=True)
class Verification:
    """What was checked, and what is wrong."""

    num_artifacts: int
    num_files: int
    num_bytes: int
    problems: tuple[Problem, ...]

    @property
    def is_ok(self) -> bool:
        """Tell whether nothing is wrong."""
        return not self.problems


def verify(store: Store) -> Verification:
    """Digest the files of a whole store again, and look for what its datasets name.

    Raises:
        NewerSchema: The store was written by a newer program.
    """
    store.check_version()
    store.clear_leftovers()
    folders = store.folders()
    problems: list[Problem] = []
    num_files = num_bytes = 0
    for folder in folders:
        stage, key = folder.parent.parent.name, folder.name
        try:
            manifest = store.load(stage, key)
        except MissingArtifact as error:
            problems.append(Problem(ProblemKind.MISSING, stage, key, MANIFEST_NAME, str(error)))
            continue
        except CorruptArtifact as error:
            problems.append(Problem(ProblemKind.UNREADABLE, stage, key, MANIFEST_NAME, str(error)))
            continue
        num_files += len(manifest.data_files)
        num_bytes += manifest.num_bytes
        problems.extend(_check(store, folder, manifest))
    problems.extend(_check_datasets(store))
    return Verification(len(folders), num_files, num_bytes, tuple(problems))


def _check(store: Store, folder: Path, manifest: Manifest) -> Iterator[Problem]:
    stage, key = manifest.ref.stage, manifest.ref.key
    recorded = {name: entry.sha256 for name, entry in manifest.data_files.items()}
    for name, sha256 in recorded.items():
        problem = _check_file(store, folder / name, sha256)
        if problem is not None:
            yield Problem(problem[0], stage, key, name, problem[1])
    for path in sorted(folder.iterdir()):
        if path.name not in recorded and path.name != MANIFEST_NAME:
            yield Problem(ProblemKind.EXTRA, stage, key, path.name, "the manifest does not name it")
    digest = content_digest(recorded)
    if digest != manifest.ref.content_digest:
        detail = f"content digest {manifest.ref.content_digest[:12]} is not that of the files it lists, {digest[:12]}"
        yield Problem(ProblemKind.CHANGED, stage, key, MANIFEST_NAME, detail)


def _check_file(store: Store, path: Path, sha256: str) -> tuple[ProblemKind, str] | None:
    try:
        found = file_sha256(path) if store.mirror is None else store.mirror.part_sha256(sha256)
    except FileNotFoundError:
        return ProblemKind.MISSING, "the manifest names it"
    except OSError as error:
        return ProblemKind.UNREADABLE, str(error.strerror)
    if found != sha256:
        return ProblemKind.CHANGED, f"sha256 is {found[:12]}, the manifest says {sha256[:12]}"
    return None


def _check_datasets(store: Store) -> Iterator[Problem]:
    for dataset in list_datasets(store):
        for ref in dataset.refs:
            manifest = store.find(ref.stage, ref.key)
            if manifest is None or manifest.ref != ref:
                detail = f"dataset {dataset.label} names this artifact, which is missing or incomplete in the store"
                yield Problem(ProblemKind.MISSING, ref.stage, ref.key, MANIFEST_NAME, detail)
