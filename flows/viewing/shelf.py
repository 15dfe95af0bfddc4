"""The contents of the viewer, by manifests alone: parts of a store, their items, and the place of a reference.

An item is played as a whole, such as a variant, a chain or a take; its rows are read when it is shown.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from flows.finished_builds import read_recorded
from flows.records import last_sections
from flows.viewing.films import find_film, find_shot
from flows.viewing.scene import Scene
from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError
from storage_schema import (
    TABLES,
    ArtifactRef,
    Store,
    TableData,
    latest_studies,
    list_runs,
    parse_reference,
    read_latest,
    resolve,
)
from storage_schema.references import find_rows
from storage_schema.table_data import concatenate
from tasks.files.curation import IDENTITY

GROUPS = {**IDENTITY, "lifted_pairs": ("method",), "draws": ("density", "seed_index", "chain"), "seeds": ("origin",)}
"""Tables that can be viewed, with the columns that group their rows into items."""
SINGLE_IMAGES = "single images"
_STILLS = 3
"""Sequences of fewer frames are single images, which make one item."""


@dataclass(frozen=True)
class ViewedPartition:
    """A partition of a table."""

    table: str
    name: str
    refs: tuple[ArtifactRef, ...]


@dataclass(frozen=True)
class Item:
    """Rows that are played together: names, rows by artifact, and label."""

    names: tuple[str, ...]
    pieces: tuple[tuple[ArtifactRef, Integers], ...]
    label: str

    def row(self, number: int) -> tuple[ArtifactRef, int]:
        """Return artifact and row there of a row of the item."""
        for ref, rows in self.pieces:
            if number < len(rows):
                return ref, int(rows[number])
            number -= len(rows)
        raise IndexError(number)

    def number(self, ref: ArtifactRef, row: int) -> int | None:
        """Return the row of the item for a row of an artifact; None if that is not in the item."""
        before = 0
        for artifact, rows in self.pieces:
            if artifact == ref and len(positions := np.flatnonzero(rows == row)):
                return before + int(positions[0])
            before += len(rows)
        return None

    def read(self, store: Store, table: str, columns: Sequence[str]) -> TableData:
        """Read columns of its rows, artifact by artifact."""
        parts = []
        for ref, rows in self.pieces:
            data = store.read(ref, table, columns=columns, rows=slice(int(rows[0]), int(rows[-1]) + 1))
            is_whole = len(rows) == data.num_rows
            parts.append(data if is_whole else TableData(data.table, data.rows.take(rows - rows[0])))
        return concatenate(TABLES[table], parts)


class Found(NamedTuple):
    """A place: the part, the number of the item in it, and the row of the item."""

    part: ViewedPartition
    item: int
    row: int


class Shelf:
    """The viewable contents of some artifacts.

    Args:
        store: The store.
        shown: The requested artifacts.
        beside: Further available artifacts: the rest of the study.
        tables: Tables to show; by default all that can be shown.
        sections: The recorded study, with the paths of its films.
        scenes: Scenes of artifacts that have no working skeleton: files whose joints fit no layout.
    """

    def __init__(
        self,
        store: Store,
        shown: Iterable[ArtifactRef],
        beside: Iterable[ArtifactRef] = (),
        tables: Sequence[str] = (),
        sections: Mapping[str, Any] | None = None,
        scenes: Mapping[ArtifactRef, Scene] | None = None,
    ) -> None:
        self.store, self.scenes = store, scenes or {}
        ingest = (sections or {}).get("ingest", {})
        self.film = lru_cache(maxsize=None)(lambda ref: find_film(store.manifest(ref), ingest))
        self.shot = lru_cache(maxsize=4)(lambda ref: find_shot(store.manifest(ref), ingest))
        self.corrected: dict[ArtifactRef, Mapping[tuple[int, int], Array]] = {}
        """Corrected 2D joints of film (17, 2) by frame and person; NaN: as stored."""
        self.beside = tuple(dict.fromkeys([*shown, *beside]))
        refs_by_item: dict[tuple[str, str], list[ArtifactRef]] = {}
        for ref in dict.fromkeys(shown):
            manifest = store.manifest(ref)
            for table in manifest.tables:
                if table in (tables or GROUPS) and manifest.tables[table].rows:
                    refs_by_item.setdefault((table, manifest.partition), []).append(ref)
        order = list(GROUPS)
        places = sorted(refs_by_item, key=lambda place: order.index(place[0]))
        self.parts = [ViewedPartition(*place, tuple(refs_by_item[place])) for place in places]
        self.items = lru_cache(maxsize=8)(self._items)

    def _items(self, part: ViewedPartition) -> list[Item]:
        """Return the items of a part, from the grouping columns alone."""
        columns = GROUPS[part.table]
        rows_by_item: dict[tuple[str, ...], list[tuple[ArtifactRef, Integers]]] = {}
        for ref in part.refs:
            data = self.store.read(ref, part.table, columns=columns)
            names = np.stack([np.asarray(data[name]).astype(str) for name in columns], axis=-1)
            unique, which = np.unique(names, axis=0, return_inverse=True)
            rows = np.split(np.argsort(which.ravel(), kind="stable"), np.cumsum(np.bincount(which.ravel()))[:-1])
            sizes = [len(row) for row in rows]
            if part.table == "annotations" and max(sizes) < 2 * _STILLS:
                unique, rows = np.array([[SINGLE_IMAGES]]), [np.arange(data.num_rows)]
            for name, item_rows in zip(unique.tolist(), rows, strict=True):
                rows_by_item.setdefault(tuple(name), []).append((ref, item_rows))
        return [Item(names, tuple(pieces), _label(columns, names)) for names, pieces in rows_by_item.items()]

    def having(self, table: str, partition: str | None = None) -> list[ArtifactRef]:
        """Return the available artifacts with a table, of one partition or of all."""
        manifests = map(self.store.manifest, self.beside)
        return [
            manifest.ref
            for manifest in manifests
            if table in manifest.tables and partition in (None, manifest.partition)
        ]

    def find(self, text: str) -> Found:
        """Return the place of a reference, with or without a row.

        Raises:
            UnknownReference, InputError: The place does not exist here.
        """
        reference = parse_reference(text)
        ref, rows = find_rows(reference, self.store)[0]
        for part in self.parts:
            if part.table == reference.table and ref in part.refs:
                for index, item in enumerate(self.items(part)):
                    if (number := item.number(ref, rows.start)) is not None:
                        return Found(part, index, number)
        raise InputError(f"'{text}' is not part of what is shown here")


def open_shelf(store: Store, word: str | None) -> Shelf:
    """Return the shelf of a study, a run, a version of a dataset or a reference; by default of the newest study.

    Raises:
        InputError: There is nothing to show.
        PlanError: A run has not finished.
        UnknownReference: The word names nothing; lists the known names.
    """
    if word is None:
        runs = [(last.run_id, name) for name in latest_studies(store) if (last := read_latest(store, name))]
        if not runs:
            raise InputError(f"the store {store} holds no study yet: `pasdedeux run` builds one, or name motion files")
        word = max(runs)[1]
    if re.fullmatch(r"\w+[:@][^#]*(#.*)?", word) and word.partition("@")[0].partition(":")[0] in TABLES:
        reference = parse_reference(word)
        refs = resolve(reference, store)
        if reference.table not in GROUPS:
            raise InputError(f"'{word}' contains no people; tables with people: {', '.join(GROUPS)}")
        last = read_latest(store, reference.study) if reference.study else None
        rest = [ref for ref in last.refs() if store.find(*ref.place)] if last else []
        shelf = Shelf(store, refs, rest, (reference.table,), last_sections(store, last))
    elif "@" in word or word in {folder.run_id for folder in list_runs(store)}:
        recorded = read_recorded(store, word)
        shelf = Shelf(store, [artifact.ref for artifact in recorded.artifacts.values()], sections=recorded.sections)
    else:
        latest = read_latest(store, word)
        if latest is None:
            there = ", ".join(latest_studies(store)) or "none"
            raise InputError(
                f"'{word}' is no file here, and no study, run or reference of the store {store}; studies: {there}"
            )
        refs = [ref for ref in latest.refs() if store.find(*ref.place)]
        shelf = Shelf(store, refs, sections=last_sections(store, latest))
    if not shelf.parts:
        raise InputError(f"'{word}' contains no people yet; tables with people: {', '.join(GROUPS)}")
    return shelf


def _label(columns: Sequence[str], names: Sequence[str]) -> str:
    """Return the label of an item; numbers get the name of their column.

    >>> _label(("density", "seed_index", "chain"), ("ic", "0", "1"))
    'ic seed 0 chain 1'
    """
    words = [
        f"{column.removesuffix('_index')} {name}" if name.isdigit() else name
        for column, name in zip(columns, names, strict=True)
    ]
    return " ".join(words)


def moment_reference(part: ViewedPartition, item: Item, row: int) -> str:
    """Return the reference of a row of an item by the artifact's content, which outlives runs and keys."""
    ref, at = item.row(row)
    return f"{part.table}@{ref.content_digest[:16]}#{at}"


def moment_in(text: str) -> str:
    """Return the reference in a link to a moment, or a bare reference.

    Raises:
        InputError: It is no address.
    """
    try:
        return parse_qs(urlsplit(text).query).get("at", [text])[0]
    except ValueError:
        raise InputError(f"'{text[:60]}' is not the address of a moment") from None
