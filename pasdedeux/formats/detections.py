"""The one form of what detectors write: a row for each person in each image, and how rows become sequences.

Every reader of a detector's files ends here, so that layouts, people and frame numbers are found in one place.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError, NobodyError
from pasdedeux.formats.annotated_frames import MAX_IMAGE_PX, RATE_HZ, AnnotatedFrames, get_keypoint_layout
from pasdedeux.formats.image_names import Place
from pasdedeux.skeletons.layouts import LAYOUT_OF_COUNT, KeypointLayout

MAX_CONFIDENCE = 10.0
"""Confidences are heights of a heat map: about 1 at most, but not exactly."""

_SIZE_KEYS = (("width", "height"), ("image_width", "image_height"), ("frame_width", "frame_height"))
_RATE_KEYS = ("rate_hz", "fps", "frame_rate", "frameRate")


@dataclass(frozen=True)
class Detection:
    """One person in one image.

    Args:
        place: Video and frame.
        person_id: Number that the file gives the person, None where it gives none.
        table: (K, 3) x, y and confidence; a row with NaN or confidence 0 is not detected.
        where: The place in the file, for messages.
        status: Where its keypoints come from (K,), `KeypointStatus`; None where the file does not say.
    """

    place: Place
    person_id: int | None
    table: npt.NDArray[np.float64]
    where: str
    status: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Footage:
    """What is known of the images of a video; None where it is not."""

    image_size_px: tuple[int, int] | None = None
    rate_hz: float | None = None
    focal_px: float | None = None
    fov_deg: float | None = None

    def focal_of(self, image_size_px: tuple[int, int] | None) -> float | None:
        """Return the focal length in an image of this size, pixels; None where nothing is known of it.

        Raises:
            InputError: The field of view is known, but not the size.
        """
        if self.focal_px or not self.fov_deg:
            return self.focal_px
        if image_size_px is None:
            raise InputError("a field of view needs the size of the image (image_size_px)")
        return 0.5 * image_size_px[0] / math.tan(math.radians(0.5 * self.fov_deg))


UNKNOWN = Footage()


def join_detections(
    detections: Sequence[Detection],
    *,
    sequence_id: str,
    layout: str | KeypointLayout = "auto",
    sizes_px: Mapping[str, tuple[int, int]] | None = None,
    rate_hz: float | None = None,
    skipped: Sequence[str] = (),
) -> AnnotatedFrames:
    """Return detections as annotations: the layout by the number of keypoints, people by the file's numbers.

    People are numbered by their order in the frame in a video where somebody has no number, or two have the same.

    Args:
        detections: In any order.
        sequence_id: Name of the sequence; names of videos come after it.
        layout: Layout asked for; of several with as many keypoints it is the one.
        sizes_px: Image size by video, where it is known.
        rate_hz: Frames per second, where the file says.
        skipped: Files that were skipped.
    """
    if not detections:
        raise NobodyError(f"sequence '{sequence_id}': nobody was detected in any frame")
    counts = {len(one.table): one.where for one in reversed(detections)}
    if len(counts) > 1:
        (first, there), (second, here) = sorted(counts.items())[:2]
        raise FormatError(f"{there} has {first} keypoints and {here} has {second}: a source has one layout")
    (count,) = counts
    known = LAYOUT_OF_COUNT.get(count)
    asked = known if layout == "auto" else get_keypoint_layout(layout)
    if asked is None or (known is None and asked.num_keypoints != count):
        names = ", ".join(f"{number} ({one.name})" for number, one in sorted(LAYOUT_OF_COUNT.items()))
        raise FormatError(f"{detections[0].where} has {count} keypoints; known numbers of keypoints: {names}")
    if known is not None and known is not asked and asked.num_keypoints != count:
        raise InputError(
            f"sequence '{sequence_id}': the layout '{asked.name}' is asked for, but the files have {count} keypoints: "
            f"'{known.name}'"
        )
    table = np.stack([one.table[: asked.num_keypoints] for one in detections])
    confidence = np.nan_to_num(table[..., 2])
    if (confidence < 0).any() or (confidence > MAX_CONFIDENCE).any():
        row = int(np.flatnonzero(((confidence < 0) | (confidence > MAX_CONFIDENCE)).any(axis=1))[0])
        raise FormatError(f"{detections[row].where}: a confidence lies outside 0..{MAX_CONFIDENCE:g}")
    people, has_identities = _people(detections)
    names_of = _sequence_names(sequence_id, {one.place[0] for one in detections})
    is_seen = (confidence > 0) & (table[..., :2] != 0).any(axis=-1)
    return AnnotatedFrames.of(
        asked,
        sequence_id=tuple(names_of[one.place[0]] for one in detections),
        frame=np.array([one.place[1] for one in detections], dtype=np.int64),
        person_id=np.array(people, dtype=np.int64),
        keypoints_px=np.where(is_seen[..., None], table[..., :2], np.nan),
        confidence=np.where(is_seen, confidence, 0.0),
        image_size_px={names_of[video]: size for video, size in (sizes_px or {}).items() if video in names_of},
        rate_hz=rate_hz,
        has_identities=has_identities,
        skipped=tuple(skipped),
        status=_statuses(detections, asked.num_keypoints),
    )


def _statuses(detections: Sequence[Detection], num_keypoints: int) -> npt.NDArray[np.int64] | None:
    """Return where keypoints come from (row, K), None where a detection does not say."""
    stated = [one.status for one in detections if one.status is not None and len(one.status) >= num_keypoints]
    return None if len(stated) < len(detections) else np.array([one[:num_keypoints] for one in stated], dtype=np.int64)


def _people(detections: Sequence[Detection]) -> tuple[list[int], bool]:
    """Return a number for each detection, the file's in videos where everybody has an own one; and whether all do."""
    named = Counter((one.place, one.person_id) for one in detections)
    anew = {one.place[0] for one in detections if one.person_id is None or named[one.place, one.person_id] > 1}
    seen: Counter[Place] = Counter()
    ids = []
    for one in detections:
        ids.append(seen[one.place] if one.place[0] in anew or one.person_id is None else one.person_id)
        seen[one.place] += 1
    return ids, not anew


def _sequence_names(sequence_id: str, videos: Collection[str]) -> dict[str, str]:
    """Return the name of each video's sequence; of those that would have the same name all but the first are counted.

    >>> _sequence_names("clip", ["a/b", "a_b", ""])
    {'': 'clip', 'a/b': 'clip.a_b', 'a_b': 'clip.a_b_2'}
    """
    names: dict[str, str] = {}
    for video in sorted(videos):
        plain = f"{sequence_id}.{re.sub(r'[^A-Za-z0-9_-]', '_', video)[:100]}" if video else sequence_id
        counted = (f"{plain}_{number}" for number in count(2))
        names[video] = next(name for name in chain([plain], counted) if name not in names.values())
    return names


def known_footage(content: object) -> Footage:
    """Return size and rate that a JSON object states under the usual keys, itself or in an object inside it."""
    inside = [content, *content.values()] if isinstance(content, dict) else []
    parts = [part for part in inside if isinstance(part, dict)]
    size = next(filter(None, (image_size(part, keys) for part in parts for keys in _SIZE_KEYS)), None)
    rates = ((key, part[key]) for part in parts for key in _RATE_KEYS if part.get(key) is not None)
    key, rate = next(rates, ("", None))
    if rate is None:
        return Footage(size)
    if type(rate) not in (int, float) or not RATE_HZ[0] <= rate <= RATE_HZ[1]:
        raise FormatError(f"'{key}' is {str(rate)[:40]}; allowed: {RATE_HZ[0]:g} to {RATE_HZ[1]:g}")
    return Footage(size, float(rate))


def image_size(image: Mapping[str, Any], keys: tuple[str, str] = ("width", "height")) -> tuple[int, int] | None:
    """Return width and height of an image's JSON object, None where they are no whole numbers of pixels."""
    width, height = (image.get(key) for key in keys)
    if not isinstance(width, int | float) or not isinstance(height, int | float):
        return None
    is_size = all(0 < side <= MAX_IMAGE_PX and side == int(side) for side in (width, height))
    return (int(width), int(height)) if is_size else None
