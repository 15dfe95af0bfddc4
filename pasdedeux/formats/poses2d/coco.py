"""Reading COCO keypoint JSON and its variants by mmpose, ViTPose, Detectron2, Ultralytics and AlphaPose."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, get_keypoint_layout
from pasdedeux.formats.poses2d.detections import (
    CONFIDENCE_OF_VISIBILITY,
    MAX_CONFIDENCE,
    Detection,
    image_size,
    join_detections,
    known_footage,
)
from pasdedeux.formats.poses2d.image_names import FramePlace, places_of_names
from pasdedeux.formats.text import MAX_COUNT, parse_json, parse_triples
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import KeypointLayout

_ID_KEYS = ("track_id", "idx", "person_id", "instance_id")
"""Keys of a person's number: `track_id` of COCO and trackers, `idx` of AlphaPose."""
_FRAME_KEYS = ("frame_id", "frame_index", "frame")
_IMAGE_KEYS = ("image_id", "annotations", "images", "instances")
_LANDMARK_KEYS = ("landmarks", "pose_landmarks")


@dataclass(frozen=True)
class _PersonEntry:
    """An entry for a person in the image with this id, number or name."""

    image: Any
    content: dict[str, Any]
    where: str


def read_coco(data: bytes | str, sequence_id: str, layout: str | KeypointLayout = "auto") -> AnnotatedFrames:
    """Read COCO keypoints: annotations, or results of mmpose, ViTPose, Detectron2, Ultralytics or AlphaPose.

    In a file with a list `images`, the third number of a keypoint is COCO's visibility (0 means missing) or a
    confidence.  Video and frame of an image are its `video_id` and `frame_id`, else follow from its file name, else
    from its position in the list.  CVAT writes `track_id` and `keyframe` as `attributes`; other frames than key frames
    are interpolated.  In a list of results the third number is a confidence, and `image_id` is the frame or the name of
    the image.  The format of mmpose has a list of frames with `instances`, with separate `keypoint_scores`.  People are
    numbered by `track_id` or AlphaPose's `idx` if everybody has a different one, else by their order.
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
    categories = _names_of_categories(named)
    if isinstance(meta := named.get("meta_info"), dict) and isinstance(meta.get("keypoint_id2name"), dict):
        categories = {None: tuple(map(str, meta["keypoint_id2name"].values()))}
    if footage.image_size_px:
        sizes = sizes or {video: footage.image_size_px for video, _ in places.values()}
    has_keyframes = is_annotations and any("keyframe" in _attributes(item.content) for item in items)
    detections = []
    for item in items:
        if not isinstance(item.image, int | str) or item.image not in places:
            raise FormatError(f"{item.where}: its 'image_id' is not among the images")
        table = _keypoint_table(item.content, item.where)
        status = _own_status(item.content, item.where) if is_annotations else None
        if status is not None:
            table[:, 2] = np.where(table[:, 2] > 0, item.content["keypoint_scores"], 0.0)
        elif is_annotations and not (np.isnan(seen := table[:, 2]) | (abs(seen - 0.5) <= 0.5) | (seen == 2)).all():
            raise FormatError(f"{item.where}: a visibility is none of 0, 1, 2, and no confidence up to 1")
        if has_keyframes:
            is_key = _attributes(item.content).get("keyframe", True)
            status = (KeypointStatus.ANNOTATED if is_key else KeypointStatus.INTERPOLATED,) * len(table)
        names = _names_of(item.content, categories, len(table))
        detections.append(Detection(places[item.image], _person_id(item.content), table, item.where, status, names))
    return join_detections(detections, sequence_id=sequence_id, layout=layout, sizes_px=sizes, rate_hz=footage.rate_hz)


def _names_of_categories(content: dict[str, Any]) -> dict[Any, tuple[str, ...]]:
    """Return the keypoint names of each category."""
    categories = content.get("categories")
    named = [category for category in categories if isinstance(category, dict)] if isinstance(categories, list) else []
    return {
        category["id"]: tuple(map(str, category["keypoints"]))
        for category in named
        if isinstance(category.get("keypoints"), list)
        and isinstance(category.get("id"), int | str)
        and category["keypoints"]
    }


def _names_of(person: dict[str, Any], categories: dict[Any, tuple[str, ...]], count: int) -> tuple[str, ...] | None:
    """Return the names of a person's keypoints; None if no category has `count` names."""
    category = person.get("category_id")
    fitting = [names for number, names in categories.items() if category in (number, None) or len(categories) == 1]
    return next((names for names in fitting if len(names) == count), None)


def read_image_results(data: bytes) -> list[Detection]:
    """Read the people of one image: `keypoints` as points with `keypoint_scores`, triples, or lists x, y, visible.

    mmpose writes such a list for each image, alone or as `instance_info` beside `meta_info`; so does `to_json` of
    Ultralytics' results, which also contains other objects.
    """
    content = parse_json(data, "JSON file")
    people = content.get("instance_info") if isinstance(content, dict) else content
    if not isinstance(people, list):
        raise FormatError("this is no list of people with 'keypoints'")
    detections = []
    for index, person in enumerate(people):
        where = f"person {index}"
        if not isinstance(person, dict) or not isinstance(person.get("keypoints", []), list | dict):
            raise FormatError(f"{where} is no object with 'keypoints'")
        if person.get("keypoints"):
            detections.append(Detection(("", 0), _person_id(person), _keypoint_table(person, where), where))
    return detections


def write_coco(frames: AnnotatedFrames) -> str:
    """Return annotations of one film as COCO keypoints, images named by their frames.

    Beside COCO's visibility there are `keypoint_scores` and `keypoint_status` (`KeypointStatus`), which other tools
    ignore; without them, a keypoint of low confidence would be read back as labelled but hidden.
    """
    names = get_keypoint_layout(frames.layout).keypoint_names
    size = next(iter(frames.image_size_px.values()), None)
    sides = {"width": size[0], "height": size[1]} if size else {}
    numbers = np.unique(frames.frame).tolist()
    images = [{"id": at, "file_name": f"frame_{at:06d}.jpg", "frame_id": at, **sides} for at in numbers]
    people = []
    for row in range(frames.num_rows):
        sure, points = frames.confidence[row], np.nan_to_num(np.round(frames.keypoints_px[row], 2))
        visibility = np.where(sure > CONFIDENCE_OF_VISIBILITY[1], 2, np.where(sure > 0, 1, 0))
        seen = points[sure > 0]
        low, sides_px = seen.min(axis=0), np.ptp(seen, axis=0)
        triples = [[x, y, int(v)] for (x, y), v in zip(points.tolist(), visibility, strict=True)]
        extra = {} if frames.status is None else {"keypoint_status": frames.status[row].tolist()}
        people.append(
            {
                "id": row + 1,
                "image_id": int(frames.frame[row]),
                "category_id": 1,
                "track_id": int(frames.person_id[row]),
                "keypoints": [number for triple in triples for number in triple],
                "num_keypoints": int((sure > 0).sum()),
                "bbox": np.round([*low, *sides_px], 2).tolist(),
                "area": round(float(np.prod(sides_px)), 2),
                "iscrowd": 0,
                "keypoint_scores": np.round(sure, 4).tolist(),
                **extra,
            }
        )
    category = {"id": 1, "name": "person", "keypoints": list(names), "skeleton": []}
    rate = {"info": {"fps": frames.rate_hz}} if frames.rate_hz else {}
    return json.dumps({**rate, "images": images, "annotations": people, "categories": [category]})


def _own_status(content: dict[str, Any], where: str) -> tuple[int, ...] | None:
    """Return the statuses in a file of `write_coco`; None in files of other tools."""
    status, scores = content.get("keypoint_status"), content.get("keypoint_scores")
    if not isinstance(status, list) or not isinstance(scores, list):
        return None
    is_whole = len(status) == len(scores) == len(content["keypoints"]) // 3
    if not is_whole or not all(code in list(KeypointStatus) for code in status):
        raise FormatError(f"{where}: 'keypoint_status' needs a whole number from 0 to 4 for each keypoint")
    if not all(isinstance(score, int | float) and 0 <= score <= MAX_CONFIDENCE for score in scores):
        raise FormatError(f"{where}: 'keypoint_scores' lie outside 0..{MAX_CONFIDENCE:g}")
    return tuple(status)


def _is_coco(start: FileStart) -> bool:
    if start.has_points or start.has_key("people", *_LANDMARK_KEYS):
        return False
    return start.has_key(*_IMAGE_KEYS) or start.text.split() in (["[]"], ["[", "]"])


def _is_image_result(start: FileStart) -> bool:
    others = ("people", *_LANDMARK_KEYS, *_IMAGE_KEYS, "frame_id", "frame")
    return start.has_key("keypoints") and not start.has_points and not start.is_by_frame and not start.has_key(*others)


COCO = AnnotationFormat(
    name="coco",
    suffixes=(".json",),
    recognises=_is_coco,
    read_file=read_coco,
)
"""COCO keypoints; the file may state the image size, rarely the rate."""
IMAGE_RESULTS = AnnotationFormat(
    name="image_results",
    suffixes=(".json",),
    recognises=_is_image_result,
    read_people=read_image_results,
)
"""A folder of results, a file for each image; the file name identifies the image."""


def _people(listed: list[Any]) -> Iterator[_PersonEntry]:
    """Yield people with keypoints from a list of annotations, of results, or of frames with `instances`.

    COCO has an empty list for crowds, and other tools write boxes without keypoints.  A file that has only boxes is
    refused.
    """
    missing = ""
    for index, entry in enumerate(listed):
        where = f"annotation {index}"
        content = entry if isinstance(entry, dict) else {}
        if isinstance(content.get("instances"), list):
            image = next((content[key] for key in _FRAME_KEYS if key in content), index)
            people = [(person, f"{where}, person {number}") for number, person in enumerate(content["instances"])]
        else:
            image, people = content.get("image_id"), [(entry, where)]
        for person, inside in people:
            keypoints = person.get("keypoints") if isinstance(person, dict) else ""
            if keypoints is not None and not isinstance(keypoints, list):
                raise FormatError(f"{inside} has no list 'keypoints'")
            if keypoints is None:
                missing = missing or inside
            elif keypoints:
                missing = "-"
                yield _PersonEntry(image, person, inside)
    if missing not in ("", "-"):
        raise FormatError(f"{missing} has no list 'keypoints'")


def _keypoint_table(content: dict[str, Any], where: str) -> Array:
    """Return the keypoints (K, 3) of a person: flat triples, or points or lists x and y with separate scores."""
    numbers, scores = content["keypoints"], content.get("keypoint_scores")
    if isinstance(numbers, dict):
        x, y, scores = (numbers.get(key) for key in ("x", "y", "visible"))
        if not isinstance(x, list) or not isinstance(y, list) or len(x) != len(y):
            raise FormatError(f"{where}: 'keypoints' have no lists 'x' and 'y' of one length")
        numbers, scores = [list(point) for point in zip(x, y, strict=True)], scores or [1.0] * len(x)
    if all(isinstance(point, list) for point in numbers):
        if scores is None and all(len(point) == 3 for point in numbers):
            scores = [point[2] for point in numbers]
        if not isinstance(scores, list) or len(scores) != len(numbers) or any(len(point) < 2 for point in numbers):
            raise FormatError(f"{where}: 'keypoints' are points, which need as many 'keypoint_scores'")
        numbers = [value for point, score in zip(numbers, scores, strict=True) for value in (*point[:2], score)]
    if len(numbers) % 3:
        raise FormatError(
            f"{where} has {counted(len(numbers), 'value')} in 'keypoints', which are no triples x, y, confidence"
        )
    return parse_triples(numbers, f"{where}: 'keypoints'")


def _person_id(content: dict[str, Any]) -> int | str | None:
    """Return the number or name of a person; in AlphaPose it may be a list, or a whole number written as 1.0."""
    stated = {**_attributes(content), **content}
    value = next((stated[key] for key in _ID_KEYS if stated.get(key) is not None), None)
    while isinstance(value, list):
        value = value[0] if value else None
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if _is_count(value) or (isinstance(value, str) and value) else None


def _attributes(content: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of an annotation of CVAT."""
    attributes = content.get("attributes")
    return attributes if isinstance(attributes, dict) else {}


def _place_of_number(number: int) -> FramePlace | None:
    """Return video and frame of an image number, or None if it is not one.

    Numbers of PoseTrack have eleven digits: a 1, six for the video and four for the frame.
    """
    if number <= MAX_COUNT:
        return "", number
    return (str(number)[1:7], number % 10_000) if 10**10 <= number < 2 * 10**10 else None


def _places_of_ids(items: Sequence[_PersonEntry]) -> dict[int | str, FramePlace]:
    """Return video and frame of the images in results: numbers are frames, names contain the frame."""
    for item in items:
        is_number = isinstance(item.image, int) and not isinstance(item.image, bool) and item.image >= 0
        if not (is_number and _place_of_number(item.image)) and not (isinstance(item.image, str) and item.image):
            allowed = f"a whole number from 0 to {MAX_COUNT}, or an image's name"
            raise FormatError(f"{item.where}: 'image_id' or 'frame_id' must be {allowed}")
    ids = {item.image for item in items}
    if all(isinstance(image, int) for image in ids):
        by_image = {image: _place_of_number(image) or ("", 0) for image in ids}
        is_alone = len({video for video, _ in by_image.values()}) == 1
        return {image: ("" if is_alone else video, frame) for image, (video, frame) in by_image.items()}
    places = places_of_names(str(image) for image in ids)
    return {image: places[str(image)] for image in ids}


def _places_of_images(images: object) -> tuple[dict[int | str, FramePlace], dict[str, tuple[int, int]]]:
    """Return video and frame by image id, and the image size of each video if all its images have the same.

    If images do not state video and frame, these follow from different file names, else from the order.
    """
    if not isinstance(images, list):
        raise FormatError("this is not a COCO file: it has no list 'images'")
    known: dict[int | str, dict[str, Any]] = {}
    for index, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), int | str):
            raise FormatError(f"image {index} has no 'id'")
        if image["id"] in known:
            raise FormatError(f"image {index}: its id {str(image['id'])[:40]!r} appears twice")
        number, video = image.get("frame_id"), image.get("video_id", image.get("vid_id"))
        if type(number) is int and number > MAX_COUNT and (place := _place_of_number(number)):
            video, number = place if video is None else (video, place[1])
        if number is not None and not _is_count(number):
            raise FormatError(f"image {index}: 'frame_id' must be a whole number from 0 to {MAX_COUNT}")
        known[image["id"]] = {**image, "frame_id": number, "video_id": video}
    is_stated = any(image.get(key) is not None for image in known.values() for key in ("video_id", "frame_id"))
    names = [image.get("file_name") for image in known.values()]
    by_name: dict[str, FramePlace] = {}
    if not is_stated and all(isinstance(name, str) for name in names) and len(set(names)) == len(names):
        by_name = places_of_names(str(name) for name in names)
    counts: Counter[str] = Counter()
    places: dict[int | str, FramePlace] = {}
    sizes: dict[str, set[tuple[int, int] | None]] = {}
    for image_id, image in known.items():
        video = str(image["video_id"]) if isinstance(image.get("video_id"), int | str) else ""
        frame = counts[video] if image.get("frame_id") is None else int(image["frame_id"])
        counts[video] += 1
        places[image_id] = by_name[image["file_name"]] if by_name else (video, frame)
        sizes.setdefault(places[image_id][0], set()).add(image_size(image))
    return places, {video: size for video, (size, *others) in sizes.items() if size and not others}


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT
