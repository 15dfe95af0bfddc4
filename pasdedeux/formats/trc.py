"""Reading and writing TRC, OpenSim's tables of markers, with joints of people as markers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import MotionFormat
from pasdedeux.formats.labelled_points import LabelledPoints
from pasdedeux.formats.poses2d.annotated_frames import RATE_HZ
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import Lines, compare_count, parse_integer, parse_number
from pasdedeux.plain_text import counted

_NUM_HEADER = 5
"""Number of lines before the frames: type, keys, values, labels, axes."""


def write_trc(positions_m: Array, labels: Sequence[str], *, rate_hz: float, name: str) -> str:
    """Return points as TRC in metres.

    Args:
        positions_m: Positions (frame, point, 3), metres.
        labels: Names of the points.
        rate_hz: Frames per second.
        name: Name of the file, which is written into it.
    """
    frames, rate = len(positions_m), f"{rate_hz:.9g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(labels)}\tm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, len(labels) + 1) for axis in "XYZ"),
        "",
    ]
    for frame, values in enumerate(positions_m.reshape(frames, -1)):
        lines.append("\t".join([str(frame + 1), f"{frame / rate_hz:.6f}", *(f"{value:.6f}" for value in values)]))
    return "\n".join(lines) + "\n"


def read_points(data: bytes | str) -> LabelledPoints:
    """Read the markers of a TRC file; an empty cell is a gap.

    Raises:
        FormatError: A header line is missing, or a line has another number of values or a value that is not a number.
    """
    with Lines(data, "TRC file") as lines:
        header = [text for text, _ in zip(lines, range(_NUM_HEADER), strict=False)]
        if len(header) < _NUM_HEADER or not header[0].startswith("PathFileType"):
            raise FormatError("a TRC file begins with PathFileType, keys, values, names of the markers and axes")
        stated = dict(zip(header[1].split(), header[2].split(), strict=False))
        rate_hz = parse_number(stated.get("DataRate", ""), "DataRate", *RATE_HZ)
        labels = tuple(label for cell in header[3].split("\t")[2:] if (label := cell.strip()))
        rows = []
        for text in lines:
            if not text.strip():
                continue
            cells = [cell.strip() for cell in text.rstrip("\r\n").split("\t")][2:]
            if len(cells) < 3 * len(labels) or any(cells[3 * len(labels) :]):
                raise FormatError(f"{counted(len(cells), 'value')} where {3 * len(labels)} are needed")
            rows.append([parse_number(cell, "a position") if cell else np.nan for cell in cells[: 3 * len(labels)]])
        if not rows or not labels:
            raise FormatError("the file ends without a frame")
        note = compare_count(parse_integer(stated.get("NumFrames", str(len(rows))), "NumFrames"), len(rows))
    positions = np.array(rows).reshape(len(rows), len(labels), 3)
    return LabelledPoints("TRC file", labels, positions, rate_hz, stated.get("Units", "").lower(), (note,) * bool(note))


def read_trc(data: bytes, companion: bytes = b"", person: int = 0) -> SourceMotion:
    """Read a person of a TRC file, see `LabelledPoints.source`."""
    return read_points(data).source(person)


TRC = MotionFormat(
    name="trc",
    suffixes=(".trc",),
    recognises=lambda start: start.text.startswith("PathFileType"),
    read=read_trc,
    read_other=read_trc,
    count_people=lambda data: read_points(data).num_people,
    has_rotations=False,
)
"""Joints as markers; the file states rate and unit, but not the up axis."""
