"""Annotated pairs with their views, as `seeds` and `chains` read them from the store."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.sampling.annotations import GatheredPairs, gather_pairs
from pasdedeux.sampling.speeds import NEIGHBOUR_FRAMES
from pasdedeux.skeletons import PAIR17
from storage_schema import ArtifactRef, Manifest, Store, TableData
from tasks.stage import StageInputs

__all__ = [
    "Place",
    "PlacedPairs",
    "annotated_pairs",
    "first_two",
    "gather",
    "gather_tracks",
    "read_people",
    "rows_by_place",
    "views_of",
]

Place = tuple[str, int]
"""Sequence and frame of an annotation."""
People = dict[int, np.ndarray]
"""Joints of the people of a frame, (17, 2), pixels, by person id."""


@dataclass(frozen=True)
class PlacedPairs:
    """Annotated pairs, the place of each by `annotation_index`, and everybody in every frame that was read."""

    gathered: GatheredPairs
    places: tuple[Place, ...]
    frames: Mapping[Place, People]


def annotated_pairs(inputs: StageInputs) -> list[Manifest]:
    """Return the annotations of pairs that may be learned from: single pairs from random views and given ones first."""
    usable = [
        manifest
        for manifest in inputs.of("annotations")
        if not manifest.facts.get("is_held_out", False) and int(manifest.facts.get("num_persons", 2)) >= 2
    ]
    preferred = [manifest for manifest in usable if manifest.facts.get("purpose") in ("random_views", "given")]
    return preferred or usable


def views_of(annotated: Sequence[Manifest], inputs: StageInputs) -> list[Manifest]:
    """Return the views that were estimated from these annotations."""
    seen = {manifest.ref for manifest in annotated}
    return [manifest for manifest in inputs.of("views") if seen.intersection(manifest.inputs)]


def rows_by_place(table: TableData, is_wanted: np.ndarray) -> dict[Place, dict[int, int]]:
    """Return the row of every person by sequence and frame, of the rows of `annotations` that are wanted, (row,)."""
    sequences, frames, persons = table["sequence_id"], table["frame"], table["person_id"]
    rows: dict[Place, dict[int, int]] = {}
    for row in np.flatnonzero(is_wanted).tolist():
        rows.setdefault((str(sequences[row]), int(frames[row])), {})[int(persons[row])] = row
    return rows


def read_people(
    store: Store, refs: Iterable[ArtifactRef], *, is_between: bool = False, with_held_out: bool = False
) -> dict[Place, People]:
    """Return the joints (17, 2), pixels, of every person by sequence and frame.

    Args:
        store: Store.
        refs: Artifacts with `annotations`; others are passed over.
        is_between: Whether frames that are there for velocity alone are wanted too.
        with_held_out: Whether annotations that are held out are wanted too.
    """
    people: dict[Place, People] = {}
    for table, points in _read_tables(store, refs):
        is_wanted = (np.asarray(table["is_key"]) | is_between) & (~np.asarray(table["is_held_out"]) | with_held_out)
        _add_people(people, table, points, is_wanted)
    return people


def _read_tables(store: Store, refs: Iterable[ArtifactRef]) -> Iterator[tuple[TableData, np.ndarray]]:
    """Yield the annotations of each artifact that has some, with their joints (row, 17, 2), pixels."""
    names = ["sequence_id", "frame", "person_id", "is_key", "is_held_out", "pair17_px"]
    for ref in refs:
        if "annotations" in store.manifest(ref).tables:
            table = store.read(ref, "annotations", columns=names)
            yield table, np.asarray(table["pair17_px"], dtype=np.float64)


def _add_people(people: dict[Place, People], table: TableData, points: np.ndarray, is_wanted: np.ndarray) -> None:
    for place, rows in rows_by_place(table, is_wanted).items():
        people.setdefault(place, {}).update({person: points[row] for person, row in rows.items()})


def first_two(people: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the joints (2, 17, 2) of the two people with the smallest ids, of at least two."""
    first, second = sorted(people)[:2]
    return np.stack([people[first], people[second]])


def gather(
    store: Store, *, annotations: Sequence[ArtifactRef], views: Sequence[ArtifactRef], num_hypotheses: int
) -> PlacedPairs:
    """Return every annotated pair with its likeliest view hypotheses; annotations without both are left out.

    Raises:
        InputError: No annotated pair has a view.
    """
    keypoints: dict[Place, People] = {}
    frames: dict[Place, People] = {}
    for table, points in _read_tables(store, annotations):
        is_shown = ~np.asarray(table["is_held_out"])
        _add_people(frames, table, points, is_shown)
        _add_people(keypoints, table, points, is_shown & np.asarray(table["is_key"]))
    pairs, scales, directions, weights, which = [], [], [], [], []
    index: dict[Place, int] = {}
    for ref in views:
        if "views" not in store.manifest(ref).tables:
            continue
        names = ["sequence_id", "frame", "hypothesis", "direction", "weight", "trust", "metres_per_pixel"]
        table = store.read(ref, "views", columns=names)
        sequence, frame, hypothesis, direction, weight, trust, scale = (table[name] for name in names)
        for row in np.flatnonzero(np.asarray(hypothesis) < num_hypotheses).tolist():
            place = (str(sequence[row]), int(frame[row]))
            people = keypoints.get(place, {})
            if len(people) < 2:
                continue
            pairs.append(first_two(people))
            scales.append(scale[row])
            directions.append(direction[row])
            weights.append(float(weight[row]) * float(trust[row]))
            which.append(index.setdefault(place, len(index)))
    if not pairs:
        raise InputError("no annotated pair has a view: this needs annotations of two people")
    gathered = gather_pairs(
        np.array(pairs), np.array(scales), np.array(directions), np.array(weights), np.array(which, dtype=np.int64)
    )
    num_skipped = gathered.num_skipped + sum(1 for place in keypoints if place not in index)
    return PlacedPairs(gathered=replace(gathered, num_skipped=num_skipped), places=tuple(index), frames=frames)


def gather_tracks(placed: PlacedPairs) -> np.ndarray:
    """Return the frames round every entry in metres, (entry, frame, 2, 17, 2), as `annotation_speeds` takes them.

    Frames without either of the two people are NaN.
    """
    seen = placed.frames
    around = range(-NEIGHBOUR_FRAMES, NEIGHBOUR_FRAMES + 1)
    tracks = np.full((len(placed.places), len(around), 2, PAIR17.num_joints, 2), np.nan)
    for place, (sequence, frame) in enumerate(placed.places):
        people = sorted(seen[sequence, frame])[:2]
        for column, offset in enumerate(around):
            there = seen.get((sequence, frame + offset), {})
            for person, name in enumerate(people):
                if name in there:
                    tracks[place, column, person] = there[name]
    own = tracks[placed.gathered.pairs.annotation_index]
    return pair_in_metres(own, placed.gathered.metres_per_pixel[:, None])
