"""Inputs of `reconstruct`: videos of one or several cameras as 2D poses or film, and a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flows.console.annotate import film_source
from flows.console.context import echo
from flows.console.inputs import find_source
from flows.exports.reconstructions import CameraData
from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.calibration import CalibratedCamera, choose_cameras, read_calibration
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.people.video import check_one_video
from pasdedeux.reconstruction.moving_camera import subtract_motion
from pasdedeux.reconstruction.tracks import Track, tracks_of
from tasks.files.user_files import MAX_TEXT_BYTES, read_file
from tasks.ingest.film.detector_files import fetched_detectors
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import is_film
from tasks.ingest.film.run import FoundFilm, find_videos
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import FoundAnnotations, find_annotations
from tasks.ingest.poses2d.run import track_columns


def find_video(
    path: Path,
    settings: Sequence[str],
    keys: Path | None = None,
    detections: Path | None = None,
    detect: Sequence[str] | None = None,
) -> AnnotationOptions | FilmOptions:
    """Return the film or the 2D poses that the options of the command describe."""
    if keys or detections or detect or (fetched_detectors() and is_film(path)):
        return film_source(path, settings, keys, detections, detect)
    return find_source(AnnotationOptions, path, settings)


def sources_of(video: AnnotationOptions | FilmOptions) -> Sequence[FoundAnnotations]:
    """Return the shots of a film, or the files of 2D poses."""
    return find_videos(video) if isinstance(video, FilmOptions) else find_annotations(video)


def camera_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of cameras: their files, with as many folders as make them unique, else with a number.

    >>> camera_names([Path("a/x/pose.json"), Path("b/x/pose.json")])
    ['a/x/pose', 'b/x/pose']
    """
    files = [path.resolve() for path in paths]
    files = [path if path.is_dir() else path.with_suffix("") for path in files]
    for depth in range(1, max(len(path.parts) for path in files)):
        names = ["/".join(path.parts[-depth:]) for path in files]
        if len(set(names)) == len(names):
            return names
    return [f"{number}: {path.name}" for number, path in enumerate(files, start=1)]


@dataclass(frozen=True)
class OtherCamera:
    """Another camera of a take.

    Args:
        tracks: Tracks of its people.
        footage: Its camera motion and film.
        size_px: Width and height of its images, if known.
    """

    tracks: list[Track]
    footage: CameraData
    size_px: tuple[float, float] | None


def find_camera(path: Path, settings: Sequence[str], detect: Sequence[str] | None) -> FoundAnnotations:
    """Find the video of another camera of a take, for `read_camera`.

    Raises:
        InputError: The path cannot be found, or is not one video.
    """
    sources = sources_of(find_video(path, settings, detect=detect if is_film(path) else None))
    check_one_video(f"--camera {path}", [source.parameters.id for source in sources])
    return sources[0]


def read_camera(name: str, source: FoundAnnotations) -> OtherCamera:
    """Read the video of another camera of a take.

    Raises:
        InputError: The video cannot be read, or is not one video.
    """
    resolved = source.resolve()
    check_one_video(f"camera {name}", [sequence.sequence_id for sequence in resolved.sequences])
    (sequence,) = resolved.sequences
    tracks, motion = steady_tracks(resolved, sequence)
    if not tracks:
        raise InputError(f"camera {name}: no frame shows enough joints of a person")
    footage = CameraData(motion, source if isinstance(source, FoundFilm) else None)
    return OtherCamera(tracks, footage, image_size_px(resolved, sequence))


def image_size_px(resolved: ResolvedPeople, sequence: SequencePeople) -> tuple[float, float] | None:
    """Return width and height of the images of a sequence, if they are known."""
    return resolved.frames.image_size_px.get(sequence.sequence_id)


def film_size_px(source: FoundAnnotations) -> tuple[int, int] | None:
    """Return width and height of the images of a film before it is read; None for 2D poses."""
    return source.parameters.video_size_px if isinstance(source, FoundFilm) else None


def steady_tracks(resolved: ResolvedPeople, sequence: SequencePeople) -> tuple[list[Track], CameraMotion | None]:
    """Return the tracks of a sequence in its steady image, and the camera motion if it was subtracted; print both.

    Raises:
        InputError: The sequence is no video.
    """
    if sequence.why_not_followed:
        raise InputError(sequence.why_not_followed)
    motion = resolved.frames.camera_motion.get(sequence.sequence_id)
    tracks, is_steadied = subtract_motion(tracks_of(track_columns(resolved), sequence.sequence_id), motion)
    if motion is not None:
        echo(f"{sequence.sequence_id}: {motion.in_words(is_subtracted=is_steadied)}", err=True)
    for doubt in resolved.frames.doubts:
        echo(f"{sequence.sequence_id}: {doubt}", err=True)
    return tracks, motion if is_steadied else None


@dataclass(frozen=True)
class Calibration:
    """The cameras of a calibration file in the order of the videos; none without a file."""

    path: Path | None
    names: Sequence[str]
    cameras: Sequence[CalibratedCamera] = ()

    def for_images(self, sizes_px: Sequence[tuple[float, float] | None]) -> list[CalibratedCamera]:
        """Return the cameras for images of these sizes, one for each video.

        Raises:
            InputError: Images have another shape than those of the calibration.
        """
        fitting = []
        for camera, name, size_px in zip(self.cameras, self.names, sizes_px, strict=False):
            try:
                fitting.append(camera.for_images(size_px))
            except InputError as error:
                raise InputError(
                    f"--calibration {self.path}: video {name}: {error}; name the camera's video as it was recorded, "
                    "neither turned nor cropped, or calibrate with images like its own"
                ) from None
        return fitting


def find_calibration(path: Path | None, names: Sequence[str]) -> Calibration:
    """Read the calibration of videos with these names, and print which camera is which.

    Raises:
        InputError: It cannot be read, or does not fit the videos.
    """
    if path is None:
        return Calibration(path, names)
    try:
        cameras = read_calibration(read_file(path, max_bytes=MAX_TEXT_BYTES))
        chosen, is_by_name = choose_cameras(cameras, names)
    except InputError as error:
        raise InputError(f"--calibration {path}: {error}") from None
    which = ", ".join(f"{name} is {camera.name}" for name, camera in zip(names, chosen, strict=True))
    rest = ", ".join(camera.name for camera in cameras if all(camera is not other for other in chosen))
    echo(
        f"calibration {'by name' if is_by_name else 'in the order of the file, as no names fit'}: {which}"
        f"{f'; left out: {rest}' if rest else ''}",
        err=True,
    )
    return Calibration(path, names, chosen)
