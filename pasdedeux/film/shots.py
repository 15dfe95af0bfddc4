"""Detection of the shots of a film, and resampling to a constant rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.film.tracking import Image
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.camera_motion import CameraMotion

_THUMB = (32, 24)
_MIN_CHANGE = 0.05
"""Minimum mean change of a thumbnail's pixels (0 to 1) at a cut; salsa with a turning camera has 0.025."""
_CHANGE_RATIO = 3.0
"""Minimum ratio of the change at a cut to that of the frames around it."""
_AROUND = 6
_MAX_JITTER = 0.5
"""Maximum deviation of time stamps of a constant rate, in frame times."""


class ShotFinder:
    """Finds cuts while the images of a film are added; only thumbnails of the last two are kept."""

    def __init__(self) -> None:
        self._last: list[Array] = []
        self._change: list[tuple[float, float]] = []

    def add(self, image: Image) -> None:
        """Add the next image."""
        import cv2  # here: a quarter of a second that others need not wait for

        thumb = cv2.resize(image, _THUMB, interpolation=cv2.INTER_AREA).astype(np.float64) / 255.0
        known = [float(np.abs(thumb - last).mean()) for last in self._last]
        self._change.append((known[0], known[1]) if len(known) == 2 else (known[0] if known else 0.0, np.inf))
        self._last = [thumb, *self._last[:1]]

    def starts(self) -> list[int]:
        """Return the first frame of every shot: 0, and those after hard cuts.

        At a cut the image changes far more than around it, and permanently, unlike a flash.
        """
        step, leap = np.array(self._change).reshape(-1, 2).T
        frames = [0]
        for frame in np.flatnonzero(step > _MIN_CHANGE).tolist():
            around = np.r_[step[max(frame - _AROUND, 1) : frame], step[frame + 1 : frame + 1 + _AROUND]]
            is_for_good = leap[frame : frame + 2].min() > 0.5 * step[frame]
            if is_for_good and step[frame] > _CHANGE_RATIO * (np.median(around) if len(around) else 0.0):
                frames.append(frame)
        return frames


def constant_rate_hz(time_s: Array) -> tuple[float, bool]:
    """Return the typical rate of two or more growing time stamps (frame,), and whether it is constant."""
    typical_s = float(np.median(np.diff(time_s)))
    mean_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    # Containers round time stamps; the mean is not affected.
    step_s = mean_s if abs(mean_s - typical_s) < 0.02 * typical_s else typical_s
    places = np.arange(len(time_s)) - (time_s - time_s[0]) / step_s
    return 1.0 / step_s, bool(np.ptp(places) <= 2.0 * _MAX_JITTER)


def at_constant_rate(frames: AnnotatedFrames, first_frame: int, time_s: Array, rate_hz: float) -> AnnotatedFrames:
    """Resample annotations of film of a variable rate to a constant one; frame n is then at n / rate seconds.

    Keypoints are interpolated between the film's frames before and after, and missing if one of them is.

    Args:
        frames: Rows of one shot, without gaps while a person is seen.
        first_frame: Frame of the film with the first time stamp.
        time_s: Time stamps (frame,) of the shot.
        rate_hz: The rate.
    """
    parts: list[tuple[Array | Integers, ...]] = []
    for person in np.unique(frames.person_id).tolist():
        rows = np.flatnonzero(frames.person_id == person)
        times_s = time_s[frames.frame[rows] - first_frame]
        wanted = np.arange(np.ceil(times_s[0] * rate_hz - 1e-6), np.floor(times_s[-1] * rate_hz + 1e-6) + 1)
        low_at = np.clip(np.searchsorted(times_s, wanted / rate_hz + 1e-9) - 1, 0, len(times_s) - 1)
        high_at = np.minimum(low_at + 1, len(times_s) - 1)
        gap_s = np.maximum(times_s[high_at] - times_s[low_at], 1e-9)
        is_near = frames.frame[rows[high_at]] - frames.frame[rows[low_at]] <= 1
        share = np.clip((wanted / rate_hz - times_s[low_at]) / gap_s, 0.0, 1.0)
        columns = (wanted.astype(np.int64), np.full(len(wanted), person), rows[low_at], rows[high_at], share)
        parts.append(tuple(column[is_near] for column in columns))
    number, person_id, before, after, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    low, high = frames.keypoints_px[before], frames.keypoints_px[after]
    nearest = np.where(share < 0.5, before, after)
    # A frame on the grid needs no second one.
    px = np.where(share[:, None, None] < 1e-6, low, low + share[:, None, None] * (high - low))
    is_seen = np.isfinite(px).all(axis=-1)
    return replace(
        frames,
        sequence_id=(frames.sequence_id[0],) * len(number) if len(number) else (),
        frame=number,
        person_id=person_id,
        keypoints_px=px,
        confidence=np.where(
            is_seen,
            np.maximum(frames.confidence[nearest], np.minimum(frames.confidence[before], frames.confidence[after])),
            0.0,
        ),
        status=None if frames.status is None else frames.status[nearest],
        rate_hz=rate_hz,
        camera_motion=_placed(frames, number, first_frame, time_s, rate_hz),
    )


def _placed(
    frames: AnnotatedFrames, number: Integers, first_frame: int, time_s: Array, rate_hz: float
) -> dict[str, CameraMotion]:
    """Return the motion of the camera, resampled to the frames of the constant rate."""
    if not len(number):
        return {}
    wanted = np.arange(number.min(), number.max() + 1)
    places = first_frame + np.interp(wanted / rate_hz, time_s, np.arange(len(time_s)))
    return {name: motion.at_times(wanted, places) for name, motion in frames.camera_motion.items()}
