"""Reads a folder of OpenPose files while they are written: in frame order, each once, only when it is whole."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pasdedeux.errors import FormatError
from pasdedeux.formats.openpose import OpenPoseFrame, openpose_frame_number, read_openpose_frame

STOP_NAME = "STOP"
"""A file of this name in the folder says that no more frames will come."""

_POLL_S = 0.01


@dataclass(frozen=True)
class FollowedFile:
    """A frame that was read.

    Args:
        number: Frame number, from the file's name.
        path: The file.
        frame: Its people; None when the file never became whole.
        problem: Why it did not.
    """

    number: int
    path: Path
    frame: OpenPoseFrame | None
    problem: str = ""


def list_frames(folder: Path) -> list[tuple[int, Path]]:
    """Return the files of a folder that have a frame number, by it; several of one number are taken by name."""
    return _new_frames(folder, set(), -1)


def follow_folder(
    folder: Path,
    *,
    idle_s: float,
    is_stopped: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], object] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[FollowedFile]:
    """Return frames as their files become whole; ends with a file `STOP` or when nothing new came for `idle_s`.

    A file that is not whole yet (it cannot be read as OpenPose) holds up those after it until a later file is there
    that is whole: the writer is past it then, and it is given without people.  Files that come late, with a number
    before one that was already given, are left alone.

    Args:
        folder: Folder to watch.
        idle_s: Seconds without anything new after which the video is over.
        is_stopped: Tells that the video is over, as a file `STOP` does.
        sleep: Waits; tests write in it.
        clock: Seconds.
    """
    last = -1
    old: set[str] = set()
    since = clock()
    while True:
        is_told = is_stopped() or (folder / STOP_NAME).exists()
        waiting = _new_frames(folder, old, last)
        frames = [_read(number, path) for number, path in waiting]
        whole = [index for index, one in enumerate(frames) if one.frame is not None]
        is_over = is_told or clock() - since > idle_s
        ready = len(frames) if is_over else (whole[-1] + 1 if whole else 0)
        for one in frames[:ready]:
            last = one.number
            yield one
        if ready:
            since = clock()
        if is_over:
            return
        if not ready:
            sleep(_POLL_S)


def _new_frames(folder: Path, old: set[str], last: int) -> list[tuple[int, Path]]:
    """Do `list_frames` for frames after the last one given; names of others are remembered in `old`.

    A night's folder has hundreds of thousands of files: names that were looked at are not looked at again.
    """
    with os.scandir(folder) as entries:
        names = sorted(entry.name for entry in entries if entry.name not in old)
    numbered = []
    for name in names:
        number = openpose_frame_number(name) if name.endswith(".json") else None
        if number is None or number <= last:
            old.add(name)
        else:
            numbered.append((number, folder / name))
    return sorted(dict(reversed(numbered)).items())


def _read(number: int, path: Path) -> FollowedFile:
    try:
        return FollowedFile(number, path, read_openpose_frame(path.read_bytes()))
    except (FormatError, FileNotFoundError) as error:
        return FollowedFile(number, path, None, str(error))
