"""Reading COCO keypoint JSON: annotations of images, and the results of detectors in COCO's and mmpose's forms."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import (
    MAX_FRAME,
    Detection,
    Place,
    image_size,
    join_detections,
    known_footage,
    places_of_names,
)
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import parse_json, parse_triples

_CONFIDENCE_OF_VISIBILITY = np.array([0.0, 0.5, 1.0])
"""COCO's v: 0 not labelled, 1 labelled but hidden, 2 labelled and visible."""
_ID_KEYS = ("track_id", "idx", "person_id", "instance_id")
"""Where a person's number stands: COCO's and trackers' `track_id`, AlphaPose's `idx`."""
_FRAME_KEYS = ("frame_id", "frame_index", "frame")


class Coco(AnnotationFormat):
    """COCO keypoints: they may state the size of the images, seldom the rate."""

    name = "coco"
    recognised_by = "JSON with 'annotations', 'images', 'image_id' or 'instances'"
    suffixes = (".json",)

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is JSON with one of COCO's or mmpose's keys and not OpenPose's, or an empty list."""
        others = ('"people"', '"landmarks"', '"pose_landmarks"')
        if not start.is_json or any(key in start.text for key in others) or re.search(r'"x"\s*:\s*-?\d', start.text):
            return False
        keys = ('"image_id"', '"annotations"', '"images"', '"instances"')
        return any(key in start.text for key in keys) or start.text.split() in (["[]"], ["[", "]"])

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the one file."""
        (data,) = files.values()
        return read_coco(data, sequence_id=sequence_id, layout=layout)


@dataclass(frozen=True)
class _Item:
    """A person as the file lists it, in the image with this id, number or name."""

    image: int | str
    content: dict[str, Any]
    where: str


def read_coco(data: bytes | str, *, sequence_id: str, layout: str = "auto") -> AnnotatedFrames:
    """Read COCO keypoints: annotations, or results as mmpose, ViTPose, Detectron2, Ultralytics, AlphaPose write them.

    With a list `images`, the third number of a keypoint is COCO's visibility (0 means missing), and an image is of its
    `video_id` and the frame `frame_id`; else the frame that its file name tells, else of its place in the list.  In a
    list of results the third number is a confidence, and `image_id` is the frame or the name of the image.  mmpose's
    own form has a list of frames with `instances`, whose keypoints and `keypoint_scores` stand apart.  People are
    numbered by `track_id` or AlphaPose's `idx` where everybody has one of their own, else by their order.

    Raises:
        FormatError: Not JSON, not COCO keypoints, a number of keypoints that no layout has, a visibility other than 0,
            1, 2, an unknown image, or a value that is no finite number.
        InputError: The file holds nobody.
    """
    content = parse_json(data, "COCO file", has_nan=True)
    is_annotations = isinstance(content, dict) and isinstance(content.get("annotations"), list)
    listed = content.get("annotations" if is_annotations else "instance_info") if isinstance(content, dict) else content
    if not isinstance(listed, list):
        raise FormatError("this is not a COCO file: it has no list 'annotations'")
    items = list(_annotations(listed) if is_annotations else _results(listed))
    if not items:
        raise InputError("this file holds nobody: no image of it has keypoints")
    if is_annotations:
        places, sizes = _places_of_images(content)
        for item in items:
            if item.image not in places:
                raise FormatError(f"{item.where}: its 'image_id' is not among the images")
    else:
        places, sizes = _places_of_ids(items), {}
    footage = known_footage(content)
    if footage.image_size_px:
        sizes = sizes or {video: footage.image_size_px for video, _ in places.values()}
    return join_detections(
        [
            Detection(
                place=places[item.image],
                person_id=person_number(item.content),
                table=_visibilities(table, item.where) if is_annotations else table,
                where=item.where,
            )
            for item in items
            for table in (keypoint_table(item.content, item.where),)
        ],
        sequence_id=sequence_id,
        layout=layout,
        sizes_px=sizes,
        rate_hz=footage.rate_hz,
    )


def _annotations(items: list[Any]) -> Iterator[_Item]:
    """Yield the annotations that have keypoints."""
    for index, content in enumerate(items):
        where = f"annotation {index}"
        if _has_keypoints(content, where):
            image = content.get("image_id")
            yield _Item(image if isinstance(image, int | str) else "", content, where)


def _results(results: list[Any]) -> Iterator[_Item]:
    """Yield the people of a list of results, or of a list of frames with `instances`."""
    for index, one in enumerate(results):
        where = f"annotation {index}"
        if isinstance(one, dict) and isinstance(one.get("instances"), list):
            frame = next((one[key] for key in _FRAME_KEYS if key in one), index)
            for number, person in enumerate(one["instances"]):
                inside = f"{where}, person {number}"
                if _has_keypoints(person, inside):
                    yield _Item(_checked_image(frame, inside, "frame_id"), person, inside)
        elif _has_keypoints(one, where):
            yield _Item(_checked_image(one.get("image_id"), where, "image_id"), one, where)


def _has_keypoints(content: object, where: str) -> bool:
    """Tell whether a person has keypoints; an empty list, as COCO has for crowds, is none."""
    if not isinstance(content, dict) or not isinstance(content.get("keypoints"), list):
        raise FormatError(f"{where} has no list 'keypoints'")
    return bool(content["keypoints"])


def _checked_image(value: object, where: str, key: str) -> int | str:
    if isinstance(value, str) and value:
        return value
    if not _is_count(value):
        raise FormatError(f"{where}: '{key}' must be a whole number from 0 to {MAX_FRAME}, or an image's name")
    return int(str(value))


def keypoint_table(content: dict[str, Any], where: str) -> Array:
    """Return the keypoints (K, 3) of a person: triples end to end, or points or lists x and y with scores apart.

    Raises:
        FormatError: Neither of these, or a value that is no number; `where` is put in front.
    """
    numbers, scores = content["keypoints"], content.get("keypoint_scores")
    if isinstance(numbers, dict):
        x, y, scores = (numbers.get(key) for key in ("x", "y", "visible"))
        if not isinstance(x, list) or not isinstance(y, list) or len(x) != len(y):
            raise FormatError(f"{where}: 'keypoints' have no lists 'x' and 'y' of one length")
        numbers, scores = [list(point) for point in zip(x, y, strict=True)], scores or [1.0] * len(x)
    if all(isinstance(point, list) for point in numbers):
        if not isinstance(scores, list) or len(scores) != len(numbers) or any(len(point) < 2 for point in numbers):
            raise FormatError(f"{where}: 'keypoints' are points, which need as many 'keypoint_scores'")
        numbers = [value for point, score in zip(numbers, scores, strict=True) for value in (*point[:2], score)]
    if len(numbers) % 3:
        raise FormatError(f"{where} has {len(numbers)} values in 'keypoints', which are no triples x, y, confidence")
    return parse_triples(numbers, f"{where}: 'keypoints'")


def _visibilities(table: Array, where: str) -> Array:
    if not np.isin(table[:, 2], [0, 1, 2]).all():
        raise FormatError(f"{where}: a visibility is none of 0, 1, 2")
    return np.concatenate([table[:, :2], _CONFIDENCE_OF_VISIBILITY[table[:, 2].astype(int)][:, None]], axis=1)


def person_number(content: dict[str, Any]) -> int | None:
    """Return the number of a person; AlphaPose's may be a list, or a whole number written as 1.0."""
    value = next((content[key] for key in _ID_KEYS if content.get(key) is not None), None)
    while isinstance(value, list):
        value = value[0] if value else None
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if _is_count(value) else None


def _places_of_ids(items: list[_Item]) -> dict[int | str, Place]:
    """Return video and frame by what results call their images: numbers are frames, names tell theirs."""
    ids = {item.image for item in items}
    if all(isinstance(image, int) for image in ids):
        return {image: ("", int(image)) for image in ids}
    places = places_of_names(str(image) for image in ids)
    return {image: places[str(image)] for image in ids}


def _places_of_images(content: dict[str, Any]) -> tuple[dict[int | str, Place], dict[str, tuple[int, int]]]:
    """Return video and frame by image id, and the size of the images of each video where all of them have the same."""
    images = content.get("images")
    if not isinstance(images, list):
        raise FormatError("this is not a COCO file: it has no list 'images'")
    known: dict[int | str, dict[str, Any]] = {}
    for index, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), int | str):
            raise FormatError(f"image {index} has no 'id'")
        if image["id"] in known:
            raise FormatError(f"image {index}: its id {str(image['id'])[:40]!r} appears twice")
        if image.get("frame_id") is not None and not _is_count(image["frame_id"]):
            raise FormatError(f"image {index}: 'frame_id' must be a whole number from 0 to {MAX_FRAME}")
        known[image["id"]] = image
    places = _stated_places(known)
    if places is None:
        names = places_of_names(image["file_name"] for image in known.values())
        places = {image_id: names[image["file_name"]] for image_id, image in known.items()}
    sizes: dict[str, set[tuple[int, int] | None]] = {}
    for image_id, image in known.items():
        sizes.setdefault(places[image_id][0], set()).add(image_size(image))
    return places, {video: size for video, found in sizes.items() if len(found) == 1 for size in found if size}


def _stated_places(images: Mapping[int | str, dict[str, Any]]) -> dict[int | str, Place] | None:
    """Return the places that images state, None where only their different file names can tell."""
    is_stated = any(image.get("video_id") is not None or image.get("frame_id") is not None for image in images.values())
    names = [image.get("file_name") for image in images.values()]
    if not is_stated and all(isinstance(name, str) for name in names) and len(set(names)) == len(names):
        return None
    counts: dict[str, int] = {}
    places: dict[int | str, Place] = {}
    for image_id, image in images.items():
        video = str(image["video_id"]) if isinstance(image.get("video_id"), int | str) else ""
        frame = counts.get(video, 0) if image.get("frame_id") is None else int(image["frame_id"])
        counts[video] = counts.get(video, 0) + 1
        places[image_id] = (video, frame)
    return places


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_FRAME
