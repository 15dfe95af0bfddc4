"""Reading COCO keypoint JSON, and what mmpose, ViTPose, Detectron2, Ultralytics and AlphaPose write in its form."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import (
    Detection,
    Place,
    image_size,
    join_detections,
    known_footage,
    places_of_names,
)
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import MAX_COUNT, parse_json, parse_triples

_CONFIDENCE_OF_VISIBILITY = np.array([0.0, 0.5, 1.0])
"""COCO's v: 0 not labelled, 1 labelled but hidden, 2 labelled and visible."""
_ID_KEYS = ("track_id", "idx", "person_id", "instance_id")
"""Where a person's number stands: COCO's and trackers' `track_id`, AlphaPose's `idx`."""
_FRAME_KEYS = ("frame_id", "frame_index", "frame")
_IMAGE_KEYS = ("image_id", "annotations", "images", "instances")
_LANDMARK_KEYS = ("landmarks", "pose_landmarks")


@dataclass(frozen=True)
class _Item:
    """A person as the file lists it, in the image with this id, number or name."""

    image: Any
    content: dict[str, Any]
    where: str


def read_coco(data: bytes | str, sequence_id: str, layout: str = "auto") -> AnnotatedFrames:
    """Read COCO keypoints: annotations, or results as mmpose, ViTPose, Detectron2, Ultralytics, AlphaPose write them.

    With a list `images`, the third number of a keypoint is COCO's visibility (0 means missing), and an image is of its
    `video_id` and the frame `frame_id`; else the frame that its file name tells, else of its place in the list.  In a
    list of results the third number is a confidence, and `image_id` is the frame or the name of the image.  mmpose's
    own form has a list of frames with `instances`, whose keypoints and `keypoint_scores` stand apart.  People are
    numbered by `track_id` or AlphaPose's `idx` where everybody has one of their own, else by their order.
    """
    content = parse_json(data, "COCO file")
    named = content if isinstance(content, dict) else {"instance_info": content}
    is_annotations = isinstance(named.get("annotations"), list)
    listed = named["annotations"] if is_annotations else named.get("instance_info")
    if not isinstance(listed, list):
        raise FormatError("this is not a COCO file: it has no list 'annotations'")
    items = list(_people(listed))
    if not items:
        raise InputError("this file holds nobody: no image of it has keypoints")
    places, sizes = _places_of_images(named.get("images")) if is_annotations else (_places_of_ids(items), {})
    footage = known_footage(content)
    if footage.image_size_px:
        sizes = sizes or {video: footage.image_size_px for video, _ in places.values()}
    detections = []
    for item in items:
        if not isinstance(item.image, int | str) or item.image not in places:
            raise FormatError(f"{item.where}: its 'image_id' is not among the images")
        table = _keypoint_table(item.content, item.where)
        if is_annotations:
            if not np.isin(table[:, 2], [0, 1, 2]).all():
                raise FormatError(f"{item.where}: a visibility is none of 0, 1, 2")
            table[:, 2] = _CONFIDENCE_OF_VISIBILITY[table[:, 2].astype(int)]
        detections.append(Detection(places[item.image], _person_number(item.content), table, item.where))
    return join_detections(detections, sequence_id=sequence_id, layout=layout, sizes_px=sizes, rate_hz=footage.rate_hz)


def read_image_results(data: bytes) -> list[Detection]:
    """Read the people of one image: `keypoints` as points with `keypoint_scores`, triples, or lists x, y, visible.

    mmpose writes such a list for each image, alone or as `instance_info` beside its `meta_info`; Ultralytics' results
    give it by `to_json`, with objects that are no people among them.
    """
    content = parse_json(data, "JSON file")
    people = content.get("instance_info") if isinstance(content, dict) else content
    if not isinstance(people, list):
        raise FormatError("this is no list of people with 'keypoints'")
    found = []
    for index, person in enumerate(people):
        where = f"person {index}"
        if not isinstance(person, dict) or not isinstance(person.get("keypoints", []), list | dict):
            raise FormatError(f"{where} is no object with 'keypoints'")
        if person.get("keypoints"):
            found.append(Detection(("", 0), _person_number(person), _keypoint_table(person, where), where))
    return found


def _is_coco(start: FileStart) -> bool:
    if start.has_points or start.has_key("people", *_LANDMARK_KEYS):
        return False
    return start.has_key(*_IMAGE_KEYS) or start.text.split() in (["[]"], ["[", "]"])


def _is_image_result(start: FileStart) -> bool:
    others = ("people", *_LANDMARK_KEYS, *_IMAGE_KEYS, "frame_id", "frame")
    return start.has_key("keypoints") and not start.has_points and not start.has_key(*others)


COCO = AnnotationFormat(
    name="coco",
    recognised_by="JSON with 'annotations', 'images', 'image_id' or 'instances'",
    suffixes=(".json",),
    recognises=_is_coco,
    read_file=read_coco,
)
"""COCO keypoints: they may state the size of the images, seldom the rate."""
IMAGE_RESULTS = AnnotationFormat(
    name="image_results",
    recognised_by="JSON list of one image's people with 'keypoints'",
    suffixes=(".json",),
    recognises=_is_image_result,
    read_people=read_image_results,
)
"""A folder of results, a file for each image that does not say itself of which it is."""


def _people(listed: list[Any]) -> Iterator[_Item]:
    """Yield those who have keypoints, of a list of annotations, of results, or of frames with `instances`."""
    for index, one in enumerate(listed):
        where = f"annotation {index}"
        content = one if isinstance(one, dict) else {}
        if isinstance(content.get("instances"), list):
            image = next((one[key] for key in _FRAME_KEYS if key in one), index)
            people = [(person, f"{where}, person {number}") for number, person in enumerate(one["instances"])]
        else:
            image, people = content.get("image_id"), [(one, where)]
        for person, inside in people:
            if not isinstance(person, dict) or not isinstance(person.get("keypoints"), list):
                raise FormatError(f"{inside} has no list 'keypoints'")
            if person["keypoints"]:  # COCO has an empty list for crowds
                yield _Item(image, person, inside)


def _keypoint_table(content: dict[str, Any], where: str) -> Array:
    """Return the keypoints (K, 3) of a person: triples end to end, or points or lists x and y with scores apart."""
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


def _person_number(content: dict[str, Any]) -> int | None:
    """Return the number of a person; AlphaPose's may be a list, or a whole number written as 1.0."""
    value = next((content[key] for key in _ID_KEYS if content.get(key) is not None), None)
    while isinstance(value, list):
        value = value[0] if value else None
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if _is_count(value) else None


def _places_of_ids(items: Sequence[_Item]) -> dict[int | str, Place]:
    """Return video and frame by what results call their images: numbers are frames, names tell theirs."""
    for item in items:
        if not _is_count(item.image) and not (isinstance(item.image, str) and item.image):
            allowed = f"a whole number from 0 to {MAX_COUNT}, or an image's name"
            raise FormatError(f"{item.where}: 'image_id' or 'frame_id' must be {allowed}")
    ids = {item.image for item in items}
    if all(isinstance(image, int) for image in ids):
        return {image: ("", image) for image in ids}
    places = places_of_names(str(image) for image in ids)
    return {image: places[str(image)] for image in ids}


def _places_of_images(images: object) -> tuple[dict[int | str, Place], dict[str, tuple[int, int]]]:
    """Return video and frame by image id, and the size of the images of each video where all of them have the same.

    What images do not state themselves their file names tell, where those are different, else their order.
    """
    if not isinstance(images, list):
        raise FormatError("this is not a COCO file: it has no list 'images'")
    known: dict[int | str, dict[str, Any]] = {}
    for index, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), int | str):
            raise FormatError(f"image {index} has no 'id'")
        if image["id"] in known:
            raise FormatError(f"image {index}: its id {str(image['id'])[:40]!r} appears twice")
        if image.get("frame_id") is not None and not _is_count(image["frame_id"]):
            raise FormatError(f"image {index}: 'frame_id' must be a whole number from 0 to {MAX_COUNT}")
        known[image["id"]] = image
    is_stated = any(image.get(key) is not None for image in known.values() for key in ("video_id", "frame_id"))
    names = [image.get("file_name") for image in known.values()]
    by_name: dict[str, Place] = {}
    if not is_stated and all(isinstance(name, str) for name in names) and len(set(names)) == len(names):
        by_name = places_of_names(str(name) for name in names)
    counts: Counter[str] = Counter()
    places: dict[int | str, Place] = {}
    sizes: dict[str, set[tuple[int, int] | None]] = {}
    for image_id, image in known.items():
        video = str(image["video_id"]) if isinstance(image.get("video_id"), int | str) else ""
        frame = counts[video] if image.get("frame_id") is None else int(image["frame_id"])
        counts[video] += 1
        places[image_id] = by_name[image["file_name"]] if by_name else (video, frame)
        sizes.setdefault(places[image_id][0], set()).add(image_size(image))
    return places, {video: size for video, found in sizes.items() if len(found) == 1 for size in found if size}


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT
