"""Reading OpenPose keypoints: one JSON file per frame."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.annotated_frames import AnnotatedFrames, get_keypoint_layout
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import parse_json, parse_triples

__all__ = ["OpenPose", "OpenPoseFrame", "join_openpose_frames", "openpose_frame_number", "read_openpose_frame"]

Array = npt.NDArray[np.float64]

LAYOUT_OF_COUNT = {25: "body25", 18: "coco18"}
MAX_PEOPLE = 1000
MAX_CONFIDENCE = 10.0
"""Confidences are heights of a heat map: about 1 at most, but not exactly."""


@dataclass(frozen=True)
class OpenPoseFrame:
    """The people of one frame.

    Args:
        layout: body25 or coco18, told from the number of keypoints; None when nobody was seen.
        person_id: (person,) the file's ids where it has them, else the place in the file.
        keypoints_px: (person, K, 2), NaN where not detected.
        confidence: (person, K), 0 where not detected.
    """

    layout: str | None
    person_id: npt.NDArray[np.int64]
    keypoints_px: Array
    confidence: Array


class OpenPose(AnnotationFormat):
    """A folder of OpenPose files, one for each frame, which its name tells; they state no image size and no rate."""

    name = "openpose"
    recognised_by = "JSON with 'people'"
    suffixes = (".json",)
    is_file_per_frame = True

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is JSON with a list of people."""
        return start.is_json and '"people"' in start.text

    def frame_numbers(self, names: Sequence[str]) -> list[int]:
        """Return the frame that each file is of, by its name; one without a number is where it stands."""
        numbers = [openpose_frame_number(name) for name in names]
        return [index if number is None else number for index, number in enumerate(numbers)]

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the files of all frames; the one that is damaged is named."""
        frames: list[tuple[int, OpenPoseFrame]] = []
        skipped: list[str] = []
        for number, (name, data) in zip(self.frame_numbers(list(files)), files.items(), strict=True):
            try:
                frames.append((number, read_openpose_frame(data)))
            except FormatError as error:
                if not skip_unreadable:
                    raise FormatError(f'{name}: {error} (set on_unreadable = "skip" to go on without it)') from None
                skipped.append(name)
        return replace(join_openpose_frames(frames, sequence_id=sequence_id, layout=layout), skipped=tuple(skipped))


def openpose_frame_number(file_name: str) -> int | None:
    """Return the frame number that OpenPose wrote into a file name such as `walk_000000000012_keypoints.json`."""
    found = re.search(r"(\d{1,18})(?:_keypoints)?\.json$", file_name)
    return int(found.group(1)) if found else None


def read_openpose_frame(data: bytes | str) -> OpenPoseFrame:
    """Read the JSON of one frame, versions 1.0 to 1.7.  (0, 0) and confidence 0 both mean not detected.

    Raises:
        FormatError: Not JSON, not OpenPose, a wrong number of values, or a value that is no finite number.
    """
    content = parse_json(data, "OpenPose file")
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise FormatError("this is not an OpenPose file: it has no list 'people'")
    if len(people) > MAX_PEOPLE:
        raise FormatError(f"{len(people)} people in one frame; at most {MAX_PEOPLE} are allowed")
    values: list[Array] = []
    ids: list[int] = []
    for index, person in enumerate(people):
        numbers = person.get("pose_keypoints_2d", person.get("pose_keypoints")) if isinstance(person, dict) else None
        if not isinstance(numbers, list):
            raise FormatError(f"person {index} has no list 'pose_keypoints_2d'")
        if not numbers:
            continue
        if len(numbers) % 3 or len(numbers) // 3 not in LAYOUT_OF_COUNT:
            raise FormatError(
                f"person {index} has {len(numbers)} values in 'pose_keypoints_2d'; "
                "allowed: 75 (BODY_25) and 54 (COCO-18)"
            )
        if values and len(numbers) != values[0].size:
            raise FormatError(f"person {index} has {len(numbers)} values, person 0 has {values[0].size}")
        values.append(parse_triples(numbers, f"person {index}: 'pose_keypoints_2d'"))
        ids.append(_person_id(person, index))
    if not values:
        return OpenPoseFrame(
            layout=None, person_id=np.zeros(0, np.int64), keypoints_px=np.zeros((0, 0, 2)), confidence=np.zeros((0, 0))
        )
    if len(set(ids)) != len(ids):
        ids = list(range(len(ids)))
    table = np.stack(values)
    confidence = table[..., 2]
    if (confidence < 0).any() or (confidence > MAX_CONFIDENCE).any():
        raise FormatError(f"a confidence lies outside 0..{MAX_CONFIDENCE:g}")
    is_seen = (confidence > 0) & (table[..., :2] != 0).any(axis=-1)
    return OpenPoseFrame(
        layout=LAYOUT_OF_COUNT[table.shape[1]],
        person_id=np.array(ids, dtype=np.int64),
        keypoints_px=np.where(is_seen[..., None], table[..., :2], np.nan),
        confidence=np.where(is_seen, confidence, 0.0),
    )


def join_openpose_frames(
    frames: Sequence[tuple[int, OpenPoseFrame]],
    *,
    sequence_id: str,
    layout: str = "auto",
    image_size_px: tuple[int, int] | None = None,
) -> AnnotatedFrames:
    """Join the frames of one sequence, given as (frame number, frame).

    Raises:
        InputError: The layout asked for is not the one of the files, two layouts in one sequence, nobody in any frame,
            or coordinates that are shares of the image instead of pixels.
    """
    found = sorted({frame.layout for _, frame in frames if frame.layout})
    if not found:
        raise InputError(f"sequence '{sequence_id}': nobody was detected in any of its {len(frames)} frames")
    if len(found) > 1:
        raise InputError(f"sequence '{sequence_id}': files of different layouts: {', '.join(found)}")
    if layout not in {"auto", found[0]}:
        count = get_keypoint_layout(found[0]).num_keypoints
        raise InputError(
            f"sequence '{sequence_id}': the layout '{layout}' is asked for, but the files have {count} keypoints: "
            f"'{found[0]}'"
        )
    people = [(number, frame) for number, frame in frames if len(frame.person_id)]
    keypoints = np.concatenate([frame.keypoints_px for _, frame in people])
    if np.isfinite(keypoints).any() and np.nanmax(np.abs(keypoints)) <= 2.0:
        raise InputError(
            f"sequence '{sequence_id}': all coordinates lie within 2; they seem to be shares of the image, not pixels "
            "(run OpenPose with --keypoint_scale 0)"
        )
    counts = [len(frame.person_id) for _, frame in people]
    return AnnotatedFrames(
        layout=found[0],
        sequence_id=(sequence_id,) * sum(counts),
        frame=np.repeat(np.array([number for number, _ in people], dtype=np.int64), counts),
        person_id=np.concatenate([frame.person_id for _, frame in people]),
        keypoints_px=keypoints,
        confidence=np.concatenate([frame.confidence for _, frame in people]),
        image_size_px=image_size_px,
        has_identities=False,
    )


def _person_id(person: dict[str, Any], index: int) -> int:
    value = person.get("person_id", index)
    value = value[0] if isinstance(value, list) and value else value
    is_known = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1_000_000
    return value if is_known else index
