"""Detections: a row for each person in each image, and their conversion to annotated sequences.

All readers of detectors' files use this module, so layouts, people and frames are determined in one place.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError, NobodyError
from pasdedeux.formats.poses2d.annotated_frames import (
    CLEARLY_SHORTER,
    MAX_IMAGE_PX,
    MAX_STRETCH,
    RATE_HZ,
    AnnotatedFrames,
    KeypointStatus,
    get_keypoint_layout,
    stretch,
)
from pasdedeux.formats.poses2d.image_names import FramePlace
from pasdedeux.formats.text import shorten
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import (
    KEYPOINT_LAYOUTS,
    LAYOUTS_OF_COUNT,
    USUAL_LAYOUTS,
    KeypointLayout,
    is_joint,
    layout_of_names,
)

MIN_NAMED = 6
"""Minimum number of joints with known names from which a layout is detected."""
_MAX_LISTED = 12
"""Maximum number of names in a message."""
_NUM_FACE, _MAX_FACE = 11, 0.33
"""Number of MediaPipe's landmarks before the shoulders, and their maximum distance from the nose, relative to that of
the shoulders: about 0.2 on a face, 0.4 and more if they are shoulders, elbows and wrists of another layout."""
_SHORTER = 0.87
"""Ratio of lengths below which one of equally common layouts is taken; for dancers in the right one it is 0.84."""
CONFIDENCE_OF_VISIBILITY = np.array([0.0, 0.5, 1.0])
"""Of COCO's v: 0 not labelled, 1 labelled but hidden, 2 labelled and visible; in a file without 2, 1 is visible."""
MAX_CONFIDENCE = 10.0
"""Maximum confidence in a file: heights of heat maps may exceed 1."""

_SIZE_KEYS = (("width", "height"), ("image_width", "image_height"), ("frame_width", "frame_height"))
_RATE_KEYS = ("rate_hz", "fps", "frame_rate", "frameRate")


@dataclass(frozen=True)
class Detection:
    """One person in one image.

    Args:
        place: Video and frame.
        person_id: Number or name of the person in the file; None if there is none.
        table: (K, 3) x, y and confidence; a row with NaN or confidence 0 is not detected.
        where: Position in the file, for messages.
        status: `KeypointStatus` of its keypoints (K,); None if the file does not state it.
        names: Names of its keypoints (K,) as spelled in the file; None if it has none.
    """

    place: FramePlace
    person_id: int | str | None
    table: npt.NDArray[np.float64]
    where: str
    status: tuple[int, ...] | None = None
    names: tuple[str, ...] | None = None


class OtherLayoutError(InputError):
    """The number of keypoints differs from that of the requested layout."""


@dataclass(frozen=True)
class Arranged:
    """Detections in the order of one layout.

    Args:
        layout: The layout.
        table: (row, K, 3) x, y and confidence; NaN and 0 where missing.
        status: (row, K) of `KeypointStatus`; None unless all detections have it.
        remarks: Notes for the user, such as names of joints that were left out.
    """

    layout: KeypointLayout
    table: npt.NDArray[np.float64]
    status: npt.NDArray[np.int64] | None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Footage:
    """Known properties of a video; None for unknown ones."""

    image_size_px: tuple[int, int] | None = None
    rate_hz: float | None = None
    focal_px: float | None = None
    fov_deg: float | None = None

    def focal_of(self, image_size_px: tuple[int, int] | None) -> float | None:
        """Return the focal length in an image of this size, pixels; None if it is unknown.

        Raises:
            InputError: The field of view is known, but the image size is not.
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
    may_be_cut: bool = False,
    is_strict: bool = False,
) -> AnnotatedFrames:
    """Return detections as annotations: the layout by names or number of keypoints, people by the file's numbers.

    If anybody in a video has no number, or two people have the same, its people are numbered by their order.

    Args:
        detections: Detections in any order.
        sequence_id: Name of the sequence, to which names of videos are appended.
        layout: Requested layout, or "auto"; see `arrange`.
        sizes_px: Image size by video, where known.
        rate_hz: Frames per second, if the file states it.
        skipped: Files that were skipped.
        may_be_cut: See `arrange`.
        is_strict: See `arrange`.
    """
    if not detections:
        raise NobodyError(f"sequence '{sequence_id}': nobody was detected in any frame")
    try:
        arranged = arrange(detections, layout, may_be_cut=may_be_cut, is_strict=is_strict)
    except OtherLayoutError as error:
        raise InputError(f"sequence '{sequence_id}': {error}") from None
    table = arranged.table
    confidence = np.nan_to_num(table[..., 2])
    if confidence.max(initial=0.0) == 2 and np.isin(confidence, [0, 1, 2]).all():
        confidence = CONFIDENCE_OF_VISIBILITY[confidence.astype(int)]
    if (confidence < 0).any() or (confidence > MAX_CONFIDENCE).any():
        row = int(np.flatnonzero(((confidence < 0) | (confidence > MAX_CONFIDENCE)).any(axis=1))[0])
        raise FormatError(f"{detections[row].where}: a confidence lies outside 0..{MAX_CONFIDENCE:g}")
    people, has_identities, remarks = number_people(detections)
    names_of = _sequence_names(sequence_id, {detection.place[0] for detection in detections})
    is_seen = _is_seen(table)
    return AnnotatedFrames.of(
        arranged.layout,
        sequence_id=tuple(names_of[detection.place[0]] for detection in detections),
        frame=np.array([detection.place[1] for detection in detections], dtype=np.int64),
        person_id=np.array(people, dtype=np.int64),
        keypoints_px=np.where(is_seen[..., None], table[..., :2], np.nan),
        confidence=np.where(is_seen, confidence, 0.0),
        image_size_px={names_of[video]: size for video, size in (sizes_px or {}).items() if video in names_of},
        rate_hz=rate_hz,
        has_identities=has_identities,
        skipped=tuple(skipped),
        status=arranged.status,
        remarks=(*arranged.remarks, *remarks),
    )


def arrange(
    detections: Sequence[Detection],
    layout: str | KeypointLayout = "auto",
    *,
    may_be_cut: bool = False,
    is_strict: bool = False,
) -> Arranged:
    """Return keypoints in the order of their layout.

    Named keypoints are placed by their names; names that the layout lacks are left out, with a remark. The layout of
    unnamed keypoints follows from their number; if several match, it is the one in which they look like people.

    Args:
        detections: Detections in any order.
        layout: Requested layout, or "auto".
        may_be_cut: Whether keypoints may be only the first of MediaPipe's landmarks.
        is_strict: Whether names that are not of joints are refused, for annotations by hand.

    Raises:
        FormatError: No known layout has these names or this number of keypoints, or several have it.
        OtherLayoutError: The requested layout has another number of keypoints.
    """
    named = {
        detection.names: detection
        for detection in detections
        if detection.names is not None and not _are_numbers(detection.names)
    }
    if not named:
        return _of_numbers(detections, layout, may_be_cut=may_be_cut)
    unnamed = next((detection for detection in detections if detection.names not in named), None)
    if unnamed:
        raise FormatError(f"{unnamed.where}: its keypoints have no names, but those of other frames or people have")
    all_names = max(named, key=lambda names: len(names or ())) or ()
    known = layout_of_names(all_names) if layout == "auto" else get_keypoint_layout(layout)
    num_named = known.num_named(all_names)
    # A layout of the user is in the order of the file, whatever the names of joints there.
    is_by_order = num_named == 0 or (not isinstance(layout, str) and num_named < len(all_names))
    if layout != "auto" and is_by_order and len(all_names) == known.num_keypoints:
        return _of_numbers(detections, layout, may_be_cut=may_be_cut)
    if layout == "auto" and num_named < MIN_NAMED:
        raise FormatError(
            f"the layout is unclear: {num_named} of the joints {_listed(all_names)} are known; state it (layout; in "
            "our CSV a line '# layout: NAME'), or give a layout_file"
        )
    table = np.tile([np.nan, np.nan, 0.0], (len(detections), known.num_keypoints, 1))
    status = np.zeros(table.shape[:2], dtype=np.int64)
    places = {names: known.find_keypoints(names) for names in named if names is not None}
    used = {names[at] for names, columns in places.items() for at in columns if at is not None}
    left_out = [name for name in dict.fromkeys(name for names in places for name in names) if name not in used]
    strange = [name for name in left_out if is_strict and not is_joint(name)]
    if layout == "auto" and strange:
        raise FormatError(
            f"the layout is unclear: no layout has {_listed(strange)}, and '{known.name}' has the others; rename or "
            "delete what is no joint, or give a layout_file"
        )
    if left_out and layout != "auto" and known not in LAYOUTS_OF_COUNT.get(len(all_names), ()):
        names = ", ".join(known.keypoint_names)
        raise FormatError(
            f"{detections[0].where}: joint '{shorten(left_out[0])}' is not in the layout '{known.name}'; known: {names}"
        )
    for row, detection in enumerate(detections):
        known_at = [(column, at) for column, at in enumerate(places[detection.names or ()]) if at is not None]
        columns, order = ([pair[end] for pair in known_at] for end in (0, 1))
        table[row, columns] = detection.table[order]
        if detection.status is not None:
            status[row, columns] = np.array(detection.status)[order]
    has_status = all(detection.status is not None for detection in detections)
    remarks = (f"joints left out that '{known.name}' lacks: {_listed(left_out)}",) if left_out else ()
    return Arranged(known, table, status if has_status else None, remarks)


def _of_numbers(detections: Sequence[Detection], layout: str | KeypointLayout, *, may_be_cut: bool) -> Arranged:
    """Return keypoints that are in the order of a layout."""
    counts = {len(detection.table): detection.where for detection in reversed(detections)}
    if len(counts) > 1:
        (first, there), (second, here) = sorted(counts.items())[:2]
        raise FormatError(f"{there} has {first} keypoints and {here} has {second}: a source has one layout")
    (count,) = counts
    table = np.stack([detection.table for detection in detections])
    known = LAYOUTS_OF_COUNT.get(count, ())
    landmarks = KEYPOINT_LAYOUTS["mediapipe33"]
    is_cut = may_be_cut and _NUM_FACE + 2 <= count < landmarks.num_keypoints and _begins_with_face(table)
    asked = get_keypoint_layout(layout) if layout != "auto" else None
    if asked is None and (known or is_cut):
        asked = landmarks if is_cut else _most_like_people(known, table)
    is_fitting = asked is not None and (
        asked in known or asked.num_keypoints == count or (is_cut and asked is landmarks)
    )
    if asked is None or not (known or is_fitting):
        names = ", ".join(f"{number} ({_either(some)})" for number, some in LAYOUTS_OF_COUNT.items())
        raise FormatError(
            f"{detections[0].where} has {counted(count, 'keypoint')}; known numbers of keypoints: {names}"
        )
    if not is_fitting:
        raise OtherLayoutError(
            f"the layout '{asked.name}' is asked for, but the files have {counted(count, 'keypoint')}: "
            f"{_either(known, mark=True)}"
        )
    missing = np.tile([np.nan, np.nan, 0.0], (len(table), max(0, asked.num_keypoints - count), 1))
    table = np.concatenate([table[:, : asked.num_keypoints], missing], axis=1)
    statuses = [
        (*detection.status, *[0] * missing.shape[1])[: asked.num_keypoints]
        for detection in detections
        if detection.status
    ]
    alike = [other for other in KEYPOINT_LAYOUTS.values() if other.num_keypoints == asked.num_keypoints]
    alike = [other for other in alike if other not in known]
    remarks: tuple[str, ...] = ()
    if layout == "auto" and alike:  # their keypoints have the same places
        remarks = (f"keypoints without names taken as '{asked.name}', not {_either(alike, mark=True)} (layout)",)
    return Arranged(asked, table, np.array(statuses) if len(statuses) == len(detections) else None, remarks)


def _is_seen(table: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return which keypoints (row, K) of a table (row, K, 3) are detected; those at the origin are not."""
    return (np.nan_to_num(table[..., 2]) > 0) & (table[..., :2] != 0).any(axis=-1)


def _begins_with_face(table: npt.NDArray[np.float64]) -> bool:
    """Return whether the first points (row, K, 3) are MediaPipe's face: all near the nose, unlike the shoulders."""
    points = np.where(_is_seen(table)[..., None], table[..., :2], np.nan)
    far = np.linalg.norm(points - points[:, :1], axis=-1)
    ears = (0, 7, 8)  # nose and ears; on a head turned away, ears have half the distance of a shoulder
    face, shoulders = np.delete(far[:, :_NUM_FACE], ears, axis=1), far[:, _NUM_FACE : _NUM_FACE + 2]
    is_face_seen = np.isfinite(face).any(axis=1) & np.isfinite(shoulders).any(axis=1)
    if not is_face_seen.any():  # no face is seen, where other layouts have shoulders and wrists
        return bool(np.isfinite(shoulders).any())
    ratio = np.nanmax(face[is_face_seen], axis=1) / np.maximum(np.nanmax(shoulders[is_face_seen], axis=1), 1e-9)
    return bool(np.median(ratio) < _MAX_FACE)


def _most_like_people(layouts: Sequence[KeypointLayout], table: npt.NDArray[np.float64]) -> KeypointLayout:
    """Return the layout in which keypoints (row, K, 3) have clearly the shortest body segments, else the usual one.

    Raises:
        FormatError: No layout is clearly better, and none of them is usual.
    """
    if len(layouts) == 1:
        return layouts[0]
    confidence = np.where(_is_seen(table), table[..., 2], 0.0)
    lengths = {layout.name: stretch(layout.name, table[..., :2], confidence) for layout in layouts}
    ranked = sorted((lengths[layout.name], layout.name) for layout in layouts if np.isfinite(lengths[layout.name]))
    usual = next((layout for layout in layouts if layout.name in USUAL_LAYOUTS), None)
    clearly = CLEARLY_SHORTER if usual else _SHORTER
    if ranked and ranked[0][0] <= MAX_STRETCH and all(ranked[0][0] < clearly * length for length, _ in ranked[1:]):
        return KEYPOINT_LAYOUTS[ranked[0][1]]
    if usual:
        return usual
    raise FormatError(
        f"{table.shape[1]} keypoints without names may be {_either(layouts, mark=True)}: say which (layout)"
    )


def _either(layouts: Sequence[KeypointLayout], *, mark: bool = False) -> str:
    return " or ".join(f"'{layout.name}'" if mark else layout.name for layout in layouts)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return ", ".join(f"'{shorten(name)}'" for name in names[:_MAX_LISTED]) + more


def _are_numbers(names: Sequence[str]) -> bool:
    """Return whether names are only numbered in order, such as `0` or `point-3`."""
    numbers = [re.search(r"\d+$", name.strip()) for name in names]
    values = [int(number[0]) for number in numbers if number]
    fronts = {name.strip()[: number.start()] for name, number in zip(names, numbers, strict=True) if number}
    return (
        len(values) == len(names) > 1 and len(fronts) == 1 and values == list(range(values[0], values[0] + len(values)))
    )


def names_in_order(names: Iterable[str], *, first: int | None = None) -> tuple[str, ...]:
    """Return the different names of joints; numbered names, such as `3` or `point-3`, are sorted and completed.

    Args:
        names: Names in any order.
        first: Number of the first joint; None for 0 if that occurs, else 1.
    """
    different = tuple(dict.fromkeys(names))
    numbers = [re.fullmatch(r"(\D*)(\d{1,3})", name.strip()) for name in different]
    if not different or not all(numbers) or len({match[1] for match in numbers if match}) > 1:
        return different
    by_number = {int(match[2]): name for name, match in zip(different, numbers, strict=True) if match}
    front = next(match[1] for match in numbers if match)
    start = min(1, *by_number, 1) if first is None else first
    return tuple(by_number.get(number, f"{front}{number}") for number in range(start, max(by_number) + 1))


def detections_of_joints(
    people: Mapping[tuple[str, int, int | str], Mapping[str, tuple[float, float, float, float]]],
) -> list[Detection]:
    """Return detections of people, by video, frame and number, whose joints have names.

    A joint has x, y, confidence and `KeypointStatus`.  If the status of a joint is NaN, its person has none.
    """
    names = names_in_order(name for joints in people.values() for name in joints)
    missing = (math.nan, math.nan, 0.0, float(KeypointStatus.MISSING))
    detections = []
    for (video, frame, person), joints in people.items():
        table = np.array([joints.get(name, missing) for name in names])
        status = None if np.isnan(table[:, 3]).any() else tuple(table[:, 3].astype(int).tolist())
        detections.append(Detection((video, frame), person, table[:, :3], f"frame {frame}", status, names))
    return detections


def number_people(detections: Sequence[Detection]) -> tuple[list[int], bool, tuple[str, ...]]:
    """Return a number for each detection, whether all numbers are from the file, and remarks.

    People with names are numbered in the order of their names.
    """
    names = sorted({detection.person_id for detection in detections if isinstance(detection.person_id, str)})
    if any(isinstance(detection.person_id, int) for detection in detections) and names:
        names = sorted({str(detection.person_id) for detection in detections if detection.person_id is not None})
    named = Counter((detection.place, detection.person_id) for detection in detections)
    anew = {
        detection.place[0]
        for detection in detections
        if detection.person_id is None or named[detection.place, detection.person_id] > 1
    }
    seen: Counter[FramePlace] = Counter()
    ids = []
    for detection in detections:
        is_anew = detection.place[0] in anew or detection.person_id is None
        number = names.index(str(detection.person_id)) if names and not is_anew else detection.person_id
        ids.append(seen[detection.place] if is_anew else int(number or 0))
        seen[detection.place] += 1
    said = ", ".join(f"{number} is '{shorten(name)}'" for number, name in enumerate(names[:_MAX_LISTED]))
    return ids, not anew, (f"people: {said}",) if names and not anew else ()


def _sequence_names(sequence_id: str, videos: Collection[str]) -> dict[str, str]:
    """Return the name of each video's sequence; equal names get a number.

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
    """Return size and rate under the usual keys of a JSON object or of an object directly inside it."""
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
    """Return width and height in an image's JSON object; None unless both are whole numbers of pixels."""
    width, height = (image.get(key) for key in keys)
    if not isinstance(width, int | float) or not isinstance(height, int | float):
        return None
    is_size = all(0 < side <= MAX_IMAGE_PX and side == int(side) for side in (width, height))
    return (int(width), int(height)) if is_size else None
