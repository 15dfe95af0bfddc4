"""C3D: joints of people as labelled points, `A:pelvis`, written and read.

The library ezc3d 1.7 is not used: it reads from a path only, and on some damaged files it ends the process or takes all
memory.  The tests use it as an oracle, for reading and for writing.  The format is that of the user guide of c3d.org;
only files of Intel processors, with floats or integers, are read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import MotionFormat
from pasdedeux.formats.labelled_points import LabelledPoints
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_COUNT
from pasdedeux.plain_text import counted

_BLOCK = 512
_MAGIC, _INTEL = 0x50, 84
_MAX_FRAMES = 0xFFFF
"""Maximum frame number in the header; longer files state the number elsewhere, or not at all."""
_PER_LIST = 255
"""Maximum number of labels in one parameter; more are in LABELS2, LABELS3, ..."""
_LONG_FRAMES = ("POINT:LONG_FRAMES", "POINT:FRAMES")
_DTYPES = {1: "<i1", 2: "<i2", 4: "<f4"}


def write_c3d(positions_m: Array, labels: Sequence[str], *, rate_hz: float, facts: dict[str, str]) -> bytes:
    """Return points as C3D: millimetres, floats, Y up.

    Args:
        positions_m: Positions (frame, point, 3), metres.
        labels: Names of the points.
        rate_hz: Frames per second.
        facts: Further parameters (text) of the group PASDEDEUX, by name.
    """
    frames, count, _ = positions_m.shape
    shown_frames = min(frames, _MAX_FRAMES)
    point = _ParameterGroup(1, "POINT")
    point.add("USED", np.array([count], "<i2"))
    point.add("FRAMES", np.array([shown_frames], "<u2").view("<i2"))
    point.add("LONG_FRAMES", np.array([frames], "<f4"))
    point.add("SCALE", np.array([-1.0], "<f4"))
    start = point.add("DATA_START", np.array([0], "<i2"))
    point.add("RATE", np.array([rate_hz], "<f4"))
    point.add("X_SCREEN", "+X")
    point.add("Y_SCREEN", "+Y")
    point.add("UNITS", ["mm"])
    for at in range(0, count, _PER_LIST):
        point.add(f"LABELS{at // _PER_LIST + 1 if at else ''}", list(labels[at : at + _PER_LIST]))
    point.add("DESCRIPTIONS", ["joint"] * min(count, _PER_LIST))
    analog, own_group = _ParameterGroup(2, "ANALOG"), _ParameterGroup(3, "PASDEDEUX")
    analog.add("USED", np.array([0], "<i2"))
    analog.add("RATE", np.array([0.0], "<f4"))
    for name, text in facts.items():
        own_group.add(name, [text[at : at + 120] for at in range(0, len(text), 120)])
    parameters = bytearray(bytes(4) + point.data + analog.data + own_group.data)
    parameters[-own_group.last : -own_group.last + 2] = bytes(2)  # the last parameter points to none
    parameters += bytes(-len(parameters) % _BLOCK)
    first = 2 + len(parameters) // _BLOCK
    parameters[:4] = bytes([1, _MAGIC, len(parameters) // _BLOCK, _INTEL])
    struct.pack_into("<h", parameters, 4 + start, first)
    header = bytearray(_BLOCK)
    struct.pack_into("<BBHHHHHfHHf", header, 0, 2, _MAGIC, count, 0, 1, shown_frames, 0, -1.0, first, 0, rate_hz)
    data = np.zeros((frames, count, 4), "<f4")
    data[..., :3] = 1e3 * positions_m
    body = data.tobytes()
    return bytes(header) + bytes(parameters) + body + bytes(-len(body) % _BLOCK)


class _ParameterGroup:
    """A group of parameters while it is written."""

    def __init__(self, number: int, name: str) -> None:
        self._number = number
        self.data = bytearray(struct.pack("<bb", len(name), -number) + name.encode() + struct.pack("<hB", 3, 0))
        self.last = 0

    def add(self, name: str, values: str | Sequence[str] | Array) -> int:
        """Add a parameter (numbers, a text or texts) and return the offset of its values in the group."""
        if isinstance(values, np.ndarray):
            kind, shape, raw = (4 if values.dtype.kind == "f" else values.dtype.itemsize), [], values.tobytes()
        else:
            texts = (
                [values.encode()] if isinstance(values, str) else [value.encode("ascii", "replace") for value in values]
            )
            width = max(map(len, texts), default=0)
            kind, shape = -1, [width] if isinstance(values, str) else [width, len(texts)]
            raw = b"".join(text.ljust(width) for text in texts)
        content = struct.pack(f"<bB{len(shape)}B", kind, len(shape), *shape) + raw + b"\0"
        self.data += struct.pack("<bb", len(name), self._number) + name.encode() + struct.pack("<h", 2 + len(content))
        self.data += content
        self.last = 2 + len(content)
        return len(self.data) - 1 - len(raw)


def read_points(data: bytes) -> LabelledPoints:
    """Read the points of a C3D file.

    Raises:
        FormatError: The file is empty, damaged, from another processor, or has analog data only.
    """
    if not data:
        raise FormatError("this C3D file is empty")
    try:
        return _read_points(data)
    except (struct.error, IndexError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"this is a damaged C3D file: {str(error)[:80] or type(error).__name__}") from None


def _read_points(data: bytes) -> LabelledPoints:
    block, magic, count, _, first, last, _, scale, start, _, rate_hz = struct.unpack_from("<BBHHHHHfHHf", data)
    if magic != _MAGIC or not block >= 2:
        raise FormatError("this is a damaged C3D file: its header does not begin as one")
    place = (block - 1) * _BLOCK
    if data[place + 3] != _INTEL:
        raise FormatError(f"this C3D file is of a processor of kind {data[place + 3]}; 84 (Intel) is read")
    parameters = _read_parameters(data[place : place + max(data[place + 2], 1) * _BLOCK])
    count = int(parameters.get("POINT:USED", np.array([count]))[0]) & 0xFFFF
    labels: list[str] = []
    for name in ("POINT:LABELS", *(f"POINT:LABELS{more}" for more in range(2, 10))):
        labels += parameters.get(name, [])
    if count == 0:
        raise FormatError("this C3D file holds analog data only: it has no points")
    if len(labels) < count:
        raise FormatError(
            f"this is a damaged C3D file: it has {counted(count, 'point')}, but {counted(len(labels), 'label')}"
        )
    rate_hz = float(parameters.get("POINT:RATE", np.array([rate_hz]))[0])
    scale = float(parameters.get("POINT:SCALE", np.array([scale]))[0])
    is_float = scale < 0
    (analog,) = struct.unpack_from("<H", data, 4)
    size, wide = (4, "<f4") if is_float else (2, "<i2")
    row = (4 * count + analog) * size
    place = (start - 1) * _BLOCK
    frames = _num_frames(parameters, first, last, data[place:] if start >= 2 else b"", row)
    body = data[place : place + frames * row]
    if start < 2 or len(body) < frames * row:
        raise FormatError(
            f"this is a damaged C3D file: it ends in frame {max(len(body), 0) // max(row, 1)} of {frames}"
        )
    values = np.frombuffer(body, wide).reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4)
    with np.errstate(all="ignore"):  # values that are not finite are refused later
        values = values.astype(np.float64)
        positions = values[..., :3] * (1.0 if is_float else scale)
    positions[values[..., 3] < 0] = np.nan  # a residual below zero: the point was not seen
    unit = "".join(parameters.get("POINT:UNITS", [""])).strip().lower()
    return LabelledPoints("C3D file", tuple(labels[:count]), positions, rate_hz, unit)


def _num_frames(parameters: Mapping[str, Array | list[str]], first: int, last: int, body: bytes, row: int) -> int:
    """Return the number of frames, each of `row` bytes, also if it exceeds the 16 bits of the header.

    In that case it is in a parameter, else it follows from the data, whose last block is padded with zeros.
    """
    frames = (last - first + 1) & _MAX_FRAMES or _MAX_FRAMES + 1
    stated = [float(np.ravel(parameters[name])[0]) for name in _LONG_FRAMES if name in parameters]
    start, end = (parameters.get(f"TRIAL:ACTUAL_{which}_FIELD") for which in ("START", "END"))
    if isinstance(start, np.ndarray) and isinstance(end, np.ndarray) and start.size == end.size == 2:
        low, high = (end.astype(np.int64) & _MAX_FRAMES) - (start.astype(np.int64) & _MAX_FRAMES)
        stated.append(float(low + (high << 16) + 1))
    if stated and _MAX_FRAMES < max(stated) < MAX_COUNT:
        return int(max(stated))
    there = len(body) // row
    if last == _MAX_FRAMES:
        while (
            there > frames
            and len(body) - (there - 1) * row < row + _BLOCK
            and not any(body[(there - 1) * row : there * row])
        ):
            there -= 1
        return max(there, frames)
    wraps, left = divmod(there - frames, _MAX_FRAMES + 1)
    return frames + wraps * (_MAX_FRAMES + 1) if wraps > 0 and left * row < _BLOCK else frames


def _read_parameters(section: bytes) -> dict[str, Array | list[str]]:
    """Return the values of parameters by GROUP:NAME; texts as lists."""
    groups: dict[int, str] = {}
    raw: dict[tuple[int, str], Array | list[str]] = {}
    at = 4
    while at + 2 < len(section):
        length, number = struct.unpack_from("<bb", section, at)
        if length == 0 or number == 0:
            break
        length = abs(length)
        name = section[at + 2 : at + 2 + length].decode("ascii").upper()
        at += 2 + length
        (step,) = struct.unpack_from("<H", section, at)
        if number < 0:
            groups[-number] = name
        else:
            kind, num_axes = struct.unpack_from("<bB", section, at + 2)
            shape = list(section[at + 4 : at + 4 + num_axes])
            content = section[at + 4 + num_axes :]
            width, count = abs(kind), math.prod(shape)
            if width * count > len(content):
                raise FormatError(f"this is a damaged C3D file: its parameter '{name}' is longer than the file")
            if kind == -1:
                size = (shape or [1])[0]
                raw[number, name] = [
                    content[i : i + size].decode("latin-1").strip() for i in range(0, count, size or 1)
                ]
            else:
                raw[number, name] = np.frombuffer(content, _DTYPES[kind], count)
        if step == 0:
            break
        at += step
    return {f"{groups.get(number, '')}:{name}": values for (number, name), values in raw.items()}


def read_c3d(data: bytes, companion: bytes = b"", person: int = 0) -> SourceMotion:
    """Read a person of a C3D file, see `LabelledPoints.source`."""
    return read_points(data).source(person)


C3D = MotionFormat(
    name="c3d",
    suffixes=(".c3d",),
    recognises=lambda start: len(start.head) > 1 and 1 < start.head[0] < ord(" ") and start.head[1] == _MAGIC,
    read=read_c3d,
    read_other=read_c3d,
    count_people=lambda data: read_points(data).num_people,
    has_rotations=False,
)
"""Joints as labelled points; the file states rate and unit, but not the up axis."""
