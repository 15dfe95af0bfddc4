"""From the detections of a whole video to one motion per person: follow, repair, reconstruct, clean up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics import Motion
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.projections.cleanup import clean_reconstruction
from pasdedeux.projections.faults import repair_tracks
from pasdedeux.projections.identity import follow_people
from pasdedeux.projections.motion_out import upright_motion
from pasdedeux.projections.reconstruct import (
    Method,
    Reconstruction,
    ReconstructionOptions,
    Searcher,
    choose_pitch,
    floor_offset,
    match_track,
    reconstruct_track,
)
from pasdedeux.projections.tracks import PersonTrack, tracks_from_rows

__all__ = ["ReconstructedCrowd", "ReconstructedPerson", "reconstruct_detections"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


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
        searchers: Databases made ready, one per pitch of an orthographic camera; the one that fits best is used.
        frame: Frame of each detection (row,).
        keypoints_px: op14 keypoints (row, 14, 2), pixels, y down; people of a frame in any order.
        confidence: (row, 14).
        rate_hz: Frames per second.
        image_size_px: Width and height where known.
        method: How.
        options: How.
        has_clean_up: Planted feet are stilled and the floor is kept.

    Raises:
        InputError: Nobody can be reconstructed (says why), or a searcher's camera is not orthographic.
    """
    options = options or ReconstructionOptions()
    followed = follow_people(frame, keypoints_px, confidence, rate_hz=rate_hz)
    rows = followed.track_id >= 0
    width, height = image_size_px or (None, None)
    tracks = tracks_from_rows(
        frame[rows],
        followed.track_id[rows],
        frame[rows] / rate_hz,
        followed.keypoints_px[rows],
        followed.confidence[rows],
        width_px=width,
        height_px=height,
    )
    tracks, num_repaired = repair_tracks(tracks)
    if not tracks:
        raise InputError("no frame shows enough joints of a person; there is nothing to reconstruct")
    chosen = choose_pitch(searchers, [one.track for one in tracks], options)
    camera = searchers[chosen].database.camera
    if not isinstance(camera, OrthographicCamera):
        raise InputError(f"reconstruction needs a database of an orthographic camera, this one has {camera}")
    skipped: dict[int, str] = {}
    found: list[tuple[PersonTrack, Reconstruction]] = []
    for one in tracks:
        try:
            matches = match_track(searchers[chosen], one.track, options)
        except InputError as error:
            skipped[one.person_id] = str(error)
            continue
        found.append((one, reconstruct_track(searchers[chosen], one.track, method, options, matches=matches)))
    if not found:
        raise InputError(f"nobody can be reconstructed: {next(iter(skipped.values()))}")
    origin = floor_offset([reconstruction for _, reconstruction in found], camera)
    people = []
    for tracked, reconstruction in found:
        if has_clean_up:
            reconstruction = clean_reconstruction(reconstruction, origin, camera, rate_hz=rate_hz)
        motion = upright_motion(reconstruction.positions_m - origin, camera, rate_hz=rate_hz)
        people.append(ReconstructedPerson(tracked, reconstruction, motion))
    return ReconstructedCrowd(tuple(people), skipped, chosen, followed.num_merged, followed.num_ghosts, num_repaired)
