"""Files that users name: all of them are opened here, and only regular files are read."""

from __future__ import annotations

import hashlib
import math
import os
import stat
import time
from io import BufferedReader
from pathlib import Path

from pasdedeux.errors import InputError
from pasdedeux.formats.npz import get_array, read_npz

MAX_BYTES = 2_000_000_000
"""Largest file that is read into memory as a whole; films are streamed and may be larger."""
MAX_TEXT_BYTES = 16_000_000
"""Largest study, list of choices or cluster profile."""
_SETTLED_NS = 2_000_000_000
"""A file modified within this time may change again without a new modification time: clocks of disks have steps."""
_MAX_DIGESTS = 100_000
_DIGESTS: dict[tuple[int, ...], str] = {}
"""Digests of files by place on disk, size and modification times: a process plans a study several times."""
_UNIT = "bvh_metres_per_unit"
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading; anything else, such as a pipe that nobody fills, is refused at once.

    Raises:
        InputError: It does not exist, is not a regular file, or cannot be read.
    """
    try:
        kind = path.stat().st_mode
        if stat.S_ISREG(kind):
            # Do not wait if a pipe replaces the file between the two calls.
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
            kind = os.fstat(file.fileno()).st_mode
            if stat.S_ISREG(kind):
                return file
            file.close()
    except FileNotFoundError:
        raise InputError(f"file {path} does not exist") from None
    except (OSError, ValueError) as error:
        raise InputError(f"file {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    what = next((words for is_kind, words in _KINDS if is_kind(kind)), "no file")
    raise InputError(f"{path} is {what}, and a regular file is needed; write the content to a file and name that")


def read_file(path: Path, *, max_bytes: int = MAX_BYTES) -> bytes:
    """Return the bytes of a file that a user names.

    Raises:
        InputError: As `open_file`, or it has more than `max_bytes`.
    """
    with open_file(path) as file:
        if os.fstat(file.fileno()).st_size <= max_bytes:
            try:
                data = file.read(max_bytes + 1)
            except OSError as error:
                raise InputError(f"file {path} cannot be read: {error.strerror}") from None
            if len(data) <= max_bytes:
                return data
    raise InputError(f"file {path} is larger than {max_bytes / 1e6:.0f} MB, the most that is read; split it")


def read_text_file(path: Path) -> str:
    """Return the text of a study, a list of choices or a profile.

    Raises:
        InputError: As `read_file`, or it is not text in UTF-8.
    """
    try:
        return read_file(path, max_bytes=MAX_TEXT_BYTES).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(f"file {path} is no text in UTF-8: {error.reason} at byte {error.start}") from None


def user_file_digest(path: Path, data: bytes | None = None) -> str:
    """Return the sha256 of a file of any size; cached in the process while the file does not change.

    Args:
        path: The file.
        data: Its bytes, if they were read.

    Raises:
        InputError: As `open_file`.
    """
    with open_file(path) as file:
        status = os.fstat(file.fileno())
        state = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
        if state in _DIGESTS:
            return _DIGESTS[state]
        try:
            digest = (hashlib.file_digest(file, "sha256") if data is None else hashlib.sha256(data)).hexdigest()
        except OSError as error:
            raise InputError(f"file {path} cannot be read: {error.strerror}") from None
    if time.time_ns() - max(state[-2:]) > _SETTLED_NS:
        if len(_DIGESTS) >= _MAX_DIGESTS:
            _DIGESTS.clear()
        _DIGESTS[state] = digest
    return digest


def exported_unit_m(path: Path) -> float | None:
    """Return the metres per unit of a BVH file from the npz that an export writes beside it; None without one."""
    if path.suffix.lower() != ".bvh" or not (beside := path.with_suffix(".npz")).is_file():
        return None
    try:
        arrays = read_npz(read_file(beside), "export", lambda name: name == _UNIT)
        unit_m = float(get_array(arrays, _UNIT, "f", ()))
    except InputError:
        return None
    return unit_m if 0.0 < unit_m < math.inf else None
