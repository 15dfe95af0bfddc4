"""Selects the contents of a dataset's folder: artifacts that may be shared, without rejected rows, and their splits."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa

from flows.planning import PlanError
from pasdedeux.plain_text import counted
from storage_schema import ArtifactRef, Dataset, Manifest, Store, lineage
from storage_schema.ancestry import held_out
from storage_schema.datasets import dataset_digest
from storage_schema.parquet_files import ROW_GROUP_ROWS
from tasks.files.curation import content_columns, recorded_choices, rejected_names, rejections, rows_without
from tasks.rows.sides import SPLITS, Side, SplitName, take_sides
from tasks.stage.facts import Facts, SequenceFacts, TakeFacts, VariantFacts

Ranges = tuple[tuple[int, int], ...]
_FORBIDS = re.compile(
    r"not stated|\b(no|not|without|forbid\w*|prohibit\w*)\b.{0,20}\bre-?distribut|all rights reserved|internal use",
    re.I,
)
"""Words of a licence that forbids sharing; an unstated licence forbids it too."""
_OF_VARIANTS = ("variants", "variant_quality", "variant_frames")


@dataclass(frozen=True)
class RowGroup:
    """Rows of a table of an artifact that become one row group, with their approximate size; `clip` names a clip."""

    table: str
    split: SplitName
    ref: ArtifactRef
    rows: Ranges
    num_bytes: float
    clip: str = ""

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return sum(stop - start for start, stop in self.rows)


@dataclass(frozen=True)
class Contents:
    """The contents of a folder.

    Args:
        dataset: The shared dataset, with the artifacts and sources that may be shared.
        manifests: All shared artifacts, with ancestors, by their place in their stage; without times.
        groups: Their rows.
        sides: The side of each take.
        left_out: Sentences on omitted data.
    """

    dataset: Dataset
    manifests: tuple[Manifest, ...]
    groups: tuple[RowGroup, ...]
    sides: Mapping[str, Side]
    left_out: tuple[str, ...]

    def with_table(self, table: str) -> list[Manifest]:
        """Return the artifacts that hold a part of a table."""
        return [manifest for manifest in self.manifests if table in manifest.tables]


def find_contents(
    store: Store, dataset: Dataset, *, withheld: Collection[str] = (), known: Mapping[str, Side] | None = None
) -> Contents:
    """Return the artifacts of a dataset that may be shared, with all their ancestors.

    Left out are sources whose licence forbids sharing or is not stated, and `withheld` ones; takes that fail; rejected
    items; and everything computed from such a source, take or sequence. The evaluation shows all data, so it is left
    out if anything is.

    Args:
        store: The store.
        dataset: The version.
        withheld: Names of sources to leave out.
        known: Sides of takes that are fixed already.

    Raises:
        PlanError: A withheld source does not exist, or nothing may be shared.
        MissingArtifact: An artifact is no longer complete in the store.
    """
    names = {source.name for source in dataset.sources}
    if unknown := sorted(set(withheld) - names):
        raise PlanError(f"{dataset.label} has no source '{unknown[0]}'; its sources are {', '.join(sorted(names))}")
    staying = [source for source in dataset.sources if source.name in withheld or _FORBIDS.search(source.licence)]
    steps = lineage(store, *dataset.refs)
    every = {step.ref: store.manifest(step.ref) for step in steps}  # the same content under two keys is written once
    choices = recorded_choices(dataset.path)
    tables = {about.partition(" ")[0] for about in choices}
    rejected = {table: _rejected(store, every.values(), table, rejections(choices, table)) for table in tables}
    forbidden = {source.name for source in staying}
    roots = {
        ref
        for ref, manifest in every.items()
        if not forbidden.isdisjoint(source.name for source in manifest.sources) or _is_rejected(manifest, rejected)
    }
    out = _with_descendants(roots, every)
    failed = {
        ref for ref, manifest in every.items() if manifest.facts.get("kind") == "take" and manifest.facts.get("skipped")
    }
    trimmed = {table: names for table, names in rejected.items() if names}
    if out or failed or trimmed:
        out |= failed | {ref for ref in every if ref.stage == "evaluation"}
    left = [manifest for ref, manifest in every.items() if ref not in out]
    kept = sorted(left, key=attrgetter("ref.stage", "partition", "name"))
    takes = [TakeFacts.of(manifest) for manifest in kept if _is_take(manifest)]
    sides = take_sides(dict(sorted({take.take_id: take.is_held_out for take in takes}.items())), known=known)
    tested = {(stage, digest) for stage, _, digest in held_out(store, dataset.refs)}
    manifests: list[Manifest] = []
    groups: list[RowGroup] = []
    for manifest in kept:
        split = _side_of(manifest, sides, is_held_out=(manifest.ref.stage, manifest.ref.content_digest) in tested)
        rows = _kept_rows(store, manifest, rejected)
        if any(part.rows for part in manifest.tables.values()) and not any(rows.values()):
            continue  # all its rows were rejected
        manifests.append(_as_it_leaves(store, manifest, rows, rejected))
        groups += [group for table in rows for group in _groups(store, manifest, table, rows[table], split)]
    if not groups:
        reasons = "; ".join(f"{source.name} (licence: {source.licence})" for source in staying)
        raise PlanError(
            f"nothing of {dataset.label} may leave: {reasons or 'everything is rejected'}; a source has `licence` "
            "and `credit` in its study"
        )
    there = {manifest.ref: manifest.ref for manifest in manifests}
    refs = tuple(there[ref] for ref in dict.fromkeys(dataset.refs) if ref in there)
    sources = tuple(source for source in dataset.sources if source not in staying)
    words = [f"Source {source.name} stays, its licence: {source.licence}." for source in staying]
    words += [f"Takes whose capture fails: {len(failed)}."] if failed else []
    words += [f"Rejected by a person, of {table}: {len(names)}." for table, names in sorted(trimmed.items())]
    words += [f"Artifacts that stay for that: {counted(len(every) - len(there), 'artifact')}."] if words else []
    shared = replace(dataset, refs=refs, sources=sources, digest=dataset_digest(refs, sources))
    return Contents(shared, tuple(manifests), tuple(groups), sides, tuple(words))


def cut_row_groups(batches: Iterable[Any], groups: Sequence[RowGroup]) -> Iterator[Any]:
    """Yield the rows of each group, in rising order, from consecutive batches of rows (`pyarrow.Table`)."""
    coming, held, first = iter(batches), None, 0
    for group in groups:
        parts = []
        for start, stop in group.rows:
            while held is None or first + held.num_rows < stop:
                if held is not None and first < start:
                    gone = min(start - first, held.num_rows)
                    held, first = held.slice(gone), first + gone
                new = next(coming)
                held = new if held is None else pa.concat_tables([held, new])
            parts.append(held.slice(start - first, stop - start))
        yield parts[0] if len(parts) == 1 else pa.concat_tables(parts)


def _is_take(manifest: Manifest) -> bool:
    return "poses" in manifest.tables


def _rejected(store: Store, manifests: Iterable[Manifest], table: str, named: Mapping[str, str]) -> Collection[str]:
    """Return the rejected names of a table whose content is unchanged."""
    columns = content_columns(table)
    parts = (manifest.ref for manifest in manifests if table in manifest.tables)
    return rejected_names(named, (rows for ref in parts for rows in store.iter_batches(ref, table, columns=columns)))


def _is_rejected(manifest: Manifest, rejected: Mapping[str, Collection[str]]) -> bool:
    """Return whether an artifact holds a rejected take or sequence."""
    takes, sequences = rejected.get("poses", ()), rejected.get("annotations", ())
    if _is_take(manifest) and takes:
        return TakeFacts.of(manifest).take_id in takes
    is_seen = "annotations" in manifest.tables and bool(sequences)
    return is_seen and not set(SequenceFacts.of(manifest).sequence_ids).isdisjoint(sequences)


def _with_descendants(roots: set[ArtifactRef], every: Mapping[ArtifactRef, Manifest]) -> set[ArtifactRef]:
    """Return these artifacts and all their descendants."""
    descendants, before = set(roots), -1
    while len(descendants) != before:
        before = len(descendants)
        descendants |= {ref for ref, manifest in every.items() if not descendants.isdisjoint(manifest.inputs)}
    return descendants


def _side_of(manifest: Manifest, sides: Mapping[str, Side], *, is_held_out: bool) -> SplitName:
    """Return the split of an artifact: the last split among its takes."""
    takes = [TakeFacts.of(manifest).take_id] if _is_take(manifest) else Facts.of(manifest).takes
    split_indices = [SPLITS.index(sides[take].split) for take in takes if take in sides]
    return "test" if is_held_out else SPLITS[max(split_indices, default=0)]


def _variant_ids(store: Store, manifest: Manifest) -> list[str]:
    """Return the names of the variants of a batch, take/variant, in the order of their rows."""
    take_id = VariantFacts.of(manifest).take_id
    ids = store.read(manifest.ref, "variant_quality", columns=["variant_id"])["variant_id"]
    return [f"{take_id}/{name}" for name in ids]


def _kept_rows(store: Store, manifest: Manifest, rejected: Mapping[str, Collection[str]]) -> dict[str, Ranges]:
    """Return the shared rows of each table of an artifact, with a range for each variant."""
    facts = VariantFacts.of(manifest) if "variants" in manifest.tables else None
    ranges: dict[str, Ranges] = {}
    for table, part in manifest.tables.items():
        if facts is not None and table in _OF_VARIANTS:
            names = _variant_ids(store, manifest)
            size = part.rows // max(len(names), 1)
            left = [at for at, name in enumerate(names) if name not in rejected.get("variants", ())]
            ranges[table] = tuple((at * size, at * size + size) for at in left)
        elif rejected.get(table):
            batches = store.iter_batches(manifest.ref, table, columns=content_columns(table))
            ranges[table] = _ranges(batches, rejected[table])
        else:
            ranges[table] = ((0, part.rows),) if part.rows else ()
    return ranges


def _ranges(batches: Iterable[Any], names: Collection[str]) -> Ranges:
    first, kept = 0, [np.zeros(0, dtype=np.int64)]
    for batch in batches:
        kept.append(first + rows_without(batch, names))
        first += batch.num_rows
    rows = np.concatenate(kept)
    breaks = [0, *(np.flatnonzero(np.diff(rows) != 1) + 1).tolist(), len(rows)]
    return tuple((int(rows[a]), int(rows[b - 1]) + 1) for a, b in pairwise(breaks) if b > a)


def _groups(store: Store, manifest: Manifest, table: str, rows: Ranges, split: SplitName) -> Iterator[RowGroup]:
    """Yield the row groups of a table of an artifact: one for each clip, else pieces of its rows."""
    part = manifest.tables[table]
    each = part.bytes / max(part.rows, 1)
    if table == "variants":
        names = _variant_ids(store, manifest)
        for variant in rows:
            size = variant[1] - variant[0]
            yield RowGroup(table, split, manifest.ref, (variant,), each * size, names[variant[0] // size])
        return
    clip = TakeFacts.of(manifest).take_id if table == "poses" else ""
    most = part.rows if clip else ROW_GROUP_ROWS
    group: list[tuple[int, int]] = []
    for start, stop in rows:
        while start < stop:
            room = most - sum(b - a for a, b in group)
            group.append((start, min(stop, start + room)))
            start = group[-1][1]
            if sum(b - a for a, b in group) == most:
                yield RowGroup(table, split, manifest.ref, tuple(group), each * most, clip)
                group = []
    if group:
        yield RowGroup(table, split, manifest.ref, tuple(group), each * sum(b - a for a, b in group), clip)


def _as_it_leaves(
    store: Store, manifest: Manifest, rows: Mapping[str, Ranges], rejected: Mapping[str, Collection[str]]
) -> Manifest:
    """Return the manifest without times, and without anything that names or shows rows that are left out."""
    left = replace(manifest, timings={}, created_at="")
    if all(sum(stop - start for start, stop in rows[table]) == part.rows for table, part in manifest.tables.items()):
        return left
    names = _variant_ids(store, manifest) if "variants" in manifest.tables else ()
    staying = {name.partition("/")[2] for name in names if name in rejected["variants"]}
    facts, parameters = _without(manifest.facts, staying), _without(manifest.parameters, staying)
    return replace(left, facts=facts, parameters=parameters, attachments={}, reads=None, digest="")


def _without(value: Any, names: Collection[str]) -> Any:
    """Return JSON values without these names in lists and among keys."""
    if isinstance(value, Mapping):
        return {name: _without(item, names) for name, item in value.items() if name not in names}
    if isinstance(value, list | tuple):
        return [_without(item, names) for item in value if not isinstance(item, str) or item not in names]
    return value
