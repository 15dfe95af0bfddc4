"""Npz archives: written from motions, and read safely.

Archives may be damaged or hostile: pickles are not read, and memory is limited by the size of the file.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError
from pasdedeux.formats.unsupported import refuse_foreign
from pasdedeux.kinematics import Motion

MAX_UNPACKED_BYTES = 1 << 30
MAX_ARRAYS = 100
MAX_RATIO = 100
"""Maximum ratio of unpacked to packed bytes, beyond `_SMALL_BYTES`: poses shrink to a tenth at most."""
_SMALL_BYTES = 16 << 20
_KINDS = {"f": "floats", "fiu": "numbers", "iu": "whole numbers", "U": "texts"}


def is_npz(data: bytes) -> bool:
    """Return whether data starts like a zip archive."""
    return data[:4] == b"PK\x03\x04"


def array_names(data: bytes) -> frozenset[str]:
    """Return the array names of an npz archive without unpacking; a damaged archive raises a FormatError."""
    with _opened(data, "npz archive") as archive:
        return frozenset(member.filename.removesuffix(".npy") for member in archive.infolist())


def read_npz(
    data: bytes, what: str, is_wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, npt.NDArray[Any]]:
    """Return the wanted arrays of an npz archive by name; others are not opened.

    Raises:
        FormatError: The archive is damaged, has Python objects, or states more data than it has or may have.
    """
    with _opened(data, what) as archive:
        named = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        return {
            name: _read_array(archive.read(member), member.filename[:40])
            for name, member in named.items()
            if is_wanted(name)
        }


def get_array(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, kinds: str, shape: tuple[int | None, ...]
) -> npt.NDArray[Any]:
    """Return an array of an archive after checking type and shape.

    Args:
        arrays: The arrays of the archive by name.
        name: Name of the array.
        kinds: Allowed numpy kinds, a key of `_KINDS`.
        shape: Required shape; None is any length.
    """
    array = arrays.get(name)
    sizes = () if array is None else array.shape
    fits = len(sizes) == len(shape) and all(want in (None, size) for want, size in zip(shape, sizes, strict=True))
    if array is None or array.dtype.kind not in kinds or not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        described = "none" if array is None else f"{array.dtype} of shape {sizes}"
        raise FormatError(f"array '{name}' of {_KINDS[kinds]}, shape ({wanted}), is needed, found {described}")
    return array


@contextmanager
def _opened(data: bytes, what: str) -> Iterator[zipfile.ZipFile]:
    refuse_foreign(data)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            unpacked = sum(member.file_size for member in members)
            if len(members) > MAX_ARRAYS:
                raise FormatError(f"this {what} has {len(members)} arrays; at most {MAX_ARRAYS} are allowed")
            most = min(MAX_UNPACKED_BYTES, max(_SMALL_BYTES, MAX_RATIO * len(data)))
            if unpacked > most:
                raise FormatError(
                    f"this {what} of {len(data) / 1e6:.1f} MB states {unpacked / 1e6:.0f} MB of arrays, more than the "
                    f"{most / 1e6:.0f} MB that are read from it; write it without compression, or in parts"
                )
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, ValueError) as error:
        raise FormatError(f"this {what} is a damaged npz archive: {str(error)[:120]}") from None


def _read_array(content: bytes, name: str) -> npt.NDArray[Any]:
    """Return the array of one npy file after checking its header against its size."""
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read(stream)
    except (ValueError, TypeError, SyntaxError, EOFError, OSError, RecursionError, MemoryError, KeyError) as error:
        raise FormatError(f"array '{name}' has a damaged header: {str(error)[:120]}") from None
    if dtype.kind not in "biufU" or dtype.itemsize == 0:
        raise FormatError(f"array '{name}' has the type {dtype}; allowed: numbers, truth values, text")
    if any(not 0 <= axis < 1 << 40 for axis in shape) or len(shape) > 8:
        raise FormatError(f"array '{name}' has the impossible shape {str(shape)[:80]}")
    size = math.prod(shape) * dtype.itemsize
    body = content[stream.tell() :]
    if size != len(body):
        raise FormatError(f"array '{name}' states {size} bytes but has {len(body)}")
    values = np.frombuffer(body, dtype=dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")


def write_motion_npz(motion: Motion, *, axes: str, **facts: Any) -> bytes:
    """Return a motion as an npz archive, lengths in metres.

    `joint_names`, `parents` (-1 for the root), `rest_offset_m` (joint, 3), `root_translation_m` (frame, 3),
    `local_unitquat` (frame, joint, 4) as x, y, z, w from the rest pose, `positions_m` (frame, joint, 3), `rate_hz`,
    `unit` and `axes`, a sentence; and further facts by their names.
    """
    arrays: dict[str, Any] = {
        "joint_names": np.array(motion.skeleton.joint_names),
        "parents": np.array(motion.skeleton.parents),
        "rest_offset_m": motion.rest_offsets_m,
        "root_translation_m": motion.root_translation_m,
        "local_unitquat": motion.local_unitquat,
        "positions_m": motion.world()[0],
        "rate_hz": motion.rate_hz,
        "unit": np.array("m"),
        "axes": np.array(axes),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays, **facts)
    return file.getvalue()
