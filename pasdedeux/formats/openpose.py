"""Reading OpenPose keypoints, and what others write in the same form: one JSON file per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import MAX_FRAME, Detection, Place, join_detections, number_in_name
from pasdedeux.formats.file_format import FileStart
from pasdedeux.formats.frame_files import FrameFiles
from pasdedeux.formats.text import parse_json, parse_triples
from pasdedeux.skeletons.layouts import LAYOUT_OF_COUNT

MAX_PEOPLE = 1000


@dataclass(frozen=True)
class OpenPoseFrame:
    """The people of one frame.

    Args:
        layout: The layout of as many keypoints; None when nobody was seen.
        person_id: (person,) the file's ids where it has them, else the place in the file.
        keypoints_px: (person, K, 2), NaN where not detected.
        confidence: (person, K), 0 where not detected.
    """

    layout: str | None
    person_id: npt.NDArray[np.int64]
    keypoints_px: Array
    confidence: Array


class OpenPose(FrameFiles):
    """OpenPose's files; Pose2Sim, RTMPose's and other tools write the same, with layouts told by their size."""

    name = "openpose"
    recognised_by = "JSON with 'people'"

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is JSON with a list of people."""
        return start.is_json and '"people"' in start.text

    def detections(self, data: bytes | str, place: Place, name: str) -> list[Detection]:
        """Return the people of one frame, versions 1.0 to 1.7."""
        content = parse_json(data, "OpenPose file", has_nan=True)
        people = content.get("people") if isinstance(content, dict) else None
        if not isinstance(people, list):
            raise FormatError("this is not an OpenPose file: it has no list 'people'")
        if len(people) > MAX_PEOPLE:
            raise FormatError(f"{len(people)} people in one frame; at most {MAX_PEOPLE} are allowed")
        found = []
        for index, person in enumerate(people):
            where = f"person {index}"
            numbers = (
                person.get("pose_keypoints_2d", person.get("pose_keypoints")) if isinstance(person, dict) else None
            )
            if not isinstance(numbers, list):
                raise FormatError(f"{where} has no list 'pose_keypoints_2d'")
            if not numbers:
                continue
            if len(numbers) % 3 or len(numbers) // 3 not in LAYOUT_OF_COUNT:
                counts = ", ".join(f"{3 * count} ({layout.name})" for count, layout in sorted(LAYOUT_OF_COUNT.items()))
                raise FormatError(f"{where} has {len(numbers)} values in 'pose_keypoints_2d'; allowed: {counts}")
            table = parse_triples(numbers, f"{where}: 'pose_keypoints_2d'")
            found.append(Detection(place, _person_id(person, index), table, f"{name}: {where}" if name else where))
        return found


def openpose_frame_number(file_name: str) -> int | None:
    """Return the frame number in a file name such as `walk_000000000012_keypoints.json`."""
    number = number_in_name(file_name)[1] if file_name.endswith(".json") else None
    return None if number is None or number > MAX_FRAME else number


def read_openpose_frame(data: bytes | str) -> OpenPoseFrame:
    """Read the JSON of one frame, versions 1.0 to 1.7.  (0, 0) and confidence 0 both mean not detected.

    Raises:
        FormatError: Not JSON, not OpenPose, a number of keypoints that no layout has, or a value that is no number.
    """
    detections = OpenPose().detections(data, ("", 0), "")
    if not detections:
        return OpenPoseFrame(
            layout=None, person_id=np.zeros(0, np.int64), keypoints_px=np.zeros((0, 0, 2)), confidence=np.zeros((0, 0))
        )
    joined = join_detections(detections, sequence_id="frame")
    return OpenPoseFrame(joined.layout, joined.person_id, joined.keypoints_px, joined.confidence)


def join_openpose_frames(frames: Sequence[tuple[int, OpenPoseFrame]], *, sequence_id: str) -> AnnotatedFrames:
    """Return the frames of one video, given as (frame number, frame), as annotations.

    Raises:
        FormatError: Two layouts in one video.
        InputError: Nobody in any frame.
    """
    return join_detections(
        [
            Detection(("", number), int(person_id), np.column_stack([points, confidence]), f"frame {number}")
            for number, frame in frames
            for person_id, points, confidence in zip(frame.person_id, frame.keypoints_px, frame.confidence, strict=True)
        ],
        sequence_id=sequence_id,
    )


def _person_id(person: dict[str, Any], index: int) -> int | None:
    """Return the file's number of a person; -1, which OpenPose writes, and the place in the list are none."""
    value = person.get("person_id")
    value = value[0] if isinstance(value, list) and value else value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1_000_000 and value != index:
        return value
    return None
