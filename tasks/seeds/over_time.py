"""Lifting of annotated pairs of a video together, for the stages `seeds` and `lifting`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

import numpy as np

from pasdedeux.reconstruction.annotated import MIN_FRAMES, lift_over_time
from pasdedeux.reconstruction.sequence import SearchedDatabase, StatedCamera
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Store
from tasks.reconstruction import read_tracks
from tasks.rows.annotated_pairs import PairPlace
from tasks.stage.facts import SequenceFacts

NUM_OVER_TIME = 60
"""Number of annotated frames of a video, evenly spread, that help to estimate the camera's place and people's sizes."""
_VIDEO = ("video", "given")
"""Purposes of annotations whose frames may follow each other."""


def is_video(facts: SequenceFacts) -> bool:
    """Tell whether frames of some of these sequences follow each other in time."""
    return facts.purpose in _VIDEO and len(facts.why_no_video) < max(len(facts.sequence_ids), 1)


def places_by_couple(facts: SequenceFacts, places: Iterable[PairPlace]) -> dict[PairPlace, list[PairPlace]]:
    """Return the places of each couple in a video among these of an artifact; a couple is named by its frame 0."""
    couples: dict[PairPlace, list[PairPlace]] = {}
    for place in places:
        if facts.purpose in _VIDEO and place.sequence_id not in facts.why_no_video:
            couples.setdefault(place._replace(frame=0), []).append(place)
    return couples


def lift_couple(
    store: Store,
    ref: ArtifactRef,
    places: list[PairPlace],
    wanted: Collection[PairPlace],
    database: Callable[[], SearchedDatabase],
) -> dict[PairPlace, tuple[np.ndarray, float]]:
    """Return two people (2, 14, 3), camera axes, metres, at the wanted places of a couple, and their expected error.

    They are reconstructed with other frames as one video. The result is empty if these are too few or a person cannot
    be reconstructed; then the database is not made.
    """
    wanted_places = [place for place in places if place in wanted]
    if len(places) < MIN_FRAMES or not wanted_places:
        return {}
    couple, stated = places[0], SequenceFacts.of(store.manifest(ref))
    tracks = {track.person_id: track for track in read_tracks(store, ref, couple.sequence_id)[0]}
    if not {couple.person_id, couple.partner_id} <= set(tracks):
        return {}
    both = [tracks[couple.person_id], tracks[couple.partner_id]]
    chosen = sorted({places[at] for at in evenly_spread(len(places), NUM_OVER_TIME)}.union(wanted_places))
    camera, frames = StatedCamera(height_m=stated.camera_height_m), np.array([place.frame for place in chosen])
    lifted = lift_over_time(both, frames, database(), camera, stated.statures_m)
    if lifted is None:
        return {}
    return {place: (people_m, float(error)) for place, people_m, error in zip(chosen, *lifted, strict=True)}
