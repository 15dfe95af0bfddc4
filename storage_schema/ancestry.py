"""Lineage of an artifact: everything it was computed from, up to the source files."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from storage_schema.errors import CorruptArtifact, MissingArtifact
from storage_schema.manifest import ArtifactRef, Identity, Manifest

if TYPE_CHECKING:
    from storage_schema.store import Store


@dataclass(frozen=True)
class LineageStep:
    """An ancestor, its smallest distance from the given artifacts, and its manifest; None if it is gone."""

    ref: ArtifactRef
    depth: int
    manifest: Manifest | None


@dataclass(frozen=True, order=True)
class SourceFileUse:
    """A source file in a lineage: its name, its sha256 and the stage that read it."""

    name: str
    sha256: str
    stage: str


def walk(
    refs: Iterable[ArtifactRef],
    read: Callable[[Sequence[ArtifactRef]], Iterable[Manifest | None]],
    known: Container[tuple[str, str]] = (),
) -> Iterator[LineageStep]:
    """Yield the artifacts and all their ancestors, each once, by distance.

    Args:
        refs: The artifacts.
        read: Returns the manifests of some artifacts; None for one that is gone, which ends its branch.
        known: Places that are skipped, with all their ancestors.
    """
    seen: set[tuple[str, str, str]] = set()
    depth, waiting = 0, list(refs)
    while waiting:
        new = {ref.identity: ref for ref in waiting if ref.identity not in seen and ref.place not in known}
        seen |= new.keys()
        steps = [LineageStep(*row) for row in zip(new.values(), [depth] * len(new), read([*new.values()]), strict=True)]
        yield from steps
        depth, waiting = depth + 1, sorted(ref for step in steps if step.manifest for ref in step.manifest.inputs)


def walk_stored(
    store: Store, refs: Iterable[ArtifactRef], known: Container[tuple[str, str]] = ()
) -> Iterator[LineageStep]:
    """Walk the artifacts of a store; those that are missing or have other content have no manifest."""
    return walk(refs, lambda level: [find_manifest(store, ref) for ref in level], known)


def lineage(store: Store, *refs: ArtifactRef) -> list[LineageStep]:
    """Return the artifacts and all their ancestors, each once, by distance.

    An input that is no longer in the store has no manifest and ends its branch.

    Raises:
        MissingArtifact: One of these artifacts is not in the store.
    """
    for ref in refs:
        store.manifest(ref)
    return list(walk_stored(store, refs))


def has_lineage(store: Store, refs: Iterable[ArtifactRef], known: set[tuple[str, str]]) -> bool:
    """Return whether these artifacts and all their ancestors exist.

    `known` are places that are known to exist; those found are added.
    """
    ancestors = set[tuple[str, str]]()
    for step in walk_stored(store, refs, known):
        if step.manifest is None:
            return False
        ancestors.add(step.ref.place)
    known |= ancestors
    return True


def held_out(store: Store, refs: Iterable[ArtifactRef]) -> set[Identity]:
    """Return held-out artifacts and their descendants, which nothing may learn from.

    A missing ancestor counts as not held out.
    """
    manifests = {step.ref.identity: step.manifest for step in walk_stored(store, refs)}
    is_held: dict[Identity, bool] = {}

    def judge(identity: Identity) -> bool:
        if identity not in is_held:
            manifest = manifests[identity]
            is_held[identity] = manifest is not None and (
                bool(manifest.facts.get("is_held_out")) or any(judge(ref.identity) for ref in manifest.inputs)
            )
        return is_held[identity]

    return {identity for identity in manifests if judge(identity)}


def source_files(steps: Iterable[LineageStep]) -> list[SourceFileUse]:
    """Return every source file that was read in these steps, sorted by name."""
    return sorted(
        {
            SourceFileUse(name, sha256, step.ref.stage)
            for step in steps
            if step.manifest is not None
            for name, sha256 in step.manifest.files
        }
    )


def inputs_with(store: Store, ref: ArtifactRef, table: str) -> Iterator[ArtifactRef]:
    """Yield the inputs of an artifact that hold a part of a table; those after the last one taken are not read."""
    return (read for read in store.manifest(ref).inputs if table in store.manifest(read).tables)


def find_manifest(store: Store, ref: ArtifactRef) -> Manifest | None:
    """Return the manifest of an artifact; None if it is missing or has other content."""
    try:
        return store.manifest(ref)
    except (MissingArtifact, CorruptArtifact):
        return None
