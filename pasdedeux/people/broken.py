"""Tracks that end where another begins: one person lost for a while, or two people.

They are one person if the second track begins soon after the first has ended, at the same place, with the same size and
motion, and no other track could be either of them.  Otherwise the user, who knows the video, is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.people.decisions import Decision
from pasdedeux.people.identity import body_size_px

_BROKEN_S, _BROKEN_SIZES, _BROKEN_GROWTH = 3.0, 0.6, 1.4
"""Limits for a possible break: time, distance in body sizes, and ratio of sizes."""
_CLEAR_SIZES, _CLEAR_GROWTH = 0.3, 1.2
"""Limits for a clear break: distance, also after extrapolation, in body sizes, and ratio of sizes."""
_END_S, _FADE_S = 0.2, 0.5
"""Duration that counts as the end of a track; time constant with which its speed fades."""


@dataclass(frozen=True)
class Break:
    """A track that ends where another begins.

    Args:
        before: Person whose track ends.
        after: Person whose track begins.
        first_frame: First frame of the latter.
        last_frame: Last frame of the latter.
        is_clear: Whether both are clearly one person.
    """

    before: int
    after: int
    first_frame: int
    last_frame: int
    is_clear: bool

    def joined(self, sequence_id: str) -> Decision:
        """Return the decision that joins them."""
        return Decision(sequence_id, self.first_frame, self.last_frame, self.after, self.before)


@dataclass(frozen=True)
class _TrackEnd:
    """Start or end of a track: frame, position (2,) and speed (2,) of the middle of the joints, and size, pixels."""

    frame: int
    place_px: Array
    speed_px_s: Array
    size_px: float


def find_breaks(
    frame: Integers, person_id: Integers, keypoints_px: Array, confidence: Array, *, rate_hz: float
) -> list[Break]:
    """Return the tracks that end where another begins; each is continued by at most one other, the nearest.

    Rows without keypoints have no position, but their person is present in the frame and cannot be another one in it.

    Args:
        frame: Frame of each row (row,).
        person_id: Person of each row (row,), once a frame.
        keypoints_px: (row, joint, 2), NaN where not seen.
        confidence: (row, joint), 0 where not seen.
        rate_hz: Frames per second.
    """
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    rows = np.flatnonzero(is_seen.any(axis=1))
    rows = rows[np.argsort(frame[rows], kind="stable")]
    ends: dict[int, tuple[_TrackEnd, _TrackEnd]] = {}
    spans: dict[int, tuple[int, int]] = {}
    for person in np.unique(person_id[rows]).tolist():
        own_rows, listed = rows[person_id[rows] == person], frame[person_id == person]
        spans[person] = int(listed.min()), int(listed.max())
        points = np.where(is_seen[own_rows, :, None], keypoints_px[own_rows], np.nan)
        parts = [abs(frame[own_rows] - frame[own_rows[at]]) <= _END_S * rate_hz for at in (0, -1)]
        first, last = (
            _end(frame[own_rows[part]], points[part], confidence[own_rows[part]], rate_hz, is_last=bool(at))
            for at, part in enumerate(parts)
        )
        ends[person] = first, last
    breaks = []
    for before, after in permutations(ends, 2):
        end, start = ends[before][1], ends[after][0]
        gap_s = (start.frame - end.frame) / rate_hz
        size = max(end.size_px, start.size_px)
        if spans[before][1] >= spans[after][0] or not 0.0 < gap_s <= _BROKEN_S or not size > 0.0:
            continue
        growth = size / max(min(end.size_px, start.size_px), 1e-9)
        apart = float(np.linalg.norm(start.place_px - end.place_px)) / size
        if growth > _BROKEN_GROWTH or apart > _BROKEN_SIZES:
            continue
        # A person who leaves the image would not continue to where another one enters it.
        moved_s, step = _FADE_S * (1.0 - float(np.exp(-gap_s / _FADE_S))), start.place_px - end.place_px
        off = max(float(np.linalg.norm(step - moved_s * speed)) for speed in (end.speed_px_s, start.speed_px_s)) / size
        is_clear = growth <= _CLEAR_GROWTH and max(apart, off) <= _CLEAR_SIZES
        breaks.append((apart, Break(before, after, *spans[after], is_clear)))
    return _nearest([gap for _, gap in sorted(breaks, key=lambda ranked: ranked[0])])


def _end(frame: Integers, points: Array, confidence: Array, rate_hz: float, *, is_last: bool) -> _TrackEnd:
    """Return the start or end of a track from its rows there."""
    middle = np.nanmedian(points, axis=1)
    times = (frame - frame.mean()) / rate_hz
    speed = times @ (middle - middle.mean(axis=0)) / max(float(times @ times), 1e-9)
    size = np.nanmax(body_size_px(points, confidence), initial=0.0)
    return _TrackEnd(int(frame[-1 if is_last else 0]), np.median(middle, axis=0), speed, float(size))


def _nearest(breaks: Sequence[Break]) -> list[Break]:
    """Return the nearest break of each person; it is not clear if others compete with it."""
    broken: list[Break] = []
    for gap in breaks:
        if any(gap.before == other.before or gap.after == other.after for other in broken):
            continue
        rivals = [other for other in breaks if other.before == gap.before or other.after == gap.after]
        broken.append(gap if len(rivals) == 1 else replace(gap, is_clear=False))
    return broken


def join_breaks(sequence_id: str, breaks: Sequence[Break]) -> list[Decision]:
    """Return decisions that join the clear breaks; a person lost several times stays one person."""
    first: dict[int, int] = {}
    rows = []
    for gap in sorted((gap for gap in breaks if gap.is_clear), key=lambda gap: gap.first_frame):
        first[gap.after] = first.get(gap.before, gap.before)
        rows.append(replace(gap.joined(sequence_id), is_person=first[gap.after]))
    return rows
