"""What OpenCV cannot write: MP4 files with a phone's rotation, or with frames of different durations."""

from __future__ import annotations

import struct
from collections.abc import Sequence

_PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


def rotated(data: bytes, degrees: int) -> bytes:
    """Return a film whose header asks to turn its images clockwise by 90 or 180 degrees."""
    at = data.index(b"tkhd") + 4 + 40  # version 0: the matrix follows 40 bytes
    a, b, c, d = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1)}[degrees]
    matrix = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    return data[:at] + matrix + data[at + 36 :]


def with_durations(data: bytes, durations: Sequence[float]) -> bytes:
    """Return a film whose frames last so many seconds each; the header must follow the images."""
    assert data.index(b"mdat") < data.index(b"moov")
    data = data.replace(b"edts", b"free")  # the list of edits would end the film where it ended
    at = data.index(b"mdhd")
    (scale,) = struct.unpack(">I", data[at + 16 : at + 20])
    start = data.index(b"stts") - 4
    (length,) = struct.unpack(">I", data[start : start + 4])
    entries = b"".join(struct.pack(">II", 1, round(duration * scale)) for duration in durations)
    box = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(durations)) + entries
    grown = bytearray(data[:start] + box + data[start + length :])
    for name in _PARENTS:
        place = grown.index(name) - 4
        (size,) = struct.unpack(">I", grown[place : place + 4])
        grown[place : place + 4] = struct.pack(">I", size + len(box) - length)
    return bytes(grown)
