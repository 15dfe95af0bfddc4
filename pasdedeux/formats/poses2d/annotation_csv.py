"""The CSV format of this project for 2D annotations, which a spreadsheet can write.

It has a header line and a row per keypoint, columns in any order::

    # layout: pair17
    # image_size: 1920x1080
    # rate_hz: 30
    # focal_px: 1400
    sequence,frame,person,joint,x,y,confidence
    clip1,0,0,left_knee,812.5,640.0,0.93

The lines that start with `#` are optional; without them the layout follows from the names of the joints.  `confidence`
is 1 by default.  A keypoint is missing if it is not listed, x or y is empty or NaN, or the confidence is 0.  The column
`status` is optional and has the origin of a keypoint: annotated, detected, tracked, interpolated or missing.
"""

from __future__ import annotations

import math
import re

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.poses2d.annotated_frames import (
    FOCAL_PX,
    MAX_IMAGE_PX,
    RATE_HZ,
    AnnotatedFrames,
    KeypointStatus,
    get_keypoint_layout,
)
from pasdedeux.formats.poses2d.detections import MAX_CONFIDENCE, arrange, detections_of_joints, number_people
from pasdedeux.formats.text import Lines, parse_cell, parse_integer, parse_number, shorten
from pasdedeux.plain_text import csv_line, from_cell
from pasdedeux.skeletons.layouts import KeypointLayout

COLUMNS = ("sequence", "frame", "person", "joint", "x", "y", "confidence", "status")
_NEEDED = ("frame", "joint", "x", "y")
_PASSED_OVER = ("image", "image_name", "filename", "file_name")
"""Columns that tools add and that are ignored: `frame` identifies the image."""


def read_annotation_csv(
    data: bytes | str, sequence_id: str = "sequence", layout: str | KeypointLayout = "auto"
) -> AnnotatedFrames:
    """Read our CSV of 2D annotations.

    Args:
        data: The file.
        sequence_id: Name of the sequence if the file has no column `sequence`.
        layout: Layout of the keypoints; "auto" takes the stated layout, or the only one that has all joints.
    """
    size = rate_hz = focal_px = None
    people: dict[tuple[str, int, int | str], dict[str, tuple[float, float, float, float]]] = {}
    with Lines(data, "annotation table") as lines:
        for key, value in lines.notes():
            match key:
                case "layout":
                    layout = value if layout == "auto" else layout
                case "image_size":
                    sides = value.lower().partition("x")[::2]
                    named = zip(sides, ("image width", "image height"), strict=True)
                    width, height = (parse_integer(side.strip(), what, 1, MAX_IMAGE_PX) for side, what in named)
                    size = (width, height)
                case "rate_hz":
                    rate_hz = parse_number(value, "the frame rate", *RATE_HZ)
                case "focal_px":
                    focal_px = parse_number(value, "the focal length", *FOCAL_PX)
        for row in lines.table(_NEEDED, (*COLUMNS, *_PASSED_OVER))[1]:
            frame, word = parse_integer(_whole(row["frame"]), "frame"), _whole(row.get("person", "0"))
            person = word if any(map(str.isalpha, word)) else parse_integer(word, "person")
            joints = people.setdefault((from_cell(row.get("sequence", "")) or sequence_id, frame, person), {})
            if row["joint"] in joints:
                raise FormatError(f"'{shorten(row['joint'])}' twice for person {person} in frame {frame}")
            x, y = (parse_cell(row[axis], axis) for axis in "xy")
            confidence = parse_number(row.get("confidence", "1") or "0", "confidence", 0, MAX_CONFIDENCE)
            joints[row["joint"]] = (x, y, confidence, _status_of(row["status"]) if "status" in row else math.nan)
    if not people:
        raise FormatError("this annotation table has no rows")
    detections = detections_of_joints(people)
    arranged = arrange(detections, layout, is_strict=True)
    numbers, has_identities, remarks = number_people(detections)
    sequences = tuple(detection.place[0] for detection in detections)
    return AnnotatedFrames.of(
        arranged.layout,
        sequence_id=sequences,
        frame=np.array([detection.place[1] for detection in detections], dtype=np.int64),
        person_id=np.array(numbers, dtype=np.int64),
        keypoints_px=arranged.table[..., :2],
        confidence=arranged.table[..., 2],
        image_size_px=dict.fromkeys(sequences, size) if size else {},
        rate_hz=rate_hz,
        focal_px=dict.fromkeys(sequences, focal_px) if focal_px else {},
        has_identities=has_identities,
        status=arranged.status,
        remarks=(*arranged.remarks, *remarks),
    )


def write_annotation_csv(frames: AnnotatedFrames) -> str:
    """Write annotations as this CSV, without missing keypoints."""
    sizes, focals = set(frames.image_size_px.values()), set(frames.focal_px.values())
    notes = [f"# layout: {frames.layout}"]
    notes += [f"# image_size: {width}x{height}" for width, height in sizes] if len(sizes) == 1 else []
    notes += [f"# rate_hz: {frames.rate_hz:.10g}"] if frames.rate_hz else []
    notes += [f"# focal_px: {focal:.10g}" for focal in focals] if len(focals) == 1 else []
    names = get_keypoint_layout(frames.layout).keypoint_names
    lines = [*notes, ",".join(COLUMNS if frames.status is not None else COLUMNS[:-1])]
    for row, keypoint in np.argwhere(frames.confidence > 0).tolist():
        x, y = frames.keypoints_px[row, keypoint]
        place = (frames.sequence_id[row], frames.frame[row], frames.person_id[row], names[keypoint])
        end = [] if frames.status is None else [KeypointStatus(frames.status[row, keypoint]).name.lower()]
        lines.append(csv_line(*place, f"{x:.2f}", f"{y:.2f}", f"{frames.confidence[row, keypoint]:.3g}", *end))
    return "".join(f"{line}\n" for line in lines)


ANNOTATION_CSV = AnnotationFormat(
    name="annotation_csv",
    suffixes=(".csv",),
    recognises=lambda start: set(_NEEDED) <= set(start.columns),
    read_file=read_annotation_csv,
)
"""Our CSV, which may state layout, image size, rate and focal length."""


def _whole(word: str) -> str:
    """Remove the `.0` that tables of floats append to a whole number."""
    return re.sub(r"(?<=\d)\.0+$", "", word)


def _status_of(word: str) -> int:
    try:
        return KeypointStatus[word.upper()]
    except KeyError:
        allowed = ", ".join(status.name.lower() for status in KeypointStatus)
        raise FormatError(f"status '{shorten(word)}' is none of {allowed}") from None
