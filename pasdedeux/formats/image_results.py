"""Reading what detectors write for each image of a folder: mmpose's predictions and Ultralytics' `to_json`."""

from __future__ import annotations

import re

from pasdedeux.errors import FormatError
from pasdedeux.formats.coco import keypoint_table, person_number
from pasdedeux.formats.detections import Detection
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import parse_json

_OTHERS = (
    "people",
    "landmarks",
    "pose_landmarks",
    "image_id",
    "images",
    "annotations",
    "instances",
    "frame_id",
    "frame",
)
"""Keys of JSON that holds a whole video, or is of another format."""
_POINT = re.compile(r'"x"\s*:\s*-?\d')


def read_image_results(data: bytes) -> list[Detection]:
    """Read the people of one image: `keypoints` as points with `keypoint_scores`, triples, or lists x, y, visible.

    mmpose writes such a list for each image, alone or as `instance_info` beside its `meta_info`; Ultralytics' results
    give it by `to_json`, with objects that are no people among them.

    Raises:
        FormatError: It is no such list, or a value is no number; the person is named.
    """
    content = parse_json(data, "JSON file", has_nan=True)
    people = content.get("instance_info") if isinstance(content, dict) else content
    if not isinstance(people, list):
        raise FormatError("this is no list of people with 'keypoints'")
    found = []
    for index, person in enumerate(people):
        where = f"person {index}"
        if not isinstance(person, dict) or not isinstance(person.get("keypoints", []), list | dict):
            raise FormatError(f"{where} is no object with 'keypoints'")
        if person.get("keypoints"):
            found.append(Detection(("", 0), person_number(person), keypoint_table(person, where), where))
    return found


def _is_image(start: FileStart) -> bool:
    """Tell whether the file is JSON of people with keypoints that does not say of which image they are."""
    if not start.is_json or '"keypoints"' not in start.text or _POINT.search(start.text):
        return False
    return not any(f'"{key}"' in start.text for key in _OTHERS)


IMAGE_RESULTS = AnnotationFormat(
    name="image_results",
    recognised_by="JSON list of one image's people with 'keypoints'",
    suffixes=(".json",),
    recognises=_is_image,
    read_people=read_image_results,
)
