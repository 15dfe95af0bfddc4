"""Reading COCO keypoint JSON with the 17 keypoints of a person: annotations of images, or a detector's results."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import parse_json, parse_triples
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

__all__ = ["Coco", "read_coco"]

_NUM_KEYPOINTS = KEYPOINT_LAYOUTS["coco17"].num_keypoints
_CONFIDENCE_OF_VISIBILITY = np.array([0.0, 0.5, 1.0])
"""COCO's v: 0 not labelled, 1 labelled but hidden, 2 labelled and visible."""
_MAX_FRAME = 1_000_000_000


class Coco(AnnotationFormat):
    """COCO keypoints: they may state the size of the images, never the rate."""

    name = "coco"
    recognised_by = "JSON with 'annotations', 'images' or 'keypoints'"
    suffixes = (".json",)

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is JSON with one of COCO's keys, and not OpenPose's."""
        keys = ('"keypoints"', '"annotations"', '"images"')
        return start.is_json and '"people"' not in start.text and any(key in start.text for key in keys)

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the one file."""
        (data,) = files.values()
        return read_coco(data, sequence_id=sequence_id)


def read_coco(data: bytes | str, *, sequence_id: str) -> AnnotatedFrames:
    """Read COCO keypoints.

    With a list `images`, frames are the images in the order of `frame_id` or `id`, sequences are their `video_id` where
    they have one, and v = 0 means missing.  A plain list is taken as results: the third number is a confidence and
    `image_id` the frame.  People are numbered by `track_id` where every annotation has one, else by their order.

    Raises:
        FormatError: Not JSON, not COCO keypoints, other than 17 keypoints, a visibility other than 0, 1, 2, an
            unknown image, or a value that is no finite number.
    """
    content = parse_json(data, "COCO file")
    is_results = isinstance(content, list)
    annotations = content if is_results else content.get("annotations") if isinstance(content, dict) else None
    if not isinstance(annotations, list):
        raise FormatError("this is not a COCO file: it has no list 'annotations'")
    images = {} if is_results else _images(content)
    people = [item for item in annotations if not (isinstance(item, dict) and not item.get("keypoints", True))]
    if not people:
        raise FormatError("this COCO file holds no keypoints")
    keypoints, confidences, keys = [], [], []
    has_tracks = all(isinstance(item, dict) and _is_integer(item.get("track_id")) for item in people)
    counts: dict[tuple[str, int], int] = {}
    for index, item in enumerate(people):
        where = f"annotation {index}"
        if not isinstance(item, dict) or not isinstance(item.get("keypoints"), list):
            raise FormatError(f"{where} has no list 'keypoints'")
        numbers = item["keypoints"]
        if len(numbers) != 3 * _NUM_KEYPOINTS:
            raise FormatError(
                f"{where} has {len(numbers)} values in 'keypoints'; {3 * _NUM_KEYPOINTS} are allowed (17 keypoints)"
            )
        table = parse_triples(numbers, f"{where}: 'keypoints'")
        if is_results:
            confidence = table[:, 2]
            if (confidence < 0).any() or (confidence > 10).any():
                raise FormatError(f"{where}: a confidence lies outside 0..10")
        else:
            if not np.isin(table[:, 2], [0, 1, 2]).all():
                raise FormatError(f"{where}: a visibility is none of 0, 1, 2")
            confidence = _CONFIDENCE_OF_VISIBILITY[table[:, 2].astype(int)]
        image_id = item.get("image_id")
        if is_results:
            if not isinstance(image_id, int) or not _is_integer(image_id):
                raise FormatError(f"{where}: 'image_id' must be a whole number from 0 to {_MAX_FRAME}")
            place = (sequence_id, image_id)
        elif not isinstance(image_id, int | str) or image_id not in images:
            raise FormatError(f"{where}: its 'image_id' is not among the images")
        else:
            video, frame = images[image_id]
            place = (f"{sequence_id}.{video}" if video else sequence_id, frame)
        person = int(item["track_id"]) if has_tracks else counts.get(place, 0)
        counts[place] = counts.get(place, 0) + 1
        keypoints.append(np.where((confidence > 0)[:, None], table[:, :2], np.nan))
        confidences.append(confidence)
        keys.append((*place, person))
    return AnnotatedFrames(
        layout="coco17",
        sequence_id=tuple(key[0] for key in keys),
        frame=np.array([key[1] for key in keys], dtype=np.int64),
        person_id=np.array([key[2] for key in keys], dtype=np.int64),
        keypoints_px=np.array(keypoints),
        confidence=np.array(confidences),
        image_size_px=None if is_results else _common_size(content),
        has_identities=has_tracks,
    )


def _images(content: dict[str, Any]) -> dict[int | str, tuple[str, int]]:
    """Return for each image id its video's name and its frame number there."""
    images = content.get("images")
    if not isinstance(images, list):
        raise FormatError("this is not a COCO file: it has no list 'images'")
    result: dict[int | str, tuple[str, int]] = {}
    counts: dict[str, int] = {}
    for index, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), int | str):
            raise FormatError(f"image {index} has no 'id'")
        if image["id"] in result:
            raise FormatError(f"image {index}: its id {str(image['id'])[:40]!r} appears twice")
        video = (
            re.sub(r"[^A-Za-z0-9_-]", "_", str(image["video_id"]))[:100]
            if isinstance(image.get("video_id"), int | str)
            else ""
        )
        frame = image.get("frame_id")
        if frame is None:
            frame = counts.get(video, 0)
            counts[video] = frame + 1
        elif not _is_integer(frame):
            raise FormatError(f"image {index}: 'frame_id' must be a whole number from 0 to {_MAX_FRAME}")
        result[image["id"]] = (video, int(frame))
    return result


def _common_size(content: dict[str, Any]) -> tuple[int, int] | None:
    """Return the size that all images share, None where they differ or do not say."""
    sizes = {(image.get("width"), image.get("height")) for image in content["images"] if _has_size(image)}
    if len(sizes) != 1 or not all(_has_size(image) for image in content["images"]):
        return None
    width, height = sizes.pop()
    return int(width), int(height)


def _has_size(image: dict[str, Any]) -> bool:
    return all(_is_integer(image.get(key)) and 0 < image[key] < 100_000 for key in ("width", "height"))


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MAX_FRAME
