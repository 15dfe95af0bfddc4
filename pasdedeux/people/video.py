"""Checks whether frames are those of a video, and its rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError
from pasdedeux.people.identity import MAX_ABSENT_S, MIN_JOINTS, body_size_px
from pasdedeux.spread import evenly_spread

_SHORT_SPAN = 1000
"""Up to this number of frames, gaps do not matter."""
_MIN_SHARE_SEEN = 0.05
"""Minimum share of frames with people in a longer sequence for it to be a video."""

MAX_REPAIR_GAP_S = 0.5
"""Nothing is repaired if frames are typically farther apart: motion between them looks like a fault."""
_MAX_STEP = 0.15
"""Maximum typical distance of the nearest people of successive frames of a video, a share of their size.  Salsa has
0.02 at 30 Hz, up to 0.13 at half a second; photos of a couple at nearly the same place 0.17, others over 0.2."""
_MAX_STEPS = 2000
"""Maximum number of steps that are examined."""


def check_one_video(camera: str, names: Sequence[str]) -> None:
    """Refuse a camera of a take unless it has exactly one video: not several shots of a film, or several cameras.

    Raises:
        InputError: The message says what to do.
    """
    if len(names) != 1:
        raise InputError(
            f"{camera}: one video of the take is needed, found {', '.join(names) or 'none'}; name one file of one "
            "camera, and of a film with cuts cut the take out, or set has_cuts = false if these are no cuts"
        )


def why_no_video(frame: Integers) -> str:
    """Return why frame numbers are not those of a video but of single images, numbered by ids or times; else "".

    Gaps of such a sequence may hold millions of frames, without motion between the images.
    """
    numbers = np.unique(frame)
    span = int(numbers[-1] - numbers[0]) + 1 if len(numbers) else 0
    if span <= _SHORT_SPAN or len(numbers) >= _MIN_SHARE_SEEN * span:
        return ""
    return f"{len(numbers):,} frames spread over {span:,} are single images, not a video"


def why_not_followed(frame: Integers, keypoints_px: Array, confidence: Array, *, rate_hz: float) -> str:
    """Return why nobody can be followed although frame numbers may be those of a video; else "".

    That is so if the frames are typically too far apart in time, or the nearest people of successive frames too far
    apart in the image.  The nearest two people count, by the median over their joints, so false detections and wild
    joints do not matter.  Frames without people are skipped.

    Args:
        frame: Frame number of each row (row,).
        keypoints_px: op14 keypoints (row, 14, 2), pixels; NaN where not seen.
        confidence: (row, 14), 0 where not seen.
        rate_hz: Frames per second.
    """
    is_seen = (confidence > 0) & np.isfinite(keypoints_px).all(axis=-1)
    size = body_size_px(keypoints_px, confidence)
    is_person = (is_seen.sum(axis=1) >= MIN_JOINTS) & (size > 0)
    gap_s = typical_gap_s(frame[is_person], rate_hz)
    if gap_s > MAX_ABSENT_S:
        return (
            f"the frames are typically {gap_s:.1f} s apart and nobody is followed for more than "
            f"{MAX_ABSENT_S:g} s: they are single images, not a video"
        )
    people = np.flatnonzero(is_person)
    people = people[np.argsort(frame[people], kind="stable")]
    by_frame = np.split(people, np.flatnonzero(np.diff(frame[people])) + 1)
    steps = []
    for step in evenly_spread(len(by_frame) - 1, _MAX_STEPS).tolist():
        before, other = by_frame[step][:, None], by_frame[step + 1][None]
        both = is_seen[before] & is_seen[other]
        apart = np.linalg.norm(keypoints_px[before] - keypoints_px[other], axis=-1)
        count = both.sum(axis=-1)
        share = np.sort(np.where(both, apart, np.inf), axis=-1) / np.maximum(size[before], size[other])[..., None]
        middle = np.take_along_axis(share, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
        if (count >= MIN_JOINTS).any():
            steps.append(float(middle[count >= MIN_JOINTS].min()))
    if not steps or (typical := float(np.median(steps))) <= _MAX_STEP:
        return ""
    return (
        f"the nearest people of successive frames are typically {typical:.0%} of their height apart: they are single "
        "images, not a video"
    )


def typical_gap_s(frame: Integers, rate_hz: float) -> float:
    """Return the median time between frames; 0 for fewer than two."""
    numbers = np.unique(frame)
    return float(np.median(np.diff(numbers))) / rate_hz if len(numbers) > 1 else 0.0


def rate_from_times(frame: Integers, time_s: Array) -> float:
    """Return the frame rate of rows with these frame numbers, which may have gaps, and times.

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
