"""The files of a source of 2D poses by camera, and the video beside them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pasdedeux.errors import InputError, named
from pasdedeux.formats.poses2d.detections import Footage
from pasdedeux.formats.poses2d.image_names import number_in_name, places_of_names
from pasdedeux.formats.registry import ANNOTATION_FORMATS, find_format
from tasks.files.user_files import open_file
from tasks.ingest.files import read_start

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".mts"})
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})
_SUFFIXES = frozenset(end for kind in ANNOTATION_FORMATS.values() for end in kind.suffixes)
_TEXT = ".txt"
_FRAME_SUFFIXES = frozenset(
    end for kind in ANNOTATION_FORMATS.values() if kind.is_file_per_frame for end in kind.suffixes
)
_SEPARATORS = "_-. "
_EMPTY_LIST = 4
"""Size of a file of an image without people, `[]`, which has no format."""
_NUM_TRIED = 20
"""Maximum number of files that are read to detect the format of a folder: first images may show nobody."""


@dataclass(frozen=True)
class CameraFiles:
    """The files of one camera.

    Args:
        name: Name of the camera; empty if a source has only one.
        format: Format of the files.
        paths: One file, or the files of all frames.
    """

    name: str
    format: str
    paths: tuple[Path, ...]


def find_cameras(path: Path, format_name: str = "auto", *, skipped: dict[str, str] | None = None) -> list[CameraFiles]:
    """Return the files of each camera of a source: a file, a folder of frames, or a folder of either.

    In a folder of files of frames, each beginning of names is a camera (`cam1_0012.json`); any other file, and each
    folder inside, is a camera, too.  If `skipped` is given, more files may come: files that are not of 2D poses are
    added to it with the reason, and a single camera gets a name as well.

    Raises:
        InputError: It does not exist or has no known files, or it has a video or images, which need a detector.
    """
    if not path.is_dir():
        refuse_film([path], path)
        return [CameraFiles("", _format_of(path, format_name), (path,))]
    cameras = _cameras_in(path, format_name, skipped)
    if not cameras or skipped is not None:
        folders = sorted(item for item in path.iterdir() if item.is_dir())
        for folder in folders:
            for camera in _cameras_in(folder, format_name, skipped):
                name = folder.name.removesuffix("_json")
                cameras.append(CameraFiles(f"{name}_{camera.name}".rstrip("_"), camera.format, camera.paths))
    if not cameras and not skipped:
        refuse_film(sorted(path.iterdir()), path)
        raise InputError(f"folder {path} holds no files of 2D poses ({', '.join(sorted(_SUFFIXES))})")
    is_alone = len(cameras) == 1 and skipped is None
    return [CameraFiles("", cameras[0].format, cameras[0].paths)] if is_alone else cameras


def _cameras_in(folder: Path, format_name: str, skipped: dict[str, str] | None) -> list[CameraFiles]:
    """Return the cameras of the files directly in a folder."""
    paths = sorted(item for item in folder.iterdir() if item.suffix.lower() in _SUFFIXES and item.is_file())
    paths = [item for item in paths if item.suffix.lower() != _TEXT] or paths  # beside others a text is a note
    of_frames = [item for item in paths if item.suffix.lower() in _FRAME_SUFFIXES]
    numbered = [item for item in of_frames if number_in_name(item.name)[1] is not None]
    if not paths:
        return []
    candidates = numbered or paths
    tried = [item for item in candidates if item.stat().st_size > _EMPTY_LIST][:_NUM_TRIED]
    name = _frames_format(tried or candidates[:1], format_name)
    if name is None:
        seen_cameras = []
        for path in paths:
            try:
                seen_cameras.append(CameraFiles(path.stem, _format_of(path, format_name), (path,)))
            except InputError as error:
                if skipped is None:
                    raise
                skipped[path.stem] = str(error)
        return seen_cameras
    frames = numbered or of_frames
    cameras: dict[str, list[Path]] = {}
    for item, (camera, _) in zip(frames, places_of_names(item.name for item in frames).values(), strict=True):
        cameras.setdefault(camera, []).append(item)
    return [CameraFiles(camera, name, tuple(files)) for camera, files in sorted(cameras.items())]


def _frames_format(tried: Sequence[Path], format_name: str) -> str | None:
    """Return the format of a folder's files if each is a frame, else None; damaged files count as frames.

    The first recognised file of `tried` decides.
    """
    if format_name != "auto":
        return format_name if ANNOTATION_FORMATS[format_name].is_file_per_frame else None
    suffix = tried[0].suffix.lower()
    if suffix not in _FRAME_SUFFIXES:
        return None
    per_frame = [
        name for name, kind in ANNOTATION_FORMATS.items() if kind.is_file_per_frame and suffix in kind.suffixes
    ]
    name = per_frame[0]
    for item in tried:
        start = read_start(item)
        with suppress(InputError):
            name = find_format(ANNOTATION_FORMATS, "auto", start).name
            break
    return name if ANNOTATION_FORMATS[name].is_file_per_frame else None


def _format_of(path: Path, format_name: str) -> str:
    start = read_start(path)
    with named(path.name):
        return find_format(ANNOTATION_FORMATS, format_name, start).name


def refuse_film(paths: Sequence[Path], path: Path) -> None:
    """Refuse a video or images, with advice how to annotate or detect people first."""
    suffixes = {item.suffix.lower() for item in paths}
    what = "video" if suffixes & VIDEO_SUFFIXES else "images" if suffixes & IMAGE_SUFFIXES else ""
    if what:
        if not path.exists():
            raise InputError(f"film {path} does not exist")
        raise InputError(
            f"{path} is {'a video' if what == 'video' else 'a folder of images' if path.is_dir() else 'an image'}: the "
            "people in it must be annotated or detected: give key frames (--keys FILE), a detector's keypoints "
            "(--detections FILE) or a detector (--detect FILE.onnx, or what `pasdedeux fetch detector rtmo-m` brings); "
            "in a study [[ingest.videos]]"
        )


def video_beside(path: Path, camera: CameraFiles) -> Path | None:
    """Return the video of a camera's files, if it is beside them; else None.

    The video has the same name, or a beginning or end of it (`clip.mp4` with `clip_keypoints.json`), in the same
    folder, the one above, or `videos` in either; or it is the only video inside a folder of one camera's frames.

    Args:
        path: The source: file or folder.
        camera: One of its cameras.
    """
    inside = path if path.is_dir() else path.parent
    folders = [inside, inside.parent, inside / "videos", inside.parent / "videos", inside.parent.parent / "videos"]
    names = [camera.name or path.resolve().stem.removesuffix("_json")]
    if camera.name or not path.is_dir():
        names.append(camera.paths[0].stem if len(camera.paths) == 1 else camera.paths[0].parent.name)
    for folder in folders if path.is_dir() else folders[:1] + folders[3:4]:
        videos = _videos(folder)
        fitting = [video for video in videos if any(is_named_after(name, video.stem) for name in names)]
        if fitting:
            return max(fitting, key=lambda video: len(video.stem))
        if folder == path and len(videos) == 1 and not camera.name:
            return videos[0]
    return None


def _videos(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES) if folder.is_dir() else []


def is_named_after(name: str, stem: str) -> bool:
    """Return whether a name is that of a video, also with a prefix or suffix."""
    name, stem = name.lower(), stem.lower()
    return name == stem or any(
        name.startswith(stem + separator) or name.endswith(separator + stem) for separator in _SEPARATORS
    )


def open_capture(video: Path) -> Any:
    """Return OpenCV's reader of a video, opened or not, without messages of libraries about faults.

    Raises:
        InputError: It does not exist, or is not a regular file.
    """
    open_file(video).close()
    # Both are read when the first video is opened: AV_LOG_QUIET, and no network access from playlists.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
    import cv2  # here: a quarter of a second that planning does not need

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    return cv2.VideoCapture(str(video.absolute()), cv2.CAP_FFMPEG)


def read_header(video: Path) -> Footage:
    """Return image size and rate in a video's header; None for both if it cannot be opened."""
    import cv2

    capture = open_capture(video)
    try:
        width, height = (
            int(capture.get(property_id)) for property_id in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        rate_hz = stated_rate_hz(capture)
    finally:
        capture.release()
    return Footage((width, height) if width > 0 and height > 0 else None, rate_hz)


def stated_rate_hz(capture: Any) -> float | None:
    """Return the rate in the header of an opened video; None if it is not plausible."""
    import cv2

    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    return rate_hz if 0 < rate_hz <= 1000 else None
