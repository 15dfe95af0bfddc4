"""Reading OpenPose keypoints, also written by other tools: one JSON file per frame."""

from __future__ import annotations

from typing import Any

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.poses2d.detections import Detection
from pasdedeux.formats.poses2d.image_names import number_in_name
from pasdedeux.formats.text import MAX_COUNT, parse_json, parse_triples
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import LAYOUTS_OF_COUNT

MAX_PEOPLE = 1000


def read_people(data: bytes | str) -> list[Detection]:
    """Read the JSON of one frame, versions 1.0 to 1.7.  (0, 0) and confidence 0 both mean not detected."""
    content = parse_json(data, "OpenPose file")
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise FormatError("this is not an OpenPose file: it has no list 'people'")
    if len(people) > MAX_PEOPLE:
        raise FormatError(f"{len(people)} people in one frame; at most {MAX_PEOPLE} are allowed")
    detections = []
    for index, person in enumerate(people):
        where = f"person {index}"
        named = person if isinstance(person, dict) else {}
        numbers = named.get("pose_keypoints_2d", named.get("pose_keypoints"))
        if not isinstance(numbers, list):
            raise FormatError(f"{where} has no list 'pose_keypoints_2d'")
        if not numbers:
            continue
        if len(numbers) % 3 or len(numbers) // 3 not in LAYOUTS_OF_COUNT:
            counts = ", ".join(
                f"{3 * count} ({' or '.join(kind.name for kind in kinds)})" for count, kinds in LAYOUTS_OF_COUNT.items()
            )
            raise FormatError(f"{where} has {counted(len(numbers), 'value')} in 'pose_keypoints_2d'; allowed: {counts}")
        table = parse_triples(numbers, f"{where}: 'pose_keypoints_2d'")
        detections.append(Detection(("", 0), _person_id(named, index), table, where))
    return detections


OPENPOSE = AnnotationFormat(
    name="openpose",
    suffixes=(".json",),
    recognises=lambda start: start.has_key("people") and not start.is_by_frame,
    read_people=read_people,
)
"""Files of OpenPose, Pose2Sim, RTMPose and other tools; the layout follows from the number of keypoints."""


def openpose_frame_number(file_name: str) -> int | None:
    """Return the frame number in a file name such as `walk_000000000012_keypoints.json`."""
    number = number_in_name(file_name)[1] if file_name.endswith(".json") else None
    return None if number is None or number > MAX_COUNT else number


def _person_id(person: dict[str, Any], index: int) -> int | None:
    """Return the number of a person; -1, which OpenPose writes, and the position in the list do not count."""
    value = person.get("person_id")
    value = value[0] if isinstance(value, list) and value else value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1_000_000 and value != index:
        return value
    return None
