"""C3D: joints of people as labelled points, `A:pelvis`, written and read.

An own reader, because ezc3d 1.7, the library considered, reads from a path only and ends the process, or takes all
memory, on some damaged files.  The tests read what is written here with it, and write with it what is read here.
The format is that of c3d.org's user guide; only files of Intel processors with floats or integers are read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import RATE_HZ
from pasdedeux.formats.file_format import MotionFormat
from pasdedeux.formats.positions_as_motion import source_from_positions
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE, check_range
from pasdedeux.skeletons import BODY22

_BLOCK = 512
_MAGIC, _INTEL = 0x50, 84
_MAX_FRAMES = 0xFFFF
_PER_LIST = 255
"""Labels that one parameter holds; more go on in LABELS2, LABELS3, ..."""
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "inches": 0.0254, "ft": 0.3048}
_MAX_PEOPLE = 26
_DTYPES = {1: "<i1", 2: "<i2", 4: "<f4"}


def write_c3d(positions_m: Array, labels: Sequence[str], *, rate_hz: float, facts: dict[str, str]) -> bytes:
    """Return points as C3D: millimetres, floats, Y up.

    Args:
        positions_m: Positions (frame, point, 3), metres.
        labels: Names of the points.
        rate_hz: Frames per second.
        facts: Further parameters, texts, of the group PASDEDEUX, by their names.

    Raises:
        FormatError: There are more frames than a C3D file can count.
    """
    frames, count, _ = positions_m.shape
    if frames > _MAX_FRAMES:
        raise FormatError(f"a C3D file counts {_MAX_FRAMES} frames at most, here are {frames}; export fewer, or as glb")
    point = _Group(1, "POINT")
    point.add("USED", np.array([count], "<i2"))
    point.add("FRAMES", np.array([frames], "<u2").view("<i2"))
    point.add("SCALE", np.array([-1.0], "<f4"))
    start = point.add("DATA_START", np.array([0], "<i2"))
    point.add("RATE", np.array([rate_hz], "<f4"))
    point.add("X_SCREEN", "+X")
    point.add("Y_SCREEN", "+Y")
    point.add("UNITS", ["mm"])
    for at in range(0, count, _PER_LIST):
        point.add(f"LABELS{at // _PER_LIST + 1 if at else ''}", list(labels[at : at + _PER_LIST]))
    point.add("DESCRIPTIONS", ["joint"] * min(count, _PER_LIST))
    analog, own = _Group(2, "ANALOG"), _Group(3, "PASDEDEUX")
    analog.add("USED", np.array([0], "<i2"))
    analog.add("RATE", np.array([0.0], "<f4"))
    for name, text in facts.items():
        own.add(name, [text[at : at + 120] for at in range(0, len(text), 120)])
    parameters = bytearray(bytes(4) + point.data + analog.data + own.data)
    parameters[-own.last : -own.last + 2] = bytes(2)  # the last parameter points to none
    parameters += bytes(-len(parameters) % _BLOCK)
    first = 2 + len(parameters) // _BLOCK
    parameters[:4] = bytes([1, _MAGIC, len(parameters) // _BLOCK, _INTEL])
    struct.pack_into("<h", parameters, 4 + start, first)
    header = bytearray(_BLOCK)
    struct.pack_into("<BBHHHHHfHHf", header, 0, 2, _MAGIC, count, 0, 1, frames, 0, -1.0, first, 0, rate_hz)
    data = np.zeros((frames, count, 4), "<f4")
    data[..., :3] = 1e3 * positions_m
    body = data.tobytes()
    return bytes(header) + bytes(parameters) + body + bytes(-len(body) % _BLOCK)


class _Group:
    """A group of parameters while it is written."""

    def __init__(self, number: int, name: str) -> None:
        self._number = number
        self.data = bytearray(struct.pack("<bb", len(name), -number) + name.encode() + struct.pack("<hB", 3, 0))
        self.last = 0

    def add(self, name: str, values: str | Sequence[str] | Array) -> int:
        """Add a parameter - numbers, a text or texts - and return where in the group's bytes its values begin."""
        if isinstance(values, np.ndarray):
            kind, shape, raw = (4 if values.dtype.kind == "f" else values.dtype.itemsize), [], values.tobytes()
        else:
            texts = [values.encode()] if isinstance(values, str) else [one.encode("ascii", "replace") for one in values]
            width = max(map(len, texts), default=0)
            kind, shape = -1, [width] if isinstance(values, str) else [width, len(texts)]
            raw = b"".join(text.ljust(width) for text in texts)
        content = struct.pack(f"<bB{len(shape)}B", kind, len(shape), *shape) + raw + b"\0"
        self.data += struct.pack("<bb", len(name), self._number) + name.encode() + struct.pack("<h", 2 + len(content))
        self.data += content
        self.last = 2 + len(content)
        return len(self.data) - 1 - len(raw)


@dataclass(frozen=True)
class Points:
    """The points of a C3D file: positions (frame, point, 3) in the file's unit, NaN where there is a gap."""

    labels: tuple[str, ...]
    positions: Array
    rate_hz: float
    unit: str


def read_points(data: bytes) -> Points:
    """Read the points of a C3D file.

    Raises:
        FormatError: The file is empty, damaged, of another processor, or holds analog data only.
    """
    if not data:
        raise FormatError("this C3D file is empty")
    try:
        return _read_points(data)
    except (struct.error, IndexError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"this is a damaged C3D file: {str(error)[:80] or type(error).__name__}") from None


def _read_points(data: bytes) -> Points:
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
    frames = last - first + 1
    check_range(frames, "the number of frames of this damaged C3D file", 1, _MAX_FRAMES)
    if len(labels) < count:
        raise FormatError(f"this is a damaged C3D file: it has {count} points, but {len(labels)} labels")
    rate_hz = float(parameters.get("POINT:RATE", np.array([rate_hz]))[0])
    scale = float(parameters.get("POINT:SCALE", np.array([scale]))[0])
    is_float = scale < 0
    (analog,) = struct.unpack_from("<H", data, 4)
    size, wide = (4, "<f4") if is_float else (2, "<i2")
    row = (4 * count + analog) * size
    place = (start - 1) * _BLOCK
    body = data[place : place + frames * row]
    if start < 2 or len(body) < frames * row:
        raise FormatError(
            f"this is a damaged C3D file: it ends in frame {max(len(body), 0) // max(row, 1)} of {frames}"
        )
    values = np.frombuffer(body, wide).reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4)
    with np.errstate(all="ignore"):  # what is not finite is refused where it is used
        values = values.astype(np.float64)
        positions = values[..., :3] * (1.0 if is_float else scale)
    positions[values[..., 3] < 0] = np.nan  # a residual below zero: the point was not seen
    unit = "".join(parameters.get("POINT:UNITS", [""])).strip().lower()
    return Points(tuple(labels[:count]), positions, rate_hz, unit)


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


def read_c3d(data: bytes, companion: bytes = b"", *, person: int = 0) -> SourceMotion:
    """Read a person of a C3D file whose points are the joints of body22, `A:pelvis` or, of one person, `pelvis`.

    Rotations are swings only.

    Raises:
        FormatError: As `read_points`; the points are other markers, there are fewer people, or a point has a gap.
    """
    points = read_points(data)
    subjects: dict[str, dict[str, int]] = {}
    for at, label in enumerate(points.labels):
        subject, _, joint = label.rpartition(":")
        if joint in BODY22.joint_names:
            subjects.setdefault(subject, {})[joint] = at
    whole = [found for found in subjects.values() if len(found) == BODY22.num_joints]
    if not whole:
        missing = next(
            (f"'{joint}'" for found in subjects.values() for joint in BODY22.joint_names if joint not in found), ""
        )
        raise FormatError(
            f"the points of this C3D file are no joints of a person ({', '.join(points.labels[:4])}, ...); needed are "
            f"those of body22, with a name and ':' before them where it holds several people"
            + (f"; {missing} is missing" if missing else "")
        )
    if person >= len(whole):
        raise FormatError(f"person {person}: it holds {len(whole)} people; the take names it more often")
    positions = points.positions[:, [whole[person][joint] for joint in BODY22.joint_names]]
    for frame, joint in np.argwhere(~(np.abs(positions) <= MAX_MAGNITUDE).all(axis=-1)):
        raise FormatError(
            f"frame {frame}: the point '{BODY22.joint_names[joint]}' is missing, not finite or absurdly large; fill "
            "gaps in the program that captured it"
        )
    rate_hz = check_range(points.rate_hz, "the rate of this damaged C3D file", *RATE_HZ)
    return source_from_positions(BODY22, positions, rate_hz=rate_hz, metres_per_unit=_METRES.get(points.unit))


C3D = MotionFormat(
    name="c3d",
    recognised_by="a binary file whose second byte is P, as C3D has it",
    suffixes=(".c3d",),
    recognises=lambda start: len(start.head) > 1 and 1 < start.head[0] < ord(" ") and start.head[1] == _MAGIC,
    read=read_c3d,
    others=tuple(partial(read_c3d, person=person) for person in range(1, _MAX_PEOPLE)),
    has_rotations=False,
)
"""Labelled points of joints: it states its rate and its unit, not which axis points up."""
