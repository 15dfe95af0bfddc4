"""Where an artifact comes from: everything it was computed from, up to the files from outside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.errors import CorruptArtifact, MissingArtifact, OlderSchema
from storage_schema.manifest import ArtifactRef, Manifest
from storage_schema.runs import LatestRun, latest_studies, read_latest
from storage_schema.store import Store


@dataclass(frozen=True)
class LineageStep:
    """An artifact on the way, its least distance from the one asked about, and its manifest, None when it is gone."""

    ref: ArtifactRef
    depth: int
    manifest: Manifest | None


@dataclass(frozen=True, order=True)
class SourceFileUse:
    """A file from outside that something was computed from: its name, its sha256 and the stage that read it."""

    name: str
    sha256: str
    stage: str


def lineage(store: Store, *refs: ArtifactRef) -> list[LineageStep]:
    """Return the artifacts and everything they were computed from, each once, by distance.

    An input that is no longer in the store is listed without a manifest and ends its branch.

    Raises:
        MissingArtifact: An artifact asked about is not in the store.
    """
    steps: list[LineageStep] = []
    level = list(dict.fromkeys(refs))
    seen = set(level)
    for ref in level:
        store.manifest(ref)
    while level:
        depth = steps[-1].depth + 1 if steps else 0
        added = [LineageStep(part, depth, _manifest(store, part)) for part in level]
        steps.extend(added)
        inputs = [part for step in added if step.manifest is not None for part in step.manifest.inputs]
        level = sorted({part for part in inputs if part not in seen})
        seen.update(level)
    return steps


def has_lineage(store: Store, refs: Iterable[ArtifactRef], known: set[tuple[str, str]]) -> bool:
    """Tell whether these artifacts and all that they were computed from are there.

    `known` are the places of those that are known to be; what is found is added.
    """
    waiting, found = list(refs), set[tuple[str, str]]()
    while waiting:
        ref = waiting.pop()
        if ref.place not in known and ref.place not in found:
            if (manifest := _manifest(store, ref)) is None:
                return False
            found.add(ref.place)
            waiting += manifest.inputs
    known |= found
    return True


def source_credits(store: Store, *refs: ArtifactRef) -> tuple[SourceCredit, ...]:
    """Return the licence and credit of every source of these artifacts, as they stand today.

    A study may say another licence of the same bytes tomorrow: what was made of them is not computed again, and has
    the credits that the last runs say which have it on record, only those whose sources these are where some are.
    Where none has, its sources have those that the last runs of all studies say of them, else those of the newest
    dataset that they came with, else their own.

    Raises:
        MissingArtifact: Something that these came from is no longer in the store: its licence is not known.
    """
    runs = [{ref: ref for stage in one.stages for ref in one.refs(stage)} for one in _last_runs(store)]
    mine = [run for run in runs if any(ref in run and run[ref].place == ref.place for ref in refs)]
    named = {ref.place for ref in refs}
    waiting, seen = list(refs), set(named)
    said: list[Iterable[SourceCredit]] = []
    while waiting:
        ref = waiting.pop()
        # What has the same content in these runs may have come from elsewhere than what was there before.
        found = _there(store, ref, mine)
        found = [one for one in found if one.ref.place in named] or found
        every: Sequence[Manifest | None] = found or [_manifest(store, ref)]
        for one in every:
            if one is None:
                raise MissingArtifact(
                    f"artifact {ref.stage}@{ref.key[:12]}, which this comes from, is no longer whole in the store "
                    f"{store}, so its licence is not known; run the study again"
                )
            if found or not one.sources:
                said.append(one.sources)
            else:
                others = _there(store, ref, runs)
                said += [other.sources for other in others] or [_as_it_came(store, one)]
            waiting += [read for read in one.inputs if read.place not in seen]
            seen.update(read.place for read in one.inputs)
    return merge_credits(*said)


def _there(store: Store, ref: ArtifactRef, runs: Iterable[Mapping[ArtifactRef, ArtifactRef]]) -> list[Manifest]:
    """Return what has this content in these runs, and is in the store."""
    found = (_manifest(store, run[ref]) for run in runs if ref in run)
    return [one for one in found if one is not None]


def _as_it_came(store: Store, source: Manifest) -> tuple[SourceCredit, ...]:
    """Return the credits of a source as the newest dataset that needs it says them, else as it says itself.

    Where a source has another name there than it had, all that the dataset says: its own may be among them.
    """
    from storage_schema.datasets import datasets_with  # here: a dataset is made with the credits of its sources

    found = sorted(datasets_with(store, source.ref), key=lambda one: one.created_at)
    if not found:
        return source.sources
    names = {one.name for one in source.sources}
    said = tuple(one for one in found[-1].sources if one.name in names)
    return said if names == {one.name for one in said} else found[-1].sources


def source_files(steps: Iterable[LineageStep]) -> list[SourceFileUse]:
    """Return every outside file that was read in these steps, sorted by name."""
    return sorted(
        {
            SourceFileUse(name, sha256, step.ref.stage)
            for step in steps
            if step.manifest is not None
            for name, sha256 in step.manifest.files
        }
    )


def _last_runs(store: Store) -> Iterator[LatestRun]:
    for study in latest_studies(store):
        with suppress(OlderSchema):  # what is of an older schema has other content than all that is read here
            if (latest := read_latest(store, study)) is not None:
                yield latest


def _manifest(store: Store, ref: ArtifactRef) -> Manifest | None:
    try:
        return store.manifest(ref)
    except (MissingArtifact, CorruptArtifact):
        return None
