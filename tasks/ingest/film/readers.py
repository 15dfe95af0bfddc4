"""Reading film as a stream: images, time stamps and shots, never all images at once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.film.shots import ShotFinder, constant_rate_hz
from pasdedeux.formats.poses2d.image_names import STILLS_STEP, places_of_names
from pasdedeux.plain_text import counted
from tasks.files.user_files import open_file
from tasks.ingest.files import find_file
from tasks.ingest.poses2d.readers import IMAGE_SUFFIXES, VIDEO_SUFFIXES, open_capture, stated_rate_hz
from tasks.stage import SourceFile

Image = npt.NDArray[np.uint8]

_RUN_UP_S = (1.0, 8.0)
"""Times before a frame to which a film is sought; the second if the first is too short for the codec."""
_SAME_S = 1e-6
"""Time stamps with a smaller difference belong to one frame."""
_SAME_FRAME = 1e-3
"""A frame shows an image that comes later by at most this, in frames: time stamps are rounded."""


@dataclass(frozen=True)
class Film:
    """Properties of a film, from one complete reading.

    Args:
        files: The film, or its images in order.
        first_number: Number of the first frame: 0, or for images the number in its name.
        image_size_px: Width and height, upright.
        rate_hz: Typical rate; None for images.
        is_constant: Whether the rate is constant.
        starts: First frame of each shot.
        times_s: Time stamp of each frame; NaN if unknown.
        num_lost: Number of frames that the header states but that cannot be read.
    """

    files: tuple[SourceFile, ...]
    first_number: int
    image_size_px: tuple[int, int]
    rate_hz: float | None
    is_constant: bool
    starts: tuple[int, ...]
    times_s: tuple[float, ...] = field(repr=False)
    num_lost: int

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.times_s)

    def after_s(self, first: int) -> float | None:
        """Return the time stamp of the frame before `first`, for seeking; None if times do not grow."""
        return self.times_s[first - 1] if first and (np.diff(self.times_s) > 0).all() else None

    def read(self, first: int) -> Iterator[FilmFrame]:
        """Yield the frames from `first` on, as `read_film`."""
        return read_film(self.files, first, after_s=self.after_s(first))


@dataclass(frozen=True)
class FilmFrame:
    """One image (height, width, 3), BGR, upright, and its time; NaN if unknown."""

    image: Image
    time_s: float


def is_film(path: Path) -> bool:
    """Return whether a path is a film, or a folder of images without films."""
    if not path.is_dir():
        return path.suffix.lower() in VIDEO_SUFFIXES
    suffixes = {item.suffix.lower() for item in path.iterdir()}
    return bool(suffixes & IMAGE_SUFFIXES) and not suffixes & VIDEO_SUFFIXES


def first_shown(times_s: npt.ArrayLike, rate_hz: float) -> npt.NDArray[np.int64]:
    """Return the first frame that shows each image of a film, from the time stamps of the images.

    Frame n is at n / rate_hz seconds and shows the last image up to then.

    >>> first_shown([0.0, 0.05, 0.1, 0.35], 10.0).tolist()
    [0, 1, 1, 4]
    """
    return np.ceil(np.asarray(times_s) * rate_hz - _SAME_FRAME).astype(np.int64)


def image_at(shown: Sequence[int] | npt.NDArray[np.int64], frame: int) -> int:
    """Return the index of the image that a frame shows, from `first_shown`; -1 before the first.

    >>> [image_at([0, 1, 1, 4], frame) for frame in range(-1, 5)]
    [-1, 0, 2, 2, 2, 3]
    """
    return int(np.searchsorted(shown, frame, side="right")) - 1


def open_film(path: Path) -> Film:
    """Read a film once, from beginning to end.

    Raises:
        InputError: It does not exist or cannot be read; images differ in size, or an image is missing.
    """
    if not path.exists():
        raise InputError(f"film {path} does not exist")
    paths = [path]
    first_number = 0
    if path.is_dir():
        paths = sorted(item for item in path.iterdir() if item.suffix.lower() in IMAGE_SUFFIXES)
        if not paths:
            raise InputError(f"folder {path} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))})")
        places = places_of_names(item.name for item in paths)
        if len({video for video, _ in places.values()}) > 1:
            raise InputError(
                f"folder {path} holds the images of several films by their names; give each its own folder"
            )
        paths = sorted(paths, key=lambda item: places[item.name][1])
        numbers = [places[item.name][1] for item in paths]
        first_number = numbers[0]
        gap = next((number for at, number in enumerate(numbers) if number != first_number + at), None)
        if gap == STILLS_STEP:
            raise InputError(
                f"folder {path} holds single photographs by their names, no film; number the images of a film: "
                "frame_0001.jpg, frame_0002.jpg, ..."
            )
        if gap is not None:
            raise InputError(f"folder {path}: the image before {gap} is missing; images are numbered without gaps")
    files = tuple(map(find_file, paths))
    return _scanned(files, first_number)


def read_film(
    files: tuple[SourceFile, ...],
    first: int = 0,
    stop: int | None = None,
    *,
    after_s: float | None = None,
    sought: int | None = None,
) -> Iterator[FilmFrame]:
    """Yield some frames of a film.

    Args:
        files: The film, or its images.
        first: First frame.
        stop: Frame after the last one; None for all.
        after_s: Time stamp of the frame before `sought`; None to decode from the beginning.
        sought: Frame to seek; frames between it and the first are decoded and dropped; None for the first.

    Raises:
        InputError: The film cannot be opened, or the size of its images changes.
    """
    is_video = _is_video(files)
    frames = (
        _read_video(Path(files[0].path), first, stop, after_s, sought) if is_video else _read_images(files[first:stop])
    )
    size: tuple[int, ...] | None = None
    for number, frame in enumerate(frames, start=first):
        size = size or frame.image.shape[1::-1]
        if frame.image.shape[1::-1] != size:
            width, height = frame.image.shape[1::-1]
            name = Path(files[0 if is_video else number].path).name
            raise InputError(
                f"{name}: frame {number} is {width} x {height}, those before are {size[0]} x {size[1]} pixels"
            )
        yield frame


def _is_video(files: tuple[SourceFile, ...]) -> bool:
    return Path(files[0].path).suffix.lower() not in IMAGE_SUFFIXES


def _read_video(
    path: Path, first: int, stop: int | None, after_s: float | None, sought: int | None
) -> Iterator[FilmFrame]:
    capture, number = _opened_after(path, first if sought is None else sought, after_s)
    try:
        while (stop is None or number < stop) and capture.grab():
            if number >= first:
                was_read, image = capture.retrieve()
                if not was_read:
                    break
                yield FilmFrame(image.astype(np.uint8, copy=False), _time_s(capture))
            number += 1
    finally:
        capture.release()


def _opened_after(path: Path, first: int, after_s: float | None) -> tuple[Any, int]:
    """Return an opened film and the number of its next frame: `first`, or 0 if seeking fails.

    Seeking is exact in few codecs, so an earlier place is sought, and frames are identified by time stamps from there.
    """
    import cv2  # here: a quarter of a second that planning does not need

    capture = _opened(path)
    for run_up_s in _RUN_UP_S if after_s is not None else ():
        assert after_s is not None
        capture.set(cv2.CAP_PROP_POS_MSEC, 1000.0 * max(after_s - run_up_s, 0.0))
        reached_s = -math.inf
        while reached_s < after_s - _SAME_S and capture.grab():
            reached_s = _time_s(capture)
        if abs(reached_s - after_s) <= _SAME_S:
            return capture, first
    if after_s is not None:
        capture.release()
        capture = _opened(path)
    return capture, 0


def _time_s(capture: Any) -> float:
    import cv2  # here: a quarter of a second that planning does not need

    return float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0


def _opened(path: Path) -> Any:
    capture = open_capture(path)
    if not capture.isOpened():
        raise InputError(
            f"film {path.name} cannot be opened: it is cut off, empty, no video, or of a codec that OpenCV does not "
            "read; `ffmpeg -i FILM -c:v libx264 out.mp4` makes one that it reads"
        )
    return capture


def _read_images(files: tuple[SourceFile, ...]) -> Iterator[FilmFrame]:
    import cv2  # here: a quarter of a second that planning does not need

    for file in files:
        open_file(Path(file.path)).close()
        image = cv2.imread(file.path, cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(f"{Path(file.path).name} is no image that can be read")
        yield FilmFrame(image.astype(np.uint8, copy=False), math.nan)


_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
"""First bytes of a Matroska or WebM file, and of its segment (RFC 9559)."""
_SHORT_S = 0.25
"""A film whose last image is earlier than stated by more than this is cut off."""


@lru_cache(maxsize=64)
def _scanned(files: tuple[SourceFile, ...], first_number: int) -> Film:
    """Read a film once; cached, because a study is planned several times in a run."""
    finder, times = ShotFinder(), []
    size = (0, 0)
    for frame in read_film(files):
        finder.add(frame.image)
        times.append(frame.time_s)
        size = (frame.image.shape[1], frame.image.shape[0])
    name = Path(files[0].path).name
    if len(times) < 2:
        raise InputError(f"film {name} has {counted(len(times), 'frame')} that can be read; at least 2 are needed")
    rate_hz, is_constant, num_lost = None, True, 0
    if _is_video(files):
        import cv2  # here: a quarter of a second that planning does not need

        capture = _opened(Path(files[0].path))
        rate_hz, stated = stated_rate_hz(capture), float(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        num_lost = _num_lost(Path(files[0].path), stated, rate_hz, times)
        if (np.diff(times) > 0).all():
            rate_hz, is_constant = constant_rate_hz(np.array(times))
    return Film(files, first_number, size, rate_hz, is_constant, tuple(finder.starts()), tuple(times), num_lost)


def _num_lost(path: Path, stated: float, stated_hz: float | None, times_s: Sequence[float]) -> int:
    """Return how many stated frames of a film cannot be read; 0 if its times reach the stated length.

    For containers without a count of frames the stated number is length times rate, which is too large if sound is
    longer than the images or the rate varies.  Matroska and WebM files are cut off if they are shorter than their
    segment.
    """
    if stated_hz is None or not len(times_s) < round(stated) < 1e9:
        return 0
    is_cut = _is_cut_matroska(path)
    if is_cut is None:
        is_cut = (stated - 1) / stated_hz - times_s[-1] > max(_SHORT_S, 2.0 / stated_hz)
    return round(stated) - len(times_s) if is_cut else 0


def _is_cut_matroska(path: Path) -> bool | None:
    """Return whether a Matroska or WebM file is shorter than its segment; None for other files or unknown sizes."""
    with open_file(path) as file:
        head = file.read(4096)
    start = head.find(_SEGMENT) + len(_SEGMENT)
    if not head.startswith(_EBML) or start < len(_SEGMENT) or start + 8 > len(head):
        return None
    width = 9 - head[start].bit_length()  # the leading zeros of the first byte give the length of the number
    size = int.from_bytes(head[start : start + width]) & ((1 << 7 * width) - 1)
    is_unknown = size == (1 << 7 * width) - 1
    return not is_unknown and path.stat().st_size < start + width + size
