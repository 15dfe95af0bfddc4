"""Annotated pairs with their views, as `seeds` and `chains` read them from the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.sampling.annotations import GatheredPairs, gather_pairs
from pasdedeux.sampling.velocity import NEIGHBOUR_FRAMES
from pasdedeux.skeletons import PAIR17
from storage_schema import Manifest, Store
from tasks.stage import Shard, StageInputs

__all__ = ["PlacedPairs", "annotated_pairs", "gather", "gather_tracks", "views_of"]


@dataclass(frozen=True)
class PlacedPairs:
    """Annotated pairs, and the sequence and frame of each annotation by `annotation_index`."""

    gathered: GatheredPairs
    places: tuple[tuple[str, int], ...]


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


def gather(shard: Shard, store: Store) -> PlacedPairs:
    """Return every annotated pair among the inputs with its view hypotheses; annotations without both are left out.

    Raises:
        InputError: No annotated pair has a view.
    """
    keypoints: dict[tuple[str, int], dict[int, np.ndarray]] = {}
    for ref in shard.inputs:
        if "annotations" not in store.manifest(ref).tables:
            continue
        table = store.read(
            ref, "annotations", columns=["sequence_id", "frame", "person_id", "is_key", "is_held_out", "pair17_px"]
        )
        is_wanted = np.asarray(table["is_key"]) & ~np.asarray(table["is_held_out"])
        sequences, frames, persons = table["sequence_id"], table["frame"], table["person_id"]
        points = np.asarray(table["pair17_px"], dtype=np.float64)
        for row in np.flatnonzero(is_wanted).tolist():
            keypoints.setdefault((str(sequences[row]), int(frames[row])), {})[int(persons[row])] = points[row]
    pairs, scales, directions, weights, which = [], [], [], [], []
    index: dict[tuple[str, int], int] = {}
    for ref in shard.inputs:
        if "views" not in store.manifest(ref).tables:
            continue
        names = ["sequence_id", "frame", "hypothesis", "direction", "weight", "trust", "metres_per_pixel"]
        table = store.read(ref, "views", columns=names)
        sequence, frame, hypothesis, direction, weight, trust, scale = (table[name] for name in names)
        for row in np.flatnonzero(np.asarray(hypothesis) < int(shard.parameters["num_hypotheses"])).tolist():
            place = (str(sequence[row]), int(frame[row]))
            people = keypoints.get(place, {})
            if len(people) < 2:
                continue
            first, second = sorted(people)[:2]
            pairs.append(np.stack([people[first], people[second]]))
            scales.append(scale[row])
            directions.append(direction[row])
            weights.append(float(weight[row]) * float(trust[row]))
            which.append(index.setdefault(place, len(index)))
    if not pairs:
        raise InputError("no annotated pair has a view: this needs annotations of two people")
    gathered = gather_pairs(
        np.array(pairs), np.array(scales), np.array(directions), np.array(weights), np.array(which, dtype=np.int64)
    )
    return PlacedPairs(
        gathered=GatheredPairs(
            pairs=gathered.pairs,
            weights=gathered.weights,
            num_skipped=gathered.num_skipped + sum(1 for place in keypoints if place not in index),
            metres_per_pixel=gathered.metres_per_pixel,
        ),
        places=tuple(index),
    )


def gather_tracks(shard: Shard, store: Store, placed: PlacedPairs) -> np.ndarray:
    """Return the frames round every entry in metres, (entry, frame, 2, 17, 2), as `annotation_speeds` takes them.

    Frames without either of the two people are NaN.
    """
    seen: dict[tuple[str, int], dict[int, np.ndarray]] = {}
    for ref in shard.inputs:
        if "annotations" not in store.manifest(ref).tables:
            continue
        table = store.read(
            ref, "annotations", columns=["sequence_id", "frame", "person_id", "is_held_out", "pair17_px"]
        )
        sequences, frames, persons = table["sequence_id"], table["frame"], table["person_id"]
        points = np.asarray(table["pair17_px"], dtype=np.float64)
        for row in np.flatnonzero(~np.asarray(table["is_held_out"])).tolist():
            seen.setdefault((str(sequences[row]), int(frames[row])), {})[int(persons[row])] = points[row]
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
