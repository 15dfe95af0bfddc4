"""Unpacked clips: rows of fixed width in flat files, so that any few rows are read in one system call.

In a Parquet file, a row is compressed with thousands of others. Clips that are read repeatedly in any order, such as
windows for training, are therefore unpacked once into a folder of the cache, a third larger than the Parquet files. No
motion stays in the memory of the process; the system's file cache shrinks when memory is short. Folders are named by
the digest of their content, so none becomes stale. Any may be removed at any time, and `gc` removes those that were not
used for a while: the mtime of a folder is that of its last use.
"""

from __future__ import annotations

import os
import re
import weakref
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing, suppress
from datetime import datetime
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema.durable import HashingFile, cache_folder, write_errors
from storage_schema.errors import CorruptArtifact
from storage_schema.joints import JOINT_NAMES
from storage_schema.staging import StagingFolder, clean_leftovers

_JOINTS = len(JOINT_NAMES["body22"])
CONTACT = np.dtype([("frame", "<i4"), ("pair", "<i2"), ("bones", "<i2"), ("weight", "<f4")])
"""A contact: frame, number of the pair of people, `22 * bone + bone`, and weight."""
ROWS: Mapping[str, np.dtype] = {
    "positions": np.dtype(("<f4", (_JOINTS, 3))),
    "rotations": np.dtype(("<f4", (_JOINTS, 4))),
    "mask": np.dtype(("?", (_JOINTS,))),
    "people": np.dtype(("<f4", (_JOINTS, 4))),
    "first_contacts": np.dtype("<i8"),
    "contacts": CONTACT,
}
"""A row of each file: of a frame and person (`positions`, `rotations`, `mask`); of a person, scales of bones and the
rest pose; of a frame, the number of its first contact, and after the last frame of a take where its contacts end; of
a contact."""
_CLIPS = "clips.parquet"
_DIGEST = re.compile("[0-9a-f]{64}")


class ClipWriter:
    """Writes rows as they come, and the description of each clip."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files = {name: HashingFile(folder / name) for name in ROWS}
        self._clips: dict[str, list[Any]] = {}

    def append(self, name: str, rows: npt.ArrayLike) -> int:
        """Add rows to a file and return the number of the first of them."""
        kind, file = ROWS[name], self._files[name]
        first = file.num_bytes // kind.itemsize
        file.write(np.ascontiguousarray(rows, dtype=kind.base).tobytes())
        return first

    def add_clip(self, **columns: Any) -> None:
        """Add the description of a clip: where its rows begin, and other facts."""
        for name, value in columns.items():
            self._clips.setdefault(name, []).append(value)

    def close(self) -> None:
        """Sync all of it to the disk."""
        with ExitStack() as files:
            for file in self._files.values():
                files.callback(file.close)
            pq.write_table(pa.table(self._clips), self._folder / _CLIPS)


class UnpackedClips:
    """The unpacked clips of a folder, read by any number of processes; picklable, as it is only its folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._handles: dict[str, int] = {}
        self._mapped: dict[str, npt.NDArray[Any]] = {}
        weakref.finalize(self, _close, self._handles)

    def __reduce__(self) -> tuple[type[UnpackedClips], tuple[Path]]:
        return UnpackedClips, (self.folder,)

    def clips(self) -> pa.Table:
        """Return the descriptions of the clips, one row each."""
        return pq.read_table(self.folder / _CLIPS)

    def read(self, name: str, first: npt.NDArray[np.int64], into: Iterable[npt.NDArray[Any]]) -> None:
        """Fill contiguous arrays with rows of a file, each from its row in `first` (n,) on.

        Raises:
            CorruptArtifact: The file ends before.
        """
        if name not in self._handles:
            self._handles[name] = os.open(self.folder / name, os.O_RDONLY)
        handle, places = self._handles[name], (first * ROWS[name].itemsize).tolist()
        for rows, place in zip(into, places, strict=True):
            if os.preadv(handle, [rows], place) != rows.nbytes:  # type: ignore[list-item]
                raise CorruptArtifact(f"{self.folder / name} is cut short; remove the folder, it is unpacked anew")

    def read_rows(self, name: str, first: int, count: int) -> npt.NDArray[Any]:
        """Return `count` rows of a file from row `first` on; raises what `read` raises."""
        rows = np.empty((count, *ROWS[name].shape), ROWS[name].base)
        self.read(name, np.array([first]), [rows])
        return rows

    def take(self, name: str, rows: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Return rows of a small file, which is mapped into memory, by an array of their numbers."""
        if name not in self._mapped:
            mapped = np.memmap(self.folder / name, ROWS[name].base, "r")
            self._mapped[name] = np.asarray(mapped).reshape(-1, *ROWS[name].shape)
        return self._mapped[name][rows]


def unpacked(digest: str, write: Callable[[ClipWriter], None]) -> UnpackedClips:
    """Return the clips of this digest; `write` unpacks them, in one step, if they are not in the cache.

    Raises:
        FullDisk: There is no room for them in the cache.
    """
    root = _root()
    if not (folder := root / digest).is_dir():
        clean_leftovers(root)
        with write_errors(root), closing(StagingFolder(root)) as staging:
            with closing(ClipWriter(staging.path)) as writer:
                write(writer)
            staging.take_place(folder)
    with suppress(OSError):  # in a read-only cache
        os.utime(folder)
    return UnpackedClips(folder)


def unused_clips(since: datetime) -> tuple[list[Path], list[Path]]:
    """Return the folders of the cache that were used at or after a time, and the others."""
    folders = sorted(path for path in _root().glob("*") if path.is_dir() and _DIGEST.fullmatch(path.name))
    is_used = [path.stat().st_mtime >= since.timestamp() for path in folders]
    return list(compress(folders, is_used)), [path for path, used in zip(folders, is_used, strict=True) if not used]


def _root() -> Path:
    return cache_folder() / "unpacked"


def _close(handles: dict[str, int]) -> None:
    for handle in handles.values():
        os.close(handle)
