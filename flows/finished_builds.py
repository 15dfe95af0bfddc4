"""The record of a finished run or of a version of a dataset: its study, environment and artifacts."""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path, PurePosixPath
from typing import Any

from flows.planning import PlanError
from flows.records import ENVIRONMENT_FILE, made_by, run_record
from flows.staleness import changed_leaves
from storage_schema import ArtifactRef, Manifest, SourceCredit, Store, list_runs, open_run
from storage_schema.credits import merge_credits
from storage_schema.datasets import open_dataset
from storage_schema.runs import STUDY_FILE

ArtifactPlace = tuple[str, str, str]
"""Place of an artifact in a study: stage, partition, shard."""

_PATH = re.compile(r'"(/[^"|\n]+)')
"""A path in JSON, also if a table cuts it."""


@dataclass(frozen=True)
class Recorded:
    """A run or a version of a dataset: resolved study, environment, artifacts by place, and credits of sources.

    The artifacts include all ancestors, each after its inputs. `named` are the stages whose artifacts it names
    completely; of other stages it may need only a part.
    """

    label: str
    sections: Mapping[str, Any]
    environment: Mapping[str, Any]
    artifacts: Mapping[ArtifactPlace, Manifest]
    named: frozenset[str]
    credits: tuple[SourceCredit, ...]

    @property
    def stages(self) -> list[str]:
        """Return the stages that made the artifacts."""
        return list(dict.fromkeys(stage for stage, _, _ in self.artifacts))

    @property
    def licences(self) -> dict[str, str]:
        """Return licence and credit of every source by its name."""
        licences: dict[str, str] = {}
        for credit in self.credits:
            licences[credit.name] = " / ".join(
                filter(None, (licences.get(credit.name), f"{credit.licence}; {credit.credit}"))
            )
        return licences

    @property
    def sources(self) -> dict[str, str]:
        """Return the sha256 of every source file, by the stage and partition that read it and its name."""
        files = ((*place[:2], *file) for place, manifest in self.artifacts.items() for file in manifest.files)
        return {f"{stage} {partition} {name}": sha256 for stage, partition, name, sha256 in sorted(files)}


def read_recorded(store: Store, name: str) -> Recorded:
    """Return the record of a run by its id, or of a dataset by `name@version`.

    Raises:
        PlanError: There is no such run, it did not finish, or the study of the dataset is not on record.
        UnknownReference: There is no such dataset.
        MissingArtifact, CorruptArtifact: An artifact is no longer complete in the store.
    """
    if "@" in name:
        dataset = open_dataset(store, name)
        label, folder, refs = dataset.label, dataset.path, list(dataset.refs)
        if not (folder / STUDY_FILE).is_file():
            folder = _run_of(store, refs, name)
    else:
        label, folder, refs = name, _finished_run(store, name), made_by(store, name)
    artifacts = artifacts_by_place(store, refs)
    sources = dataset.sources if "@" in name else merge_credits(*(artifact.sources for artifact in artifacts.values()))
    named = frozenset(ref.stage for ref in refs)
    return Recorded(label, _read(folder, STUDY_FILE), _read(folder, ENVIRONMENT_FILE), artifacts, named, sources)


def _finished_run(store: Store, name: str) -> Path:
    """Return the folder of a run; PlanError where there is none or it did not finish."""
    runs = [folder.run_id for folder in list_runs(store)]
    if name not in runs:
        last = f"; the last are {', '.join(runs[-3:])}" if runs else ""
        raise PlanError(f"there is no run '{name}' in the store {store}{last} (`pasdedeux status`)")
    status = run_record(store, name).get("status", "not on record")
    if status != "finished":
        raise PlanError(
            f"run {name} is no finished run ({status}), so there is nothing to compare with; run it to its end"
        )
    return open_run(store, name).path


def artifacts_by_place(store: Store, refs: Iterable[ArtifactRef]) -> dict[ArtifactPlace, Manifest]:
    """Return these artifacts and all their ancestors by place, each after its inputs.

    Raises:
        PlanError: Two artifacts have one place, so they come from several runs.
        MissingArtifact, CorruptArtifact: One of them is no longer complete in the store.
    """
    manifests: dict[ArtifactRef, Manifest] = {}
    waiting = deque(refs)  # named ones first: an input may be one of them under an older key
    while waiting:
        ref = waiting.popleft()
        if ref not in manifests:
            manifests[ref] = store.manifest(ref)
            waiting += manifests[ref].inputs
    places: dict[ArtifactRef, ArtifactPlace] = {
        ref: (ref.stage, manifest.partition, manifest.name) for ref, manifest in manifests.items()
    }
    reads = {ref: manifests[ref].inputs for ref in sorted(manifests, key=places.__getitem__)}
    artifacts: dict[ArtifactPlace, Manifest] = {}
    for ref in TopologicalSorter(reads).static_order():
        place = places[ref]
        if artifacts.setdefault(place, manifests[ref]) is not manifests[ref]:
            raise PlanError(
                f"{' '.join(place)} was found twice, with different content: the artifacts come from several runs"
            )
    return artifacts


def read_environment(store: Store, run_id: str) -> dict[str, Any]:
    """Return the environment of a run; PlanError if it cannot be read."""
    return _read(open_run(store, run_id).path, ENVIRONMENT_FILE)


def environment_changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the differences of two environments, as text by name; of processor features those that one lacks."""
    features = [set(values.get("processor", {}).get("features", ())) for values in (old, new)]
    changes = changed_leaves(old, new)
    if all(features) and changes.pop("processor.features", None) is not None:
        only = [" ".join(sorted(mine - other)) for mine, other in (features, features[::-1])]
        changes["processor.features"] = (only[0], only[1])
    return changes


def portable_files(folder: Path) -> dict[str, bytes]:
    """Return the files of a dataset for other machines, by name: paths are cut to the last parts that identify them.

    Folders of this machine are private and meaningless elsewhere, where the study reads the same names from the folder
    in which it is built.
    """
    texts = {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir() if path.name != "dataset.json"}
    paths = {text: PurePosixPath(text).parts[1:] for text in _PATH.findall(texts.get(STUDY_FILE, ""))}
    tails = dict(paths)
    for path, parts in paths.items():
        others = [other for known, other in paths.items() if known != path]
        lengths = (n for n in range(1, len(parts)) if all(other[-n:] != parts[-n:] for other in others))
        tails[path] = parts[-next(lengths, len(parts)) :]

    def shortened(match: re.Match[str]) -> str:
        return '"' + "/".join(tails.get(match[1], PurePosixPath(match[1]).parts[-1:]))

    return {name: _PATH.sub(shortened, text).encode() for name, text in sorted(texts.items())}


def _run_of(store: Store, refs: Iterable[ArtifactRef], name: str) -> Path:
    """Return the folder of the last finished run that made or found all these artifacts."""
    for folder in reversed(list_runs(store)):
        is_finished = run_record(store, folder.run_id).get("status") == "finished"
        if is_finished and set(refs).issubset(made_by(store, folder.run_id)):
            return folder.path
    raise PlanError(f"dataset {name} was made by an earlier version, and no run of it is left: its study is not known")


def _read(folder: Path, file_name: str) -> dict[str, Any]:
    try:
        values: dict[str, Any] = json.loads((folder / file_name).read_bytes())
    except (OSError, ValueError) as error:
        raise PlanError(f"{folder / file_name} cannot be read: {error}") from None
    return values
