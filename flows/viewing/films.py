"""The film that 2D poses were seen in, where it still is where the study says: its images, read when they are shown."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from storage_schema import Manifest
from tasks.ingest.cameras import find_cameras, read_header, video_beside
from tasks.ingest.detector_files import find_network
from tasks.ingest.films import FilmFrame, digest_of, read_film
from tasks.ingest.shard_parameters import FilmParameters
from tasks.ingest.shots import CorrectedShot
from tasks.stage import SourceFile

_LARGEST_PX = 960
"""Longer side of the images that are shown and kept."""
_NUM_KEPT = 240
_NOWHERE = -(10**9)
_NUM_BEFORE = 30
"""Images read before the one that is looked for, so that steps back find theirs."""


def find_film(manifest: Manifest, ingest: Mapping[str, Any]) -> FilmReader | str | None:
    """Return the film of an artifact of 2D poses, why it cannot be shown, or None where there is none.

    Args:
        manifest: The artifact.
        ingest: The section of the study, as it was recorded.
    """
    told = manifest.parameters
    if "num_given" in told:
        names = manifest.files[told["num_given"] + told["num_networks"] :]
        return _film_of_study(manifest, names, [Path(one["path"]) for one in ingest.get("videos", ())])
    for source in ingest.get("annotations", ()):
        path = Path(source["path"])
        try:
            cameras = find_cameras(path, source.get("format", "auto")) if path.exists() else []
        except InputError:
            continue
        for camera in cameras:
            name = f"{source['id']}.{camera.name}" if camera.name else source["id"]
            if name == told.get("id") and (video := video_beside(path, camera)) is not None:
                header, size = read_header(video), told.get("video_size_px")
                if [*(header.image_size_px or ())] == [*(size or ())]:
                    return FilmReader((SourceFile(path=str(video), sha256=""),), 0, 0, None)
    return None


def find_shot(manifest: Manifest, ingest: Mapping[str, Any]) -> CorrectedShot:
    """Return the shot of film of an artifact of 2D poses, tracked, which takes as long as its first time.

    Raises:
        InputError: One of its files is not where the study says, or has changed since.
    """
    places: list[Path] = []
    for one in ingest.get("videos", ()):
        places += [Path(one[name]) for name in ("path", "keys", "detections") if one.get(name)]
        places += [Path(find_network(network).path) for network in one.get("detect", ())]
    folders = dict.fromkeys(place if place.is_dir() else place.parent for place in places)
    files = []
    for name, digest in manifest.files:
        found = (folder / name for folder in folders if (folder / name).is_file())
        path = next((path for path in found if _digest(path) == digest), None)
        if path is None:
            raise InputError(
                f"{name}, which these 2D poses are from, is not where the study says, or has changed since"
            )
        files.append(SourceFile(path=str(path), sha256=digest))
    return CorrectedShot(FilmParameters.model_validate(manifest.parameters), tuple(files))


def _film_of_study(manifest: Manifest, names: Sequence[tuple[str, str]], paths: Sequence[Path]) -> FilmReader | str:
    told, first = manifest.parameters, names[0][0]
    for path in paths:
        folder = path if path.is_dir() else path.parent
        if all((folder / name).is_file() and _digest(folder / name) == digest for name, digest in names):
            files = tuple(SourceFile(path=str(folder / name), sha256=sha) for name, sha in names)
            rate_hz = None if told["is_constant_rate"] else told["video_rate_hz"]
            return FilmReader(files, told["first_number"], told["first_frame"], rate_hz)
    return f"its film {first} is not where the study says, or has changed since"


@cache  # the shots of a film are each an artifact of all of its images
def _digest(path: Path) -> str:
    return digest_of(path)


@dataclass
class FilmReader:
    """Images of a film by the number of their frame; the last ones that were read are kept, small and packed.

    Args:
        files: The film, or its images in order.
        first_number: Number of its first image.
        first_frame: First frame that may be asked for, from the beginning of the film.
        rate_hz: Where its rate varies, frame n is what is seen n / rate_hz seconds after its beginning.
    """

    files: tuple[SourceFile, ...]
    first_number: int
    first_frame: int
    rate_hz: float | None
    _kept: dict[int, Any] = field(default_factory=dict, init=False, repr=False)
    _frames: Iterator[FilmFrame] = field(default_factory=lambda: iter(()), init=False, repr=False)
    _next: int = field(default=_NOWHERE, init=False, repr=False)
    """Number of the next image of `_frames`."""
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def image(self, number: int) -> Array | None:
        """Return an image (height, width, 3), RGB, at most 960 pixels wide; None where it cannot be read."""
        import cv2  # here: a quarter of a second that others need not wait for

        with self._lock:
            if number not in self._kept and not 0 <= number - self._next < _NUM_KEPT:
                begin = 0 if self.rate_hz else max(number - self.first_number - _NUM_BEFORE, self.first_frame)
                self._frames, self._next = read_film(self.files, begin), begin + self.first_number
            while number not in self._kept and (read := self._read_next()) is not None:
                if read > number:  # a film of a varying rate has no image of just then
                    self._kept.setdefault(number, self._kept[read])
            packed = self._kept.get(number)
        image: Any = None if packed is None else cv2.imdecode(packed, cv2.IMREAD_COLOR_RGB)
        return image

    def _read_next(self) -> int | None:
        """Read and keep one more image; return its number, None at the end."""
        import cv2  # here: a quarter of a second that others need not wait for

        try:
            frame = next(self._frames, None)
        except InputError:
            frame = None
        if frame is None:
            self._next = _NOWHERE
            return None
        number = self._next if self.rate_hz is None else round(frame.time_s * self.rate_hz)
        scale = min(1.0, _LARGEST_PX / max(frame.image.shape[:2]))
        size = [max(1, round(scale * one)) for one in frame.image.shape[1::-1]]
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        self._kept[number] = np.asarray(cv2.imencode(".jpg", small)[1])
        self._next = number + 1
        for old in list(self._kept)[:-_NUM_KEPT]:
            del self._kept[old]
        return number
