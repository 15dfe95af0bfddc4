"""Reading YOLO's labels and its output with `save_txt`: a text file for each image, a line for each person.

A line has the class, the box (four shares of the image), and for each keypoint x, y and optionally a confidence or
COCO's visibility; then optionally the confidence of the person and the number of a track.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.poses2d.detections import Detection
from pasdedeux.formats.text import Lines, floats_of, parse_number
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import LAYOUTS_OF_COUNT, USUAL_LAYOUTS

_BOX = 5
"""Number of values before the keypoints: class and box."""
_MAX_SHARE = 2.0
"""Largest coordinate: people may leave the image a little."""


def read_people(data: bytes) -> list[Detection]:
    """Read the people of one image; coordinates are shares of the image."""
    detections = []
    with Lines(data, "file of YOLO") as lines:
        for words in lines.words():
            values = np.array([parse_number(word, "a value") for word in words])
            count, width = _form(values)
            table = values[_BOX : _BOX + count * width].reshape(count, width)
            table = np.concatenate([table, np.ones((count, 3 - width))], axis=1)
            track = values[-1] if len(values) == _BOX + count * width + 2 else -1.0
            person = int(track) if track >= 0 and track == int(track) else None
            detections.append(Detection(("", 0), person, table, f"line {lines.number}"))
    return detections


def _form(values: np.ndarray) -> tuple[int, int]:
    """Return the number of keypoints in a line and of values for each: if possible COCO's, else a usual layout's."""
    forms = [
        (
            layouts[0].name != "coco17",
            not any(layout.name in USUAL_LAYOUTS for layout in layouts),
            -width,
            rest,
            count,
            width,
        )
        for count, layouts in LAYOUTS_OF_COUNT.items()
        for width in (3, 2)
        for rest in range(3)
        if len(values) == _BOX + count * width + rest
    ]
    if not forms:
        counts = ", ".join(map(str, LAYOUTS_OF_COUNT))
        raise FormatError(
            f"{counted(len(values), 'value')}: class, box and keypoints are needed; known numbers: {counts}"
        )
    *_, count, width = min(forms)
    return count, width


def _is_yolo(start: FileStart) -> bool:
    """Return whether the first line is a whole number and shares of an image, more than a box."""
    words = start.first_row.split()
    values = np.array(floats_of(words))
    if len(values) < _BOX + 2 * min(LAYOUTS_OF_COUNT) or not words[0].isdigit():
        return False
    shares = values[1 : _BOX + 2 * ((len(values) - _BOX) // 3)]
    return bool((np.abs(shares) <= _MAX_SHARE).all() and (shares[:4] > 0).all() and (shares[:4] <= 1).all())


YOLO = AnnotationFormat(
    name="yolo",
    suffixes=(".txt",),
    recognises=_is_yolo,
    read_people=read_people,
)
"""A folder of YOLO's text files, one for each image; the size of the image is needed."""
