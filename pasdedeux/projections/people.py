"""From the people of a whole video to their motions: follow, repair, reconstruct, put into one frame, clean up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics import Motion
from pasdedeux.projections.cleanup import clean_reconstruction
from pasdedeux.projections.faults import repair_tracks
from pasdedeux.projections.identity import follow_people
from pasdedeux.projections.motion_out import upright_motion
from pasdedeux.projections.pitch import choose_pitch, floor_offset
from pasdedeux.projections.reconstruct import (
    Method,
    Reconstruction,
    ReconstructionOptions,
    Searcher,
    match_track,
    reconstruct_track,
)
from pasdedeux.projections.tracks import PersonTrack, rate_from_times, tracks_from_rows

__all__ = [
    "FollowedTracks",
    "MethodMotions",
    "ReconstructedCrowd",
    "ReconstructedPerson",
    "ReconstructedTracks",
    "follow_and_repair",
    "reconstruct_detections",
    "reconstruct_people",
]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FollowedTracks:
    """The people of a sequence, followed and repaired.

    Args:
        tracks: By person id.
        num_merged_rows: Doubled detections that were merged.
        num_ghost_rows: Detections that were dropped.
        num_repaired_joints: Joints that were put right or masked.
    """

    tracks: list[PersonTrack]
    num_merged_rows: int
    num_ghost_rows: int
    num_repaired_joints: int


@dataclass(frozen=True)
class MethodMotions:
    """What one method made of a sequence's people.

    Args:
        name: The method; `<method>_clean` after the clean-up.
        people: Their tracks and reconstructions, camera axes.
        origin_m: What to subtract (3,) to have all of them in the sequence's own frame, see `floor_offset`.
    """

    name: str
    people: tuple[tuple[PersonTrack, Reconstruction], ...]
    origin_m: Array


@dataclass(frozen=True)
class ReconstructedTracks:
    """What all methods made of a sequence's people.

    Args:
        methods: In the order asked for; the clean-up of the last one comes last.  None when nobody could be searched.
        motions: Upright motions of the last by person id, floor at 0.
        skipped: Why the others could not be reconstructed, by person id.
        searcher_index: Which of the databases' cameras suited best.
    """

    methods: tuple[MethodMotions, ...]
    motions: dict[int, Motion]
    skipped: dict[int, str]
    searcher_index: int


@dataclass(frozen=True)
class ReconstructedPerson:
    """One person.

    Args:
        tracked: The keypoints that were used, after repair.
        found: The reconstruction, camera axes.
        motion: The motion in the sequence's common frame, upright, floor at 0.
    """

    tracked: PersonTrack
    found: Reconstruction
    motion: Motion


@dataclass(frozen=True)
class ReconstructedCrowd:
    """The people of a video.

    Args:
        people: By person id.
        skipped: Why the others could not be reconstructed, by person id.
        searcher_index: Which of the databases' cameras fitted best.
        num_merged_rows: Doubled detections that were merged.
        num_ghost_rows: Detections that were dropped.
        num_repaired_joints: Joints that were put right or masked.
    """

    people: tuple[ReconstructedPerson, ...]
    skipped: dict[int, str]
    searcher_index: int
    num_merged_rows: int
    num_ghost_rows: int
    num_repaired_joints: int


def follow_and_repair(
    frame: Integers,
    time_s: Array,
    keypoints_px: Array,
    confidence: Array,
    *,
    person_id: Integers | None = None,
    image_size_px: tuple[int, int] | None = None,
    has_repair: bool = True,
) -> FollowedTracks:
    """Give the tracks of a sequence's people: who is who, then swapped sides, exchanged limbs and wild keypoints.

    Args:
        frame: Frame of each detection (row,).
        time_s: Its time (row,).
        keypoints_px: op14 keypoints (row, 14, 2), pixels, y down; NaN where not seen.
        confidence: (row, 14), 0 where not seen.
        person_id: Person of each detection (row,) where that is known; they are followed otherwise.
        image_size_px: Width and height where known.
        has_repair: Faults are put right or left out.

    Raises:
        InputError: A person twice in a frame, or times that do not grow.
    """
    merged = ghosts = repaired = 0
    if person_id is None:
        followed = follow_people(frame, keypoints_px, confidence, rate_hz=rate_from_times(frame, time_s))
        merged, ghosts = followed.num_merged, followed.num_ghosts
        kept = followed.track_id >= 0
        frame, time_s, person_id = frame[kept], time_s[kept], followed.track_id[kept]
        keypoints_px, confidence = followed.keypoints_px[kept], followed.confidence[kept]
    width, height = image_size_px or (None, None)
    tracks = tracks_from_rows(frame, person_id, time_s, keypoints_px, confidence, width_px=width, height_px=height)
    if has_repair:
        tracks, repaired = repair_tracks(tracks)
    return FollowedTracks(tracks, merged, ghosts, repaired)


def reconstruct_people(
    searchers: Sequence[Searcher],
    people: Sequence[PersonTrack],
    methods: Sequence[Method],
    options: ReconstructionOptions | None = None,
    *,
    has_clean_up: bool = True,
) -> ReconstructedTracks:
    """Reconstruct tracks of one sequence: one pitch for all, each by every method, all in one frame, cleaned up.

    Args:
        searchers: Databases made ready, one per camera; the one that suits best is used.
        people: Tracks, repaired as far as they can be.
        methods: Methods; the last one is cleaned up and gives the motions.
        options: How.
        has_clean_up: Planted feet are stilled and the floor is kept.
    """
    options = options or ReconstructionOptions()
    chosen = choose_pitch(searchers, [one.track for one in people], options) if len(searchers) > 1 else 0
    searcher, camera = searchers[chosen], searchers[chosen].database.camera
    skipped: dict[int, str] = {}
    matched = []
    for person in people:
        try:
            matched.append((person, match_track(searcher, person.track, options)))
        except InputError as error:
            skipped[person.person_id] = str(error)
    made = []
    for method in methods if matched else ():
        found = tuple(
            (person, reconstruct_track(searcher, person.track, method, options, matches=matches))
            for person, matches in matched
        )
        made.append(MethodMotions(method.value, found, floor_offset([one for _, one in found], camera)))
    if made and has_clean_up:
        last = made[-1]
        cleaned = tuple(
            (person, clean_reconstruction(one, last.origin_m, camera, rate_hz=person.track.rate_hz))
            for person, one in last.people
        )
        made.append(MethodMotions(f"{last.name}_clean", cleaned, last.origin_m))
    motions = {
        person.person_id: upright_motion(one.positions_m - made[-1].origin_m, camera, rate_hz=person.track.rate_hz)
        for person, one in (made[-1].people if made else ())
    }
    return ReconstructedTracks(tuple(made), motions, skipped, chosen)


def reconstruct_detections(
    searchers: Sequence[Searcher],
    frame: Integers,
    keypoints_px: Array,
    confidence: Array,
    *,
    rate_hz: float,
    image_size_px: tuple[int, int] | None = None,
    method: Method = Method.FIT,
    options: ReconstructionOptions | None = None,
    has_clean_up: bool = True,
) -> ReconstructedCrowd:
    """Reconstruct the people of a video.

    Args:
        searchers: Databases made ready, one per camera; the one that fits best is used.
        frame: Frame of each detection (row,).
        keypoints_px: op14 keypoints (row, 14, 2), pixels, y down; people of a frame in any order.
        confidence: (row, 14).
        rate_hz: Frames per second.
        image_size_px: Width and height where known.
        method: How.
        options: How.
        has_clean_up: Planted feet are stilled and the floor is kept.

    Raises:
        InputError: Nobody can be reconstructed (says why).
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"the frame rate is {rate_hz}, it must be positive")
    followed = follow_and_repair(frame, frame / rate_hz, keypoints_px, confidence, image_size_px=image_size_px)
    tracks = followed.tracks
    if not tracks:
        raise InputError("no frame shows enough joints of a person; there is nothing to reconstruct")
    found = reconstruct_people(searchers, tracks, [method], options, has_clean_up=has_clean_up)
    if not found.methods:
        raise InputError(f"nobody can be reconstructed: {next(iter(found.skipped.values()))}")
    people = tuple(
        ReconstructedPerson(tracked, reconstruction, found.motions[tracked.person_id])
        for tracked, reconstruction in found.methods[-1].people
    )
    return ReconstructedCrowd(
        people,
        found.skipped,
        found.searcher_index,
        followed.num_merged_rows,
        followed.num_ghost_rows,
        followed.num_repaired_joints,
    )
