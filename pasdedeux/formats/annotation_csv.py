"""Our own CSV of 2D annotations, which a spreadsheet can write.

A header line and a row per keypoint, columns in any order::

    # layout: pair17
    # image_size: 1920x1080
    # rate_hz: 30
    # focal_px: 1400
    sequence,frame,person,joint,x,y,confidence
    clip1,0,0,left_knee,812.5,640.0,0.93

The lines that start with `#` may be left out: the layout is then told from the joints' names.  `confidence` may be left
out (1).  Empty or NaN x and y, or confidence 0, mean missing; keypoints that are not listed are missing.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import (
    MAX_FOCAL_PX,
    MAX_IMAGE_PX,
    MAX_RATE_HZ,
    AnnotatedFrames,
    get_keypoint_layout,
)
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import decode, parse_integer, parse_number, shorten, split_lines
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

COLUMNS = ("sequence", "frame", "person", "joint", "x", "y", "confidence")
_NEEDED = ("frame", "person", "joint", "x", "y")


class AnnotationCsv(AnnotationFormat):
    """Our CSV: it may state layout, image size and rate."""

    name = "annotation_csv"
    recognised_by = "CSV with the columns frame, person, joint, x, y"
    suffixes = (".csv",)

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the header line has the needed columns."""
        return set(_NEEDED) <= {cell.strip().lower() for cell in start.first_row.split(",")}

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the one file."""
        (data,) = files.values()
        return read_annotation_csv(data, sequence_id=sequence_id, layout=layout)


def read_annotation_csv(data: bytes | str, *, sequence_id: str = "sequence", layout: str = "auto") -> AnnotatedFrames:
    """Read our CSV of 2D annotations.

    Args:
        data: The file.
        sequence_id: Name of the sequence where the file has no column for it.
        layout: Layout of the keypoints; "auto" takes the one the file states or the only one that has all its joints.

    Raises:
        FormatError: The file is mangled, or its layout cannot be told; the line is named.
    """
    lines = split_lines(decode(data, "annotation table"))
    notes: dict[str, tuple[int, str]] = {}
    start = 0
    while start < len(lines) and (not lines[start].strip() or lines[start].lstrip().startswith("#")):
        key, _, value = lines[start].lstrip().removeprefix("#").partition(":")
        notes[key.strip().lower()] = (start + 1, value.strip())
        start += 1
    if start == len(lines):
        raise FormatError(f"line {start}: the file ends without a header line")
    try:
        table = list(csv.reader(lines[start:], strict=True))
    except csv.Error as error:
        raise FormatError(f"this annotation table is not valid CSV: {error}") from None
    header = [name.strip().lower() for name in table[0]]
    for name in header:
        if name not in COLUMNS or header.count(name) > 1:
            raise FormatError(
                f"line {start + 1}: column '{shorten(name)}' is unknown or double; known: {', '.join(COLUMNS)}"
            )
    missing = [name for name in _NEEDED if name not in header]
    if missing:
        raise FormatError(f"line {start + 1}: column '{missing[0]}' is missing; needed: {', '.join(_NEEDED)}")

    people: dict[tuple[str, int, int], dict[str, tuple[float, float, float]]] = {}
    for offset, cells in enumerate(table[1:], start=start + 2):
        if not cells or not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise FormatError(f"line {offset}: {len(cells)} values, the header has {len(header)} columns")
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        person_key = (
            row.get("sequence") or sequence_id,
            _count(row["frame"], f"line {offset}: frame"),
            _count(row["person"], f"line {offset}: person"),
        )
        joints = people.setdefault(person_key, {})
        if row["joint"] in joints:
            raise FormatError(
                f"line {offset}: '{shorten(row['joint'])}' twice for person {person_key[2]} in frame {person_key[1]}"
            )
        joints[row["joint"]] = _keypoint(row, offset)
    if not people:
        raise FormatError("this annotation table has no rows")

    joint_names = {name for joints in people.values() for name in joints}
    if layout == "auto":
        layout = notes["layout"][1] if "layout" in notes else _layout_of(joint_names)
    known = get_keypoint_layout(layout)
    unknown = sorted(joint_names - set(known.keypoint_names))
    if unknown:
        raise FormatError(
            f"joint '{shorten(unknown[0])}' is not in the layout '{layout}'; known: {', '.join(known.keypoint_names)}"
        )
    keypoints = np.full((len(people), known.num_keypoints, 2), np.nan)
    confidence = np.zeros((len(people), known.num_keypoints))
    for index, joints in enumerate(people.values()):
        for name, (x, y, trust) in joints.items():
            column = known.keypoint_names.index(name)
            keypoints[index, column] = x, y
            confidence[index, column] = trust
    sequences = tuple(key[0] for key in people)
    size, focal = _image_size(notes), _number(notes, "focal_px", "the focal length", MAX_FOCAL_PX)
    return AnnotatedFrames(
        layout=layout,
        sequence_id=sequences,
        frame=np.array([key[1] for key in people], dtype=np.int64),
        person_id=np.array([key[2] for key in people], dtype=np.int64),
        keypoints_px=keypoints,
        confidence=confidence,
        image_size_px=dict.fromkeys(sequences, size) if size else {},
        rate_hz=_number(notes, "rate_hz", "the frame rate", MAX_RATE_HZ),
        focal_px=dict.fromkeys(sequences, focal) if focal else {},
    )


def _count(token: str, where: str) -> int:
    value = parse_integer(token, where)
    if value < 0:
        raise FormatError(f"{where} is {value}; at least 0 is allowed")
    return value


def _keypoint(row: dict[str, str], line: int) -> tuple[float, float, float]:
    """Return x, y and confidence of a row; NaN and 0 where it says missing."""
    token = row.get("confidence", "1")
    confidence = parse_number(token, f"line {line}: confidence") if token else 0.0
    if not 0 <= confidence <= 10:
        raise FormatError(f"line {line}: the confidence is {confidence:g}; allowed: 0 to 10")
    x, y = (
        math.nan if row[axis].lower() in {"", "nan"} else parse_number(row[axis], f"line {line}: {axis}")
        for axis in "xy"
    )
    is_missing = confidence == 0 or math.isnan(x) or math.isnan(y)
    return (math.nan, math.nan, 0.0) if is_missing else (x, y, confidence)


def _layout_of(joint_names: set[str]) -> str:
    exact = [name for name, layout in KEYPOINT_LAYOUTS.items() if set(layout.keypoint_names) == joint_names]
    fitting = exact or [
        name for name, layout in KEYPOINT_LAYOUTS.items() if joint_names.issubset(layout.keypoint_names)
    ]
    if len(fitting) != 1:
        why = f"fit {', '.join(fitting)}" if fitting else f"fit none of {', '.join(KEYPOINT_LAYOUTS)}"
        raise FormatError(f"the layout cannot be told: the joints {why}; say it in a line '# layout: NAME'")
    return fitting[0]


def _image_size(notes: dict[str, tuple[int, str]]) -> tuple[int, int] | None:
    if "image_size" not in notes:
        return None
    line, text = notes["image_size"]
    width, _, height = text.lower().partition("x")
    size = (_count(width.strip(), f"line {line}: image width"), _count(height.strip(), f"line {line}: image height"))
    if not all(0 < side <= MAX_IMAGE_PX for side in size):
        raise FormatError(f"line {line}: the image size is {text}; allowed: 1 to {MAX_IMAGE_PX}")
    return size


def _number(notes: dict[str, tuple[int, str]], key: str, what: str, highest: float) -> float | None:
    if key not in notes:
        return None
    line, text = notes[key]
    value = parse_number(text, f"line {line}: {key}")
    if not 0 < value <= highest:
        raise FormatError(f"line {line}: {what} is {value:g}; allowed: above 0 to {highest:g}")
    return value
