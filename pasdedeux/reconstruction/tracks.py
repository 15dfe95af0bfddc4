"""Tracks: one person's keypoints over every frame from first to last, gaps as not seen, and the lens that saw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError, check_positive
from pasdedeux.people.broken import find_breaks
from pasdedeux.people.video import rate_from_times
from pasdedeux.skeletons import OP14

_FOCAL_OVER_WIDTH = 0.72
"""Focal length over the longer side of the image where nobody knows better: a 26 mm phone lens on 36 mm film."""


@dataclass(frozen=True)
class Lens:
    """A pinhole as far as it is known: focal length and principal point, pixels, y down."""

    focal_px: float
    principal_point_px: tuple[float, float]
    is_known: bool = False

    @classmethod
    def assumed(
        cls, width_px: int | None, height_px: int | None, keypoints_px: Array, focal_px: float | None = None
    ) -> Lens:
        """Return the lens with this focal length, else of a common camera, for this image size.

        An unknown size is estimated from where keypoints lie.
        """
        if width_px is not None and height_px is not None:
            longer, middle = float(max(width_px, height_px)), (width_px / 2.0, height_px / 2.0)
        else:
            is_seen = np.isfinite(keypoints_px).all(axis=-1)
            seen = keypoints_px[is_seen] if is_seen.any() else np.zeros((1, 2))
            # People are filmed about the middle, and an image is about 16:9.
            x, y = (float(value) for value in 0.5 * (seen.min(axis=0) + seen.max(axis=0)))
            longer, middle = 2.0 * max(x, 16.0 / 9.0 * y, 1.0), (x, y)
        return cls(focal_px or _FOCAL_OVER_WIDTH * longer, middle, focal_px is not None)


@dataclass(frozen=True)
class Track:
    """One person's keypoints over the frames of a sequence, and where they lie in it.

    Args:
        keypoints_px: op14 keypoints (frame, 14, 2), pixels as on disk (y down); NaN where not seen.
        confidence: (frame, 14), 0 where not seen.
        rate_hz: Frames per second.
        lens: The camera as far as it is known.
        person_id: Person in the sequence.
        first_frame: Frame of the sequence that the track begins with.
        first_time_s: Time of that frame.
        partner_id: Person of the sequence that this one is paired with; None for nobody.
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

    @property
    def times_s(self) -> Array:
        """Times (frame,)."""
        return np.asarray(self.first_time_s + np.arange(len(self.keypoints_px)) / self.rate_hz)


def tracks_from_rows(
    frame: Integers,
    person_id: Integers,
    time_s: Array,
    keypoints_px: Array,
    confidence: Array,
    *,
    partner_id: Integers | None = None,
    width_px: int | None,
    height_px: int | None,
    focal_px: float | None = None,
) -> list[Track]:
    """Return the tracks of one sequence, by person id.

    Args:
        frame: Frame of each row (row,).
        person_id: Person of each row (row,).
        time_s: Time of each row (row,), seconds.
        keypoints_px: op14 keypoints (row, 14, 2), pixels, y down; NaN where not seen.
        confidence: (row, 14), 0 where not seen.
        partner_id: Partner of each row's person (row,), -1 for nobody; nobody has one where it is not given.
        width_px: Width of the image, None when unknown.
        height_px: Height of the image, None when unknown.
        focal_px: Focal length of the camera, None when unknown.
    """
    if len(frame) == 0:
        return []
    rate_hz = rate_from_times(frame, time_s)
    lens = Lens.assumed(width_px, height_px, keypoints_px, focal_px)
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
        partner = -1 if partner_id is None else int(partner_id[rows[0]])
        tracks.append(
            Track(points, seen, rate_hz, lens, int(person), first, start, partner_id=None if partner < 0 else partner)
        )
    return tracks


def broken_doubts(sequence_id: str, tracks: Sequence[Track]) -> dict[int, str]:
    """Return by person id that a track ends where another begins, and the row of the table of people that joins them.

    The row replaces that of the person in those frames, see `people.decisions`.
    """
    if len(tracks) < 2:
        return {}
    breaks = find_breaks(
        np.concatenate([one.frames for one in tracks]),
        np.concatenate([np.full(len(one.frames), one.person_id) for one in tracks]),
        np.concatenate([one.keypoints_px for one in tracks]),
        np.concatenate([one.confidence for one in tracks]),
        rate_hz=tracks[0].rate_hz,
    )
    doubts: dict[int, str] = {}
    for one in breaks:
        words = (
            f"{one.before} ends where {one.after} begins: the same person? "
            f"Then say so in the table of people: {one.joined(sequence_id).in_words()}"
        )
        doubts |= {name: words for name in (one.before, one.after) if name not in doubts}
    return doubts
