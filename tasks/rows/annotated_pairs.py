"""Annotated pairs with their views, as `seeds` and `chains` read them from the store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.sampling.annotations import GatheredPairs, gather_pairs
from pasdedeux.sampling.bandwidth import SAME_MOMENT
from pasdedeux.sampling.speeds import NEIGHBOUR_FRAMES
from pasdedeux.skeletons import COUNTED17, PAIR17
from storage_schema import ArtifactRef, Manifest, Store, TableData
from tasks.stage import Shard, StageInputs
from tasks.stage.facts import SequenceFacts


class PairPlace(NamedTuple):
    """Identity of an annotated pair: a sequence may show several couples in one frame."""

    sequence_id: str
    frame: int
    person_id: int
    """The smaller id of both people, person A."""
    partner_id: int


PLACE_COLUMNS = PairPlace._fields
MIN_SEEN = 10
"""Joints of the two people, of 28, that an annotation must show to be lifted."""
People = dict[int, np.ndarray]
"""Joints of a pair in a frame, or of the only partner in it, (17, 2), pixels, by person id."""


@dataclass(frozen=True)
class PlacedPairs:
    """Annotated pairs, the place of each by `annotation_index`, and the pair in every frame that was read.

    `stills` are the sequences whose frames do not follow each other in time, whatever their numbers say.
    """

    gathered: GatheredPairs
    places: tuple[PairPlace, ...]
    frames: Mapping[PairPlace, People]
    stills: frozenset[str] = frozenset()


@dataclass(frozen=True)
class SeenPair:
    """One annotated pair in metres (2, 17, 2), NaN where not seen, with its views (hypothesis, 3), likeliest first.

    No draws are made from a pair that `is_left_out`.
    """

    place: PairPlace
    image_m: np.ndarray
    directions: np.ndarray
    hypotheses: np.ndarray
    is_left_out: bool

    @property
    def is_seen(self) -> np.ndarray:
        """Which joints are seen, (2, 17)."""
        return np.asarray(np.isfinite(self.image_m).all(axis=-1))

    @property
    def num_seen(self) -> int:
        """How many joints are seen, of the 28 that are no means of others."""
        return int(self.is_seen[:, COUNTED17].sum())


def annotated_pairs(inputs: StageInputs) -> list[Manifest]:
    """Return the annotations of pairs that may be learned from: single pairs from random views and given ones first."""
    sequences = [(SequenceFacts.of(manifest), manifest) for manifest in inputs.of("annotations")]
    usable = [(facts, manifest) for facts, manifest in sequences if not facts.is_held_out and facts.num_persons >= 2]
    preferred = [manifest for facts, manifest in usable if facts.purpose in ("random_views", "given")]
    return preferred or [manifest for _, manifest in usable]


def views_of(annotated: Sequence[Manifest], inputs: StageInputs) -> list[Manifest]:
    """Return the views that were estimated from these annotations."""
    seen = {manifest.ref for manifest in annotated}
    return [manifest for manifest in inputs.of("views") if seen.intersection(manifest.inputs)]


def with_views(annotated: Sequence[Manifest], inputs: StageInputs) -> dict[str, list[Manifest]]:
    """Return, as `annotations`, the manifests that views were estimated from, and as `views` those views."""
    views = [(manifest, found_views[0]) for manifest in annotated if (found_views := views_of([manifest], inputs))]
    return {"annotations": [manifest for manifest, _ in views], "views": [found_views for _, found_views in views]}


def place_of(table: TableData, row: int) -> PairPlace:
    """Return the pair that a row of `views` or `lifted_pairs` describes."""
    sequence, frame, person, partner = (table[name][row] for name in PLACE_COLUMNS)
    return PairPlace(str(sequence), int(frame), int(person), int(partner))


def place_columns(places: Iterable[PairPlace]) -> dict[str, list[Any]]:
    """Return the columns that identify the pair of each row."""
    listed = list(places)
    return {name: [place[at] for place in listed] for at, name in enumerate(PLACE_COLUMNS)}


def annotation_columns(places: Sequence[PairPlace | None]) -> dict[str, list[Any]]:
    """Return the columns of `draws` and `seeds` that name the annotation of each row; null where it has none."""
    return {
        "sequence_id": [place and place.sequence_id for place in places],
        "sequence_frame": [place and place.frame for place in places],
        "sequence_person_id": [place and place.person_id for place in places],
    }


def pairs_by_place(table: TableData, is_wanted: np.ndarray) -> dict[PairPlace, dict[int, int]]:
    """Return the rows of every pair by person id, of the wanted rows (row,) of `annotations`.

    A pair whose partner is absent has one row; a frame where nobody has a partner comes once, without rows.
    """
    sequences, frames, persons = table["sequence_id"], table["frame"], table["person_id"]
    partners, is_alone = table["partner_id"], table.is_null("partner_id")
    pairs: dict[PairPlace, dict[int, int]] = {}
    alone: dict[tuple[str, int], PairPlace] = {}
    for row in np.flatnonzero(is_wanted).tolist():
        sequence, frame, person = str(sequences[row]), int(frames[row]), int(persons[row])
        if is_alone[row]:
            alone.setdefault((sequence, frame), PairPlace(sequence, frame, person, person))
        else:
            first, second = sorted((person, int(partners[row])))
            pairs.setdefault(PairPlace(sequence, frame, first, second), {})[person] = row
    with_pair = {(place.sequence_id, place.frame) for place in pairs}
    return pairs | {place: {} for frame, place in alone.items() if frame not in with_pair}


def read_pair_points(
    store: Store, refs: Iterable[ArtifactRef], *, is_between: bool = False, with_held_out: bool = False
) -> dict[PairPlace, People]:
    """Return the joints (17, 2), pixels, of every pair in every frame by person id.

    Args:
        store: Store.
        refs: Artifacts with `annotations`; others are ignored.
        is_between: Include frames that only serve to estimate velocity.
        with_held_out: Include held-out annotations.
    """
    names = ["sequence_id", "frame", "person_id", "partner_id", "is_key", "is_held_out", "pair17_px"]
    people: dict[PairPlace, People] = {}
    for ref in refs:
        if "annotations" not in store.manifest(ref).tables:
            continue
        table = store.read(ref, "annotations", columns=names)
        points = np.asarray(table["pair17_px"], dtype=np.float64)
        is_wanted = (np.asarray(table["is_key"]) | is_between) & (~np.asarray(table["is_held_out"]) | with_held_out)
        for place, rows in pairs_by_place(table, is_wanted).items():
            people.setdefault(place, {}).update({person: points[row] for person, row in rows.items()})
    return people


def read_seen_pairs(
    store: Store,
    annotations: ArtifactRef,
    views: ArtifactRef,
    *,
    num_hypotheses: int,
    instead: Mapping[tuple[str, int], np.ndarray] | None = None,
) -> tuple[dict[PairPlace, SeenPair], int]:
    """Return the annotated pairs with enough joints and a view, in order, and the number of others.

    `instead` replaces annotated joints: joints (2, 17, 2), pixels, by sequence and frame.
    """
    people = read_pair_points(store, [annotations], with_held_out=True)
    learned = read_pair_points(store, [annotations])
    names = ["hypothesis", "direction", "weight", "metres_per_pixel"]
    table = store.read(views, "views", columns=[*PLACE_COLUMNS, *names])
    hypothesis, direction, weight, scale = (np.asarray(table[name]) for name in names)
    likeliest: dict[PairPlace, list[int]] = {}
    for row in np.lexsort((hypothesis, -weight)).tolist():
        likeliest.setdefault(place_of(table, row), []).append(row)
    pairs: dict[PairPlace, SeenPair] = {}
    for place in sorted(people):
        rows = likeliest.get(place, [])[:num_hypotheses]
        if len(people[place]) < 2 or not rows:
            continue
        pair_px = (instead or {}).get(place[:2], pair_of(people[place]))
        image = pair_in_metres(pair_px, np.asarray(scale[rows[0]], dtype=np.float64))
        directions = np.asarray(direction, dtype=np.float64)[rows]
        seen_pair = SeenPair(place, image, directions, hypothesis[rows], place not in learned)
        if seen_pair.num_seen >= MIN_SEEN:
            pairs[place] = seen_pair
    return pairs, len(people) - len(pairs)


def read_all_seen(store: Store, shard: Shard, *, num_hypotheses: int) -> list[dict[PairPlace, SeenPair]]:
    """Call `read_seen_pairs` for each artifact that `with_views` gave a shard."""
    return [
        read_seen_pairs(store, annotations, views, num_hypotheses=num_hypotheses)[0]
        for annotations, views in zip(shard.refs("annotations"), shard.refs("views"), strict=True)
    ]


def pair_of(people: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the joints (2, 17, 2) of two people, the smaller id first."""
    return np.stack([people[person] for person in sorted(people)])


def gather(
    store: Store, *, annotations: Sequence[ArtifactRef], views: Sequence[ArtifactRef], num_hypotheses: int
) -> PlacedPairs:
    """Return every annotated pair with its likeliest view hypotheses; annotations without both are skipped.

    Raises:
        InputError: No annotated pair has a view.
    """
    keypoints, frames = read_pair_points(store, annotations), read_pair_points(store, annotations, is_between=True)
    pairs, scales, directions, weights, which = [], [], [], [], []
    index: dict[PairPlace, int] = {}
    for ref in views:
        if "views" not in store.manifest(ref).tables:
            continue
        names = ["hypothesis", "direction", "weight", "trust", "metres_per_pixel"]
        table = store.read(ref, "views", columns=[*PLACE_COLUMNS, *names])
        hypothesis, direction, weight, trust, scale = (table[name] for name in names)
        for row in np.flatnonzero(np.asarray(hypothesis) < num_hypotheses).tolist():
            place = place_of(table, row)
            people = keypoints.get(place, {})
            if len(people) < 2:
                continue
            pairs.append(pair_of(people))
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
    stills = frozenset(name for ref in annotations for name in SequenceFacts.of(store.manifest(ref)).why_no_video)
    return PlacedPairs(
        gathered=replace(gathered, num_skipped=num_skipped, moment=_moments(list(index), stills)),
        places=tuple(index),
        frames=frames,
        stills=stills,
    )


def _moments(places: Sequence[PairPlace], stills: frozenset[str]) -> np.ndarray:
    """Return the time of each pair, in frames; different videos, and different stills, are kept far apart."""
    numbers = {name: at for at, name in enumerate(sorted({place.sequence_id for place in places}))}
    apart = [SAME_MOMENT if place.sequence_id in stills else 1 for place in places]
    frames = np.array([place.frame * each for place, each in zip(places, apart, strict=True)], dtype=np.int64)
    videos = np.array([numbers[place.sequence_id] for place in places], dtype=np.int64)
    return frames + videos * (np.ptp(frames) + SAME_MOMENT)


def gather_tracks(placed: PlacedPairs) -> np.ndarray:
    """Return the frames round every entry in metres, (entry, frame, 2, 17, 2), as `annotation_speeds` takes them.

    Frames without either of the two people are NaN, and so are those beside an annotation that is a still.
    """
    seen = placed.frames
    around = range(-NEIGHBOUR_FRAMES, NEIGHBOUR_FRAMES + 1)
    tracks = np.full((len(placed.places), len(around), 2, PAIR17.num_joints, 2), np.nan)
    for number, place in enumerate(placed.places):
        for column, offset in enumerate(around):
            is_still = bool(offset) and place.sequence_id in placed.stills
            there = {} if is_still else seen.get(place._replace(frame=place.frame + offset), {})
            for person, name in enumerate((place.person_id, place.partner_id)):
                if name in there:
                    tracks[number, column, person] = there[name]
    tracks_here = tracks[placed.gathered.pairs.annotation_index]
    return pair_in_metres(tracks_here, placed.gathered.metres_per_pixel[:, None])
