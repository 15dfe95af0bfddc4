"""The film of 2D poses, if it is still in its place in the study; images are read when they are shown."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from storage_schema import Manifest
from tasks.files.user_files import user_file_digest
from tasks.ingest.film.detector_files import find_network
from tasks.ingest.film.parameters import FilmParameters
from tasks.ingest.film.readers import FilmFrame, first_shown, image_at, read_film
from tasks.ingest.film.resolution import CorrectedShot
from tasks.ingest.poses2d.readers import find_cameras, read_header, video_beside
from tasks.stage import SourceFile

_LARGEST_PX = 960
"""Longer side of the images."""
_NUM_KEPT = 240
_NOWHERE = -(10**9)
_NUM_BEFORE = 30
"""Images read before the requested one, for steps back."""


def find_film(manifest: Manifest, ingest: Mapping[str, Any]) -> FilmReader | None:
    """Return the film of an artifact of 2D poses, whose files are found on first use; None without one.

    Args:
        manifest: The artifact.
        ingest: The recorded section of the study.
    """
    settings = manifest.parameters
    if "num_given" in settings:
        names = manifest.files[settings["num_given"] + settings["num_networks"] :]
        find = partial(_find_files, names, [Path(video["path"]) for video in ingest.get("videos", ())])
        rate_hz = None if settings["is_constant_rate"] else settings["video_rate_hz"]
        return FilmReader(
            cache(find), settings["first_number"], settings["first_frame"], settings.get("after_s"), rate_hz
        )
    for source in ingest.get("annotations", ()):
        path = Path(source["path"])
        try:
            cameras = find_cameras(path, source.get("format", "auto")) if path.exists() else []
        except InputError:
            continue
        for camera in cameras:
            name = f"{source['id']}.{camera.name}" if camera.name else source["id"]
            if name == settings.get("id") and (video := video_beside(path, camera)) is not None:
                header, size = read_header(video), settings.get("video_size_px")
                if [*(header.image_size_px or ())] == [*(size or ())]:
                    return FilmReader(partial(tuple, [SourceFile(path=str(video), sha256="")]))
    return None


def find_shot(manifest: Manifest, ingest: Mapping[str, Any]) -> CorrectedShot:
    """Track the shot of film of an artifact of 2D poses again, and return it.

    Raises:
        InputError: One of its files is missing or has changed.
    """
    places: list[Path] = []
    for video in ingest.get("videos", ()):
        places += [Path(video[name]) for name in ("path", "keys", "detections") if video.get(name)]
        places += [Path(find_network(network).path) for network in video.get("detect", ())]
    return CorrectedShot(FilmParameters.model_validate(manifest.parameters), _find_files(manifest.files, places))


def _find_files(names: Sequence[tuple[str, str]], places: Sequence[Path]) -> tuple[SourceFile, ...]:
    """Return the files with these names and digests in the folders of these places."""
    folders = dict.fromkeys(place if place.is_dir() else place.parent for place in places)
    files = []
    for name, digest in names:
        existing = (folder / name for folder in folders if (folder / name).is_file())
        path = next((path for path in existing if _digest(path) == digest), None)
        if path is None:
            raise InputError(f"the film {name} of these 2D poses is missing, or has changed since it was read")
        files.append(SourceFile(path=str(path), sha256=digest))
    return tuple(files)


@cache  # each shot of a film is an artifact of all its images
def _digest(path: Path) -> str:
    return user_file_digest(path)


@dataclass
class FilmReader:
    """Images of a film by frame number; the last ones are kept, small and compressed.

    Args:
        find: Finds the film, or its images in order; may read all of it.
        first_number: Number of its first image.
        first_frame: First frame of the shot, counted from the beginning of the film.
        after_s: Time stamp of the frame before, for seeking; None: decode from the beginning.
        rate_hz: Rate of the frames, if the film's own rate varies.
    """

    find: Callable[[], tuple[SourceFile, ...]]
    first_number: int = 0
    first_frame: int = 0
    after_s: float | None = None
    rate_hz: float | None = None
    trouble: str = field(default="", init=False)
    """Why it could not be read."""
    _kept: dict[int, Any] = field(default_factory=dict, init=False, repr=False)
    _times_s: dict[int, float] = field(default_factory=dict, init=False, repr=False)
    """Time stamps of the images read so far, by their number from the first frame."""
    _shown: list[int] = field(default_factory=list, init=False, repr=False)
    _frames: Iterator[FilmFrame] = field(default_factory=lambda: iter(()), init=False, repr=False)
    _next: int = field(default=_NOWHERE, init=False, repr=False)
    """Number of the next image of `_frames`."""
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def image(self, number: int) -> Array | None:
        """Return an image (height, width, 3), RGB, at most 960 pixels wide; None if it cannot be read."""
        import cv2  # here, as the import takes a quarter of a second

        with self._lock:
            try:
                packed = self._kept.get(self._read(number))
            except InputError as error:
                self.trouble, packed = str(error), None
        image: Any = None if packed is None else cv2.imdecode(packed, cv2.IMREAD_COLOR_RGB)
        return image

    def _read(self, number: int) -> int:
        """Read the image of a frame, unless it is kept, from the nearest earlier one to seek; return its number.

        For a varying rate, the image is known once the next one was read.
        """
        at, is_sure = self._place(number)
        if is_sure and at in self._kept:
            return at
        wanted = at if is_sure else len(self._shown)
        if not self._next <= wanted < self._next + _NUM_KEPT:
            self._seek(max(wanted - _NUM_BEFORE, 0))
        while not (is_sure and at < self._next):
            if not self._read_next():
                return at if is_sure or self._shown[-1:] == [number] else _NOWHERE
            at, is_sure = self._place(number)
        return at

    def _place(self, number: int) -> tuple[int, bool]:
        """Return the number of a frame's image by the known time stamps, and whether it is certain."""
        if self.rate_hz is None:
            return number - self.first_number - self.first_frame, True
        at = image_at(self._shown, number)
        return at, at + 1 < len(self._shown)

    def _seek(self, begin: int) -> None:
        """Continue from an image; the stream is sought to the last earlier image with a time stamp."""
        known = sorted(at for at in self._times_s if at < begin)
        times_s = [self._times_s[at] for at in known]
        is_told = bool(known) and (np.diff(times_s) > 0).all()
        sought, after_s = (known[-1] + 1, times_s[-1]) if is_told else (0, self.after_s)
        first = self.first_frame
        self._frames = read_film(self.find(), first + begin, after_s=after_s, sought=first + sought)
        self._next = begin

    def _read_next(self) -> bool:
        """Read and keep the next image; return whether there was one."""
        import cv2  # here, as the import takes a quarter of a second

        frame = next(self._frames, None)
        if frame is None:
            self._next = _NOWHERE
            return False
        self._times_s[self._next] = frame.time_s
        if self.rate_hz is not None and self._next == len(self._shown):
            self._shown.append(int(first_shown(frame.time_s, self.rate_hz)))
        scale = min(1.0, _LARGEST_PX / max(frame.image.shape[:2]))
        size = [max(1, round(scale * side)) for side in frame.image.shape[1::-1]]
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        self._kept[self._next] = np.asarray(cv2.imencode(".jpg", small)[1])
        for old in list(self._kept)[:-_NUM_KEPT]:
            del self._kept[old]
        self._next += 1
        return True
