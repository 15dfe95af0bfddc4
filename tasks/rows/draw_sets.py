"""Draws of chains, and grown and filled pairs beside them, as `lifting` and the evaluation read them from the store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pasdedeux.sampling.densities import DENSITIES
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import StageInputs
from tasks.stage.facts import DrawFacts, SeedFacts

GROWN, FILLED = "grown_seeds", "filled_seeds"
"""Names of grown pairs, and of pairs filled in between, among those of the densities."""
REPAIRED = "_repaired"
"""Ending of the name of a density under which the ends of short chains from grown and filled pairs are kept."""


@dataclass(frozen=True)
class DrawSet:
    """Draws of one density, or grown or filled pairs.

    Args:
        name: The density, `grown_seeds` or `filled_seeds`.
        pairs_m: Pairs (draw, person=2, joint=17, 3), metres, single precision as stored.
        artifacts: Artifact of each draw, by index into `refs`, (draw,).
        rows: Row of each draw in its artifact, (draw,).
        numbers: Index of each draw in its chain, of other pairs in their artifact, (draw,).
        refs: References `draws@...` or `seeds@...` of the artifacts.
        knows_annotations: Whether annotations shaped them; those of the prior alone are a baseline.
    """

    name: str
    pairs_m: np.ndarray
    artifacts: np.ndarray
    rows: np.ndarray
    numbers: np.ndarray
    refs: tuple[str, ...]
    knows_annotations: bool = True

    @property
    def in_order(self) -> np.ndarray:
        """Pairs in the order of chains that run side by side: the first of every chain, then the second, ..."""
        return np.asarray(self.pairs_m[np.argsort(self.numbers, kind="stable")])

    def reference(self, draw: int) -> str:
        """Return the reference of a draw as the command line takes it."""
        return f"{self.refs[int(self.artifacts[draw])]}#{int(self.rows[draw])}"


def reference_to(table: str, ref: ArtifactRef) -> str:
    """Return the reference to an artifact's part of a table, by content: keys change and are in no table."""
    return f"{table}@{ref.content_digest[:16]}"


def density_of(manifest: Manifest) -> str:
    """Return the name of the density of an artifact with draws; grown and filled pairs have their own."""
    return SeedFacts.of(manifest).kind if "seeds" in manifest.tables else DrawFacts.of(manifest).density


def is_set(manifest: Manifest) -> bool:
    """Tell whether an artifact has grown or filled pairs, which count as draws without a chain."""
    return "seeds" in manifest.tables and SeedFacts.of(manifest).kind in (GROWN, FILLED)


def is_chain(manifest: Manifest) -> bool:
    """Tell whether an artifact has draws of one chain, not of short chains from many pairs."""
    return "draws" in manifest.tables and not DrawFacts.of(manifest).num_starts


def knows_annotations(manifest: Manifest) -> bool:
    """Tell whether annotations shaped the pairs of an artifact; those of the prior alone are a baseline."""
    # Not by its name: draws of a sweep are kept under a name of the user's own.
    return "seeds" in manifest.tables or DENSITIES[str(manifest.parameters["density"])].reads_annotations


def draw_manifests(inputs: StageInputs) -> list[Manifest]:
    """Return the artifacts with draws, and those with grown and filled pairs, which count as draws."""
    return [*inputs.of("draws"), *filter(is_set, inputs.of("seeds"))]


def read_draw_sets(store: Store, refs: Iterable[ArtifactRef]) -> dict[str, DrawSet]:
    """Return the draws of each density, all seeds and chains, and the grown and filled pairs, by name in order."""
    return {name: _join(name, parts) for name, parts in _read_parts(store, refs).items()}


def baselines_of(sets: Mapping[str, DrawSet]) -> list[str]:
    """Return the names of the sets that no annotation shaped."""
    return [name for name, drawn in sets.items() if not drawn.knows_annotations]


def read_all_draws(store: Store, refs: Iterable[ArtifactRef]) -> DrawSet:
    """Return all draws of all densities, and the grown and filled pairs, as one set."""
    return _join("all", [part for parts in _read_parts(store, refs).values() for part in parts])


class _ArtifactPairs(NamedTuple):
    """Pairs of an artifact: its reference, number of the first draw in its chain, whether annotations shaped them."""

    ref: str
    start: int
    pairs_m: np.ndarray
    knows_annotations: bool


def _read_parts(store: Store, refs: Iterable[ArtifactRef]) -> dict[str, list[_ArtifactPairs]]:
    """Return the pairs of every artifact, by density in order."""
    parts: dict[str, list[_ArtifactPairs]] = {}
    for ref in refs:
        manifest = store.manifest(ref)
        name, table = density_of(manifest), "draws" if "draws" in manifest.tables else "seeds"
        start = (facts := DrawFacts.of(manifest)).segment * facts.num_draws if table == "draws" else 0
        pairs = np.asarray(store.read(ref, table, columns=["pair17_m"])["pair17_m"], dtype=np.float32)
        if len(pairs):
            part = _ArtifactPairs(reference_to(table, ref), start, pairs, knows_annotations(manifest))
            parts.setdefault(name, []).append(part)
    return dict(sorted(parts.items()))


def _join(name: str, parts: Sequence[_ArtifactPairs]) -> DrawSet:
    """Return the draws of several artifacts, each with its reference, as one set."""
    counts = [len(part.pairs_m) for part in parts]
    return DrawSet(
        name=name,
        pairs_m=np.concatenate([part.pairs_m for part in parts]),
        artifacts=np.repeat(np.arange(len(parts)), counts),
        rows=np.concatenate([np.arange(count) for count in counts]),
        numbers=np.concatenate([part.start + np.arange(len(part.pairs_m)) for part in parts]),
        refs=tuple(part.ref for part in parts),
        knows_annotations=any(part.knows_annotations for part in parts),
    )
