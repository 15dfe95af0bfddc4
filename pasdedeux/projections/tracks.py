"""Rows of annotations to tracks: one person's keypoints over every frame from first to last, gaps kept as not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.projections.reconstruct import Lens, Track
from pasdedeux.skeletons import OP14

__all__ = ["PersonTrack", "rate_from_times", "tracks_from_rows", "why_no_video"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


_SHORT_SPAN = 1000
"""Up to so many frames gaps cost nothing, so any are bridged."""
_LEAST_SHARE_SEEN = 0.05
"""Of a longer sequence at least this share of the frames has people in it, or it is no video."""


@dataclass(frozen=True)
class PersonTrack:
    """A person's track and where it lies in its sequence.

    Args:
        person_id: Person in the sequence.
        first_frame: Frame of the sequence that the track begins with.
        first_time_s: Time of that frame.
        track: The keypoints.
    """

    person_id: int
    first_frame: int
    first_time_s: float
    track: Track

    @property
    def frames(self) -> Integers:
        """Frames of the sequence (frame,)."""
        return self.first_frame + np.arange(len(self.track.keypoints_px))

    @property
    def times_s(self) -> Array:
        """Times (frame,)."""
        return np.asarray(self.first_time_s + np.arange(len(self.track.keypoints_px)) / self.track.rate_hz)


def why_no_video(frame: Integers) -> str:
    """Say why frame numbers are not those of a video: single images, numbered by their ids or the time; else nothing.

    The gaps of such a sequence have no motion to bridge them, and there may be millions of frames of them.
    """
    numbers = np.unique(frame)
    span = int(numbers[-1] - numbers[0]) + 1 if len(numbers) else 0
    if span <= _SHORT_SPAN or len(numbers) >= _LEAST_SHARE_SEEN * span:
        return ""
    return f"{len(numbers):,} frames spread over {span:,} are single images, not a video"


def rate_from_times(frame: Integers, time_s: Array) -> float:
    """Give the frames per second of rows with these frame numbers and times; gaps in the numbers do not matter.

    Raises:
        InputError: The times do not grow with the frames, so there is no rate.
    """
    numbers, first = np.unique(frame, return_index=True)
    if len(numbers) < 2:
        return 1.0
    steps = np.diff(time_s[first]) / np.diff(numbers)
    step = float(np.median(steps))
    if not (np.isfinite(step) and step > 0):
        raise InputError(f"the times of the annotations do not grow with the frames (median step {step} s)")
    return 1.0 / step


def tracks_from_rows(
    frame: Integers,
    person_id: Integers,
    time_s: Array,
    keypoints_px: Array,
    confidence: Array,
    *,
    width_px: int | None,
    height_px: int | None,
) -> list[PersonTrack]:
    """Give the tracks of one sequence, by person id.

    Args:
        frame: Frame of each row (row,).
        person_id: Person of each row (row,).
        time_s: Time of each row (row,), seconds.
        keypoints_px: op14 keypoints (row, 14, 2), pixels, y down; NaN where not seen.
        confidence: (row, 14), 0 where not seen.
        width_px: Width of the image, None when unknown.
        height_px: Height of the image, None when unknown.

    Raises:
        InputError: A person twice in a frame, or times that do not grow.
    """
    if len(frame) == 0:
        return []
    rate_hz = rate_from_times(frame, time_s)
    lens = Lens.assumed(width_px, height_px, keypoints_px)
    tracks = []
    for person in np.unique(person_id):
        rows = np.flatnonzero(person_id == person)
        at = frame[rows]
        if len(np.unique(at)) != len(at):
            raise InputError(f"person {int(person)} is annotated twice in one frame")
        first = int(at.min())
        count = int(at.max()) - first + 1
        points = np.full((count, OP14.num_joints, 2), np.nan)
        seen = np.zeros((count, OP14.num_joints))
        points[at - first] = keypoints_px[rows]
        seen[at - first] = confidence[rows]
        start = float(time_s[rows[np.argmin(at)]])
        tracks.append(PersonTrack(int(person), first, start, Track(points, seen, rate_hz, lens)))
    return tracks
