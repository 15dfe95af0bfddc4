"""Reconstruct the people of a video from their tracks, and judge the result: the entry of commands and stages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Integers
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import Clusters
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.pitch import PitchEstimate, choose_pitch
from pasdedeux.reconstruction.reliability import Judged, judge_tracks, left_out_misfit_m
from pasdedeux.reconstruction.tracks import Track

_MAX_PROJECTIONS = 1_000_000
"""Largest number of projections, evenly chosen, by which a pitch is judged."""


@dataclass(frozen=True)
class SearchedDatabase:
    """The poses that people of videos are matched to, with their takes and pairs.

    Args:
        poses: The poses before a level camera.
        pitches_rad: Pitches to try for a camera; a single one counts as stated.
        take_ids: Take of each pose (row,); motions of one take are left out together.
        take_frames: Its frame in the take (row,).
        pairs_m: Pairs of people (row, person=2, 14, 3), as `pairs.centre_pairs` gives them; None for no pairs.
        clusters: Clusters of the database, for the method `published`.
        ready: Searchers at these pitches, if they are already built.
    """

    poses: Database
    pitches_rad: tuple[float, ...]
    take_ids: npt.NDArray[np.object_]
    take_frames: Integers
    pairs_m: npt.NDArray[np.floating] | None = None
    clusters: Clusters | None = None
    ready: tuple[Searcher, ...] = ()

    def searcher(self, pitch_rad: float) -> Searcher:
        """Build the searcher of a camera of this pitch."""
        return Searcher.of(self._before(pitch_rad), self.clusters)

    def searchers_tried(self) -> Iterable[Searcher]:
        """Yield a searcher for each pitch to try; build them one at a time unless they are `ready`."""
        return self.ready or (
            Searcher.of(self._before(pitch_rad).thinned(_MAX_PROJECTIONS)) for pitch_rad in self.pitches_rad
        )

    def _before(self, pitch_rad: float) -> Database:
        return replace(self.poses, camera=replace(self.poses.camera, pitch_rad=pitch_rad))


@dataclass(frozen=True)
class StatedCamera:
    """Facts that the user stated about the camera of a video.

    Args:
        pitch_rad: Its pitch, downwards; estimated if not given.
        height_m: Its height over the floor; estimated if not given.
    """

    pitch_rad: float | None = None
    height_m: float | None = None


@dataclass(frozen=True)
class Reconstruction:
    """The motion of the people of a video, and how reliable it is.

    Args:
        people: The people by every method, and their camera.
        judged: Verdicts on people and couples.
    """

    people: ReconstructedPeople
    judged: Judged


def reconstruct_sequence(
    tracks: Sequence[Track],
    database: SearchedDatabase,
    camera: StatedCamera | None = None,
    options: SequenceOptions | None = None,
    *,
    sequence_id: str = "",
    on_step: Callable[[], None] = lambda: None,
) -> Reconstruction:
    """Reconstruct the people of a video.

    Args:
        tracks: Tracks of people whose identities are resolved, at least one.
        database: Poses to match, without the takes that the video shows.
        camera: Stated facts about the camera.
        options: Methods, clean-up and statures.
        sequence_id: Name of the video, for rows of the table of people in verdicts.
        on_step: Called after the pitch is chosen, after each track is matched, and after each method.

    Raises:
        InputError: The height of the camera is not above 0, or the method `published` has no clusters.
    """
    camera, options = camera or StatedCamera(), options or SequenceOptions()
    tried_rad = database.pitches_rad if camera.pitch_rad is None else (camera.pitch_rad,)
    pitch = PitchEstimate(tried_rad[0]) if len(tried_rad) == 1 else choose_pitch(database.searchers_tried(), tracks)
    on_step()
    searcher = database.searcher(pitch.pitch_rad)
    people = reconstruct_people(
        searcher,
        tracks,
        options,
        pitch=pitch,
        camera_height_m=camera.height_m,
        pairs_m=database.pairs_m if len(tracks) > 1 else None,
        on_step=on_step,
    )
    left_out_m = left_out_misfit_m(searcher.database, searcher.index, database.take_ids)
    judged = judge_tracks(people, left_out_m, sequence_id=sequence_id, pitches_rad=tried_rad)
    return Reconstruction(people, judged)
