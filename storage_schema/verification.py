"""Verifies the contents of a store against its manifests, by digesting every file again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from storage_schema.ancestry import LineageStep, walk_stored
from storage_schema.datasets import DATASET_FILE, Dataset, dataset_labels, open_dataset
from storage_schema.errors import CorruptArtifact, MissingArtifact, OlderSchema, StorageError
from storage_schema.keys import file_sha256
from storage_schema.manifest import MANIFEST_NAME, RESERVED_NAMES, ArtifactRef, FileEntry, Manifest
from storage_schema.runs import REPORT_PAGE, list_runs, read_latest
from storage_schema.store import Store


class ProblemKind(Enum):
    """Faults of a file of an artifact."""

    MISSING = "missing"
    CHANGED = "changed"
    EXTRA = "extra"
    UNREADABLE = "unreadable"


@dataclass(frozen=True)
class Problem:
    """A contradiction between the store and a manifest or dataset."""

    kind: ProblemKind
    stage: str
    key: str
    file_name: str
    detail: str

    def __str__(self) -> str:
        place = f"{self.stage}/{self.key}" if self.stage in RESERVED_NAMES else f"{self.stage}@{self.key[:12]}"
        return f"{place}/{self.file_name}: {self.kind.value}: {self.detail}"


@dataclass(frozen=True)
class Verification:
    """Result of a verification."""

    num_artifacts: int
    num_files: int
    num_bytes: int
    problems: tuple[Problem, ...]
    notes: tuple[str, ...] = ()

    @property
    def is_ok(self) -> bool:
        """Return whether nothing is wrong."""
        return not self.problems


def verify(store: Store) -> Verification:
    """Verify a store: digest its files, find the artifacts of its datasets, and read the records of its runs.

    Raises:
        NewerSchema: The store was written by a newer program.
    """
    store.check_version()
    store.clear_leftovers()
    folders = store.folders()
    problems: list[Problem] = []
    older: dict[tuple[str, str], OlderSchema] = {}
    num_files = num_bytes = num_undigested = 0
    for folder in folders:
        stage, key = folder.parent.parent.name, folder.name
        try:
            manifest = store.load(stage, key)
        except OlderSchema as error:
            older[stage, key] = error
        except MissingArtifact as error:
            problems.append(Problem(ProblemKind.MISSING, stage, key, MANIFEST_NAME, str(error)))
        except CorruptArtifact as error:
            problems.append(Problem(ProblemKind.UNREADABLE, stage, key, MANIFEST_NAME, str(error)))
        else:
            num_files += len(manifest.data_files)
            num_bytes += manifest.num_bytes
            num_undigested += not manifest.digest
            problems.extend(_check(store, folder, manifest))
    notes = []
    if older:
        notes.append(
            f"artifacts that were not looked through: {len(older)}, such as this: {next(iter(older.values()))}"
        )
    if num_undigested:
        notes.append(
            f"manifests without a digest of themselves, as earlier releases wrote them: {num_undigested}; changes of "
            "their licences, seeds and versions cannot be noticed, their data files were compared"
        )
    for label in dataset_labels(store):
        try:
            dataset = open_dataset(store, label)
        except OlderSchema as error:
            notes.append(str(error))
        except CorruptArtifact as error:
            problems.append(Problem(ProblemKind.UNREADABLE, "datasets", label, DATASET_FILE, str(error)))
        else:
            needed = list(walk_stored(store, dataset.refs))
            problems.extend(_check_dataset(store, dataset, [step for step in needed if step.ref.place not in older]))
            notes.extend(_outdated(store, dataset, needed))
    problems.extend(_check_records(store))
    problems.extend(_check_reports(store))
    return Verification(len(folders), num_files, num_bytes, tuple(problems), tuple(notes))


def _check(store: Store, folder: Path, manifest: Manifest) -> Iterator[Problem]:
    stage, key = manifest.ref.stage, manifest.ref.key
    recorded = manifest.data_files
    store.drop_copies(manifest)
    for name, entry in recorded.items():
        problem = _check_file(store, manifest.ref, name, entry)
        if problem is not None:
            yield Problem(problem[0], stage, key, name, problem[1])
    for path in sorted(folder.iterdir()):
        if path.name not in recorded and path.name != MANIFEST_NAME:
            yield Problem(ProblemKind.EXTRA, stage, key, path.name, "the manifest does not name it")
    if faults := manifest.faults:
        yield Problem(ProblemKind.CHANGED, stage, key, MANIFEST_NAME, "; ".join(faults))


def _check_file(store: Store, ref: ArtifactRef, name: str, entry: FileEntry) -> tuple[ProblemKind, str] | None:
    try:
        digest = store.file_sha256(ref, name, entry)
    except FileNotFoundError:
        return ProblemKind.MISSING, "the manifest names it"
    except OSError as error:
        return ProblemKind.UNREADABLE, str(error.strerror)
    if digest != entry.sha256:
        return ProblemKind.CHANGED, f"sha256 is {digest[:12]}, the manifest says {entry.sha256[:12]}"
    return None


def _check_dataset(store: Store, dataset: Dataset, needed: Sequence[LineageStep]) -> Iterator[Problem]:
    named = {(ref.stage, ref.key) for ref in dataset.refs}
    for (stage, key), manifest in ((step.ref.place, step.manifest) for step in needed):
        if manifest is None or not store.has_files(manifest):
            how = "names this artifact" if (stage, key) in named else "was computed from this artifact"
            detail = f"dataset {dataset.label} {how}, which is missing, incomplete or of other content in the store"
            yield Problem(ProblemKind.MISSING, stage, key, MANIFEST_NAME, detail)


def _outdated(store: Store, dataset: Dataset, needed: Sequence[LineageStep]) -> Iterator[str]:
    """Yield notes on tables of a dataset with other columns, with the release that reads them."""
    releases: dict[str, set[str]] = {}
    for manifest in filter(None, (step.manifest for step in needed)):
        for table in store.outdated_tables(manifest):
            releases.setdefault(manifest.code_version, set()).add(table)
    for release, tables in releases.items():
        words = f"dataset {dataset.label}: {', '.join(sorted(tables))} of it have columns of another version"
        yield f"{words}; pasdedeux {release} reads them, and a run of its study with this one computes them anew"


def _check_records(store: Store) -> Iterator[Problem]:
    """Check the records of runs, which explain finished work and stale artifacts; no result depends on them."""
    for path in sorted((store.root / "runs").glob("*/*.json")):
        try:
            values = json.loads(path.read_bytes())
            if not isinstance(values, dict):
                raise TypeError(f"it is no JSON object but a {type(values).__name__}")
            if path.parent.name == "latest":
                read_latest(store, path.stem)
        except OlderSchema:
            continue  # the next run of its study replaces it
        except (OSError, ValueError, TypeError, CorruptArtifact) as error:
            advice = "a run of its study writes it anew" if path.parent.name == "latest" else "it can be removed"
            detail = f"this record of a run cannot be read ({error.__cause__ or error}); {advice}"
            yield Problem(ProblemKind.UNREADABLE, "runs", path.parent.name, path.name, detail)


def _check_reports(store: Store) -> Iterator[Problem]:
    """Compare the copies of reports in the folders of runs with the artifacts of each run."""
    advice = "where that folder is removed, the next run of the study copies its report again"
    for folder in list_runs(store):
        for path, entries in _copied(store, folder.path).items():
            try:
                is_same = path.stat().st_size in {entry.bytes for entry in entries} and (
                    file_sha256(path) in {entry.sha256 for entry in entries}
                )
                kind, detail = ProblemKind.CHANGED, "it differs from the artifact that it was copied from"
            except OSError as error:
                is_same, kind, detail = False, ProblemKind.MISSING, f"it cannot be read: {error.strerror}"
            if not is_same:
                yield Problem(kind, "runs", folder.run_id, f"report/{path.name}", f"{detail}; {advice}")
    copies = sorted((store.root / "runs" / "latest").glob("[!.]*.html"))
    originals = {_digest(folder.path / "report" / REPORT_PAGE) for folder in list_runs(store)}
    for page in copies:
        if (digest := _digest(page)) is None or digest not in originals:
            detail = "it is the report of no run that is there; the next run of its study copies it again"
            yield Problem(ProblemKind.CHANGED, "runs", "latest", page.name, detail)


def _digest(path: Path) -> str | None:
    """Return the sha256 of a file; None if it is missing or cannot be read."""
    try:
        return file_sha256(path)
    except OSError:
        return None


def _copied(store: Store, run: Path) -> dict[Path, list[FileEntry]]:
    """Return the files of a run's report, each with its possible originals; none if these are unknown."""
    copied: dict[Path, list[FileEntry]] = {}
    if not (run / "report").is_dir():
        return copied
    try:
        stages = json.loads((run / "run.json").read_bytes())["stages"]
        refs = [
            ArtifactRef(entry["stage"], shard["key"], shard["content_digest"])
            for entry in stages
            for shard in entry["artifacts"]
        ]
    except (OSError, ValueError, KeyError, TypeError, StorageError):
        return copied  # the record itself is checked elsewhere
    for ref in refs:
        manifest = store.find(ref.stage, ref.key)
        if manifest is None or manifest.ref != ref:
            continue
        for name, entry in manifest.attachments.items():
            if REPORT_PAGE in manifest.attachments or (run / "report" / name).exists():
                copied.setdefault(run / "report" / name, []).append(entry)
    return copied
