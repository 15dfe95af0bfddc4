"""Tracks: the keypoints of one person in every frame from the first to the last, and the lens; gaps are not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError, check_positive
from pasdedeux.formats.poses2d.camera_motion import FOCAL_OVER_WIDTH
from pasdedeux.people.broken import find_breaks
from pasdedeux.people.video import rate_from_times
from pasdedeux.skeletons import OP14

TRACK_COLUMNS = (
    "frame",
    "person_id",
    "partner_id",
    "time_s",
    "op14_px",
    "op14_confidence",
    "image_width_px",
    "image_height_px",
    "focal_px",
)
"""Columns of the table of annotations from which tracks are made."""


@dataclass(frozen=True)
class Lens:
    """Focal length and principal point of a pinhole camera, pixels, y down; assumed if not known."""

    focal_px: float
    principal_point_px: tuple[float, float]
    is_known: bool = False

    @classmethod
    def assumed(
        cls, width_px: float | None, height_px: float | None, keypoints_px: Array, focal_px: float | None = None
    ) -> Lens:
        """Return the lens for this image size and focal length; without one, that of a common camera.

        An unknown image size is estimated from the keypoints.
        """
        if width_px is not None and height_px is not None:
            longer, middle = float(max(width_px, height_px)), (width_px / 2.0, height_px / 2.0)
        else:
            is_seen = np.isfinite(keypoints_px).all(axis=-1)
            seen = keypoints_px[is_seen] if is_seen.any() else np.zeros((1, 2))
            # Assume that people are near the middle of an image of 16:9.
            x, y = (float(value) for value in 0.5 * (seen.min(axis=0) + seen.max(axis=0)))
            longer, middle = 2.0 * max(x, 16.0 / 9.0 * y, 1.0), (x, y)
        return cls(focal_px or FOCAL_OVER_WIDTH * longer, middle, focal_px is not None)


@dataclass(frozen=True)
class Track:
    """Keypoints of one person over the frames of a sequence, with their frame numbers.

    Args:
        keypoints_px: op14 keypoints (frame, 14, 2), pixels as on disk (y down); NaN where not seen.
        confidence: (frame, 14), 0 where not seen.
        rate_hz: Frames per second.
        lens: The lens, where known.
        person_id: Person in the sequence.
        first_frame: Frame of the sequence at which the track begins.
        first_time_s: Time of that frame.
        partner_id: The partner of this person in the sequence; None for nobody.
    """

    keypoints_px: Array
    confidence: Array
    rate_hz: float
    lens: Lens
    person_id: int = 0
    first_frame: int = 0
    first_time_s: float = 0.0
    partner_id: int | None = None

    def __post_init__(self) -> None:
        """Check shapes; a joint without position gets confidence 0."""
        frames = len(self.keypoints_px)
        joints = OP14.num_joints
        if self.keypoints_px.shape != (frames, joints, 2) or self.confidence.shape != (frames, joints) or frames == 0:
            raise InputError(
                f"track: keypoints {self.keypoints_px.shape} and confidences {self.confidence.shape}; "
                f"expected (frames, {joints}, 2) and (frames, {joints}) with at least one frame"
            )
        check_positive(self.rate_hz, "track: the frame rate")
        confidence = np.where(np.isfinite(self.keypoints_px).all(axis=-1), np.nan_to_num(self.confidence), 0.0)
        if (confidence < 0).any():
            raise InputError("track: a confidence is negative; 0 means not seen")
        object.__setattr__(self, "confidence", confidence)

    @property
    def frames(self) -> Integers:
        """Frames of the sequence (frame,)."""
        return self.first_frame + np.arange(len(self.keypoints_px))

    def every(self, stride: int) -> Track:
        """Return every n-th frame."""
        return self.chosen(slice(None, None, stride), self.rate_hz / stride)

    def chosen(self, frames: Integers | slice, rate_hz: float) -> Track:
        """Return some frames, counted from the first, as a track of this rate."""
        return replace(
            self, keypoints_px=self.keypoints_px[frames], confidence=self.confidence[frames], rate_hz=rate_hz
        )

    @property
    def times_s(self) -> Array:
        """Times (frame,)."""
        return np.asarray(self.first_time_s + np.arange(len(self.keypoints_px)) / self.rate_hz)


def tracks_of(annotations: Mapping[str, Any], sequence_id: str) -> list[Track]:
    """Return the tracks of one sequence, by person id.

    Args:
        annotations: `sequence_id` and `TRACK_COLUMNS` of the table of annotations, by name; unknown numbers are NaN or
            None.
        sequence_id: The sequence.

    Raises:
        InputError: A person is annotated twice in one frame.
    """
    rows = np.flatnonzero(np.array(list(annotations["sequence_id"]), dtype=object) == sequence_id)
    if not len(rows):
        return []
    frame, person_id = (np.asarray(annotations[name])[rows] for name in ("frame", "person_id"))
    partner_id, time_s, keypoints_px, confidence, width_px, height_px, focal_px = (
        np.asarray(annotations[name], dtype=np.float64)[rows] for name in TRACK_COLUMNS[2:]
    )
    rate_hz = rate_from_times(frame, time_s)
    width, height, focal = (
        float(value[0]) if np.isfinite(value[0]) else None for value in (width_px, height_px, focal_px)
    )
    lens = Lens.assumed(width, height, keypoints_px, focal)
    tracks = []
    for person in np.unique(person_id):
        shown = np.flatnonzero(person_id == person)
        at = frame[shown]
        if len(np.unique(at)) != len(at):
            raise InputError(f"person {int(person)} is annotated twice in one frame")
        first = int(at.min())
        count = int(at.max()) - first + 1
        points = np.full((count, OP14.num_joints, 2), np.nan)
        seen = np.zeros((count, OP14.num_joints))
        points[at - first] = keypoints_px[shown]
        seen[at - first] = confidence[shown]
        start_s, partner = float(time_s[shown[np.argmin(at)]]), partner_id[shown[0]]
        partner = int(partner) if np.isfinite(partner) else None
        tracks.append(Track(points, seen, rate_hz, lens, int(person), first, start_s, partner))
    return tracks


def broken_doubts(sequence_id: str, tracks: Sequence[Track]) -> dict[int, str]:
    """Return warnings by person id: a track ends where another begins.

    Each shows the row of the table of people that joins them; it replaces the row of the person in those frames, see
    `people.decisions`.
    """
    if len(tracks) < 2:
        return {}
    breaks = find_breaks(
        np.concatenate([track.frames for track in tracks]),
        np.concatenate([np.full(len(track.frames), track.person_id) for track in tracks]),
        np.concatenate([track.keypoints_px for track in tracks]),
        np.concatenate([track.confidence for track in tracks]),
        rate_hz=tracks[0].rate_hz,
    )
    doubts: dict[int, str] = {}
    for gap in breaks:
        words = (
            f"{gap.before} ends where {gap.after} begins: the same person? "
            f"Then say so in the table of people: {gap.joined(sequence_id).in_words()}"
        )
        doubts |= {name: words for name in (gap.before, gap.after) if name not in doubts}
    return doubts
