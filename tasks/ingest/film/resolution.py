"""Shots of films as sources of 2D poses: finding and checking them, and annotating all their frames."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError, named
from pasdedeux.film.annotating import AnnotatedShot, annotate_shot, correct_keypoint, frames_to_correct, with_identities
from pasdedeux.film.detectors import load_detector
from pasdedeux.film.shots import at_constant_rate
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, get_keypoint_layout, join_frames
from pasdedeux.formats.poses2d.detections import Detection, Footage, join_detections
from pasdedeux.formats.registry import ANNOTATION_FORMATS, clean_annotations
from pasdedeux.skeletons import PAIR17
from tasks.ingest.common import frames_in
from tasks.ingest.files import find_file, read_again
from tasks.ingest.film.detector_files import find_network
from tasks.ingest.film.parameters import FilmOptions, FilmParameters
from tasks.ingest.film.readers import Film, FilmFrame, first_shown, image_at, is_film, open_film, read_film
from tasks.ingest.poses2d.parameters import SOURCE_FILES
from tasks.ingest.poses2d.readers import VIDEO_SUFFIXES, find_cameras, is_named_after
from tasks.ingest.poses2d.resolution import own_layout_of, read_given
from tasks.stage import SourceFile

ASSUMED_RATE_HZ = 30.0
"""Rate of a folder of images if none is stated."""
_MAX_RATE_RATIO = 1.02
"""Maximum ratio of the rates of annotations and film; beyond it they are of another film."""


@dataclass(frozen=True)
class FoundShot:
    """A shot of a film: parameters and files of its shard, and notes on its given poses."""

    parameters: FilmParameters
    files: tuple[SourceFile, ...]
    film: Film
    notes: tuple[str, ...] = ()


def find_shots(
    options: FilmOptions, *, is_held_out: bool = False, take_seconds: float | None = None
) -> list[FoundShot]:
    """Find the films of a source and their shots, and check key frames or detections against them.

    Shots without key frames or detections are left out.

    Raises:
        InputError: A film cannot be read, a file is damaged, or they do not fit each other.
    """
    with named(f"video {options.id}"):
        films = _films_of(options)
        networks = tuple(find_network(file) for file in options.detect)
        if networks:
            load_detector([read_again(file) for file in networks])
        shots = []
        for name, path, given in films:
            shots += _shots_of(options, name, open_film(path), path, given, networks, is_held_out, take_seconds)
    if not shots:
        raise InputError(f"video {options.id}: none of its shots has keypoints: give keys, detections or detect")
    return shots


def annotate_film(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> AnnotatedShot:
    """Return the annotations of all frames of a shot, with the film's frame numbers, and their doubts.

    Raises:
        InputError: A file has changed, or nobody is found.
    """
    return _annotated(parameters, files)[0]


def read_shot(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Return the annotations of a shot at a constant rate, for ingest."""
    return CorrectedShot(parameters, files).placed()


class CorrectedShot:
    """A shot whose keypoints a person corrects one by one; tracks between known frames are updated.

    Args:
        parameters: The shard of the shot.
        files: Its files.

    Raises:
        InputError: A file has changed, or nobody is found.
    """

    def __init__(self, parameters: FilmParameters, files: tuple[SourceFile, ...]) -> None:
        self._parameters, self._files = parameters, files
        self.shot, times = _annotated(parameters, files)
        self._times_s = np.array(times)
        self._first = parameters.first_number + parameters.first_frame
        assert self.shot.frames.rate_hz is not None
        self._rate_hz = self.shot.frames.rate_hz
        self._begun = self.placed()

    def changes_px(self) -> dict[tuple[int, int], Array]:
        """Return moved joints of pair17 (17, 2) by frame of `placed` and person; others are NaN."""
        layout, now = get_keypoint_layout(self._begun.layout), self.placed()
        before, after = (
            layout.derive(PAIR17.name, frames.keypoints_px, frames.confidence).positions
            for frames in (self._begun, now)
        )
        moved = np.where((before == after).all(axis=-1, keepdims=True), np.nan, after)
        places = zip(now.frame.tolist(), now.person_id.tolist(), strict=True)
        return {place: px for place, px in zip(places, moved, strict=True) if np.isfinite(px).any()}

    def placed(self) -> AnnotatedFrames:
        """Return the annotations at a constant rate, for ingest."""
        if self._parameters.is_constant_rate:
            return self.shot.frames
        return at_constant_rate(self.shot.frames, self._first, self._times_s, self._rate_hz)

    def film_frame(self, frame: int) -> int:
        """Return the frame of the film that a frame of `placed` shows."""
        if self._parameters.is_constant_rate:
            return frame
        return self._first + max(image_at(first_shown(self._times_s, self._rate_hz), frame), 0)

    def next_frames(self, count: int) -> list[int]:
        """Return the frames of `placed` whose correction helps most, most first."""
        frames = frames_to_correct(self.shot, count)
        if self._parameters.is_constant_rate:
            return frames
        return [int(first_shown(self._times_s[frame - self._first], self._rate_hz)) for frame in frames]

    def correct(self, frame: int, person_id: int, joint: str, point_px: Array) -> None:
        """Place a joint of pair17 in a frame of the film, and track it again between the known frames.

        Raises:
            InputError: The person is not in this frame, or the joint is a mean of several keypoints.
        """
        layout = get_keypoint_layout(self.shot.frames.layout)
        names = [*next(iter(layout.recipes[PAIR17.name].get(joint, ())), {})]
        if len(names) != 1:
            mean = f", but the mean of {' and '.join(names)}: correct those" if names else ""
            raise InputError(f"{joint} is no keypoint of the layout '{layout.name}'{mean}")
        keypoint, is_key = layout.keypoint_names.index(names[0]), self._parameters.is_key
        self.shot = correct_keypoint(self.shot, frame, person_id, keypoint, point_px, self._images, is_key=is_key)

    def given(self) -> AnnotatedFrames:
        """Return the keypoints from a person or a detector, also of the film's other shots, to be named in a study.

        If a detector was run, the other shots are not included.
        """
        given_frames = self.shot.frames.given()
        if self._parameters.num_networks:
            return given_frames
        others = _given(self._parameters, self._files)
        source = KeypointStatus.ANNOTATED if self._parameters.is_key else KeypointStatus.DETECTED
        if others.status is None:
            others = replace(others, status=np.where(others.confidence > 0, source, 0))
        span = self._first, self._first + self._parameters.num_frames
        return join_frames([given_frames, others.rows((others.frame < span[0]) | (others.frame >= span[1]))])

    def _images(self, first: int, stop: int) -> Iterator[Any]:
        """Yield the images of some frames of the film."""
        start, stop = first - self._first, min(stop - self._first, self._parameters.num_frames)
        begin, after_s = self._parameters.first_frame, self._parameters.after_s
        if start > 0:
            after_s = float(self._times_s[start - 1]) if (np.diff(self._times_s) > 0).all() else None
        film = self._files[self._parameters.num_given + self._parameters.num_networks :]
        return (frame.image for frame in read_film(film, begin + start, begin + stop, after_s=after_s))


def shot_images(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> Iterator[tuple[int, FilmFrame]]:
    """Yield the images of a shot, each with its number."""
    film, first = files[parameters.num_given + parameters.num_networks :], parameters.first_frame
    frames = read_film(film, first, first + parameters.num_frames, after_s=parameters.after_s)
    return enumerate(frames, start=parameters.first_number + first)


@lru_cache(maxsize=4)
def _annotated(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> tuple[AnnotatedShot, list[float]]:
    given = _given(parameters, files)
    first = parameters.first_number + parameters.first_frame
    inside = (given.frame >= first) & (given.frame < first + parameters.num_frames)
    given = with_identities(given.rows(inside), is_key=parameters.is_key)
    times: list[float] = []

    def images() -> Iterator[Any]:
        for _, frame in shot_images(parameters, files):
            times.append(frame.time_s)
            yield frame.image

    shot = annotate_shot(given, images(), first, parameters.num_frames, is_key=parameters.is_key)
    return shot, times


def _given(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Return the key frames or detections of a film, with its rate and the name of the shot."""
    stated = Footage(parameters.video_size_px, parameters.video_rate_hz, parameters.focal_px, parameters.fov_deg)
    if parameters.num_networks:
        frames = _detected(parameters, files)
        frames = clean_annotations(frames, stated=stated, min_confidence=parameters.min_confidence)
    else:
        frames = read_given(parameters, files[: parameters.num_given], stated)
    size = frames.image_size_px.get(frames.sequence_id[0])
    names = (parameters.id,) * frames.num_rows
    focal = dict.fromkeys((parameters.id,) if frames.focal_px else (), next(iter(frames.focal_px.values()), 0.0))
    return replace(frames, sequence_id=names, image_size_px={parameters.id: size} if size else {}, focal_px=focal)


def _detected(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    start = parameters.num_given
    detector = load_detector([read_again(file) for file in files[start : start + parameters.num_networks]])
    detections = []
    first = parameters.first_number + parameters.first_frame
    for number, frame in shot_images(parameters, files):
        if (number - first) % parameters.detect_every == 0:
            tables = detector.detect(frame.image)
            detections += [Detection(("", number), None, table, f"frame {number}") for table in tables]
    frames = join_detections(detections, sequence_id=parameters.id, layout=parameters.keypoint_layout())
    return replace(frames, status=np.where(frames.confidence > 0, KeypointStatus.DETECTED, 0))


def _films_of(options: FilmOptions) -> list[tuple[str, Path, Path | None]]:
    """Return name, path and file of given poses of each film of a source."""
    given = options.keys or options.detections
    if not options.path.is_dir() or is_film(options.path):
        return [("", options.path, given)]
    films = sorted(item for item in options.path.iterdir() if item.suffix.lower() in VIDEO_SUFFIXES)
    if not films:
        raise InputError(f"folder {options.path} holds no film ({', '.join(sorted(VIDEO_SUFFIXES))}) and no images")
    if given is not None and not given.is_dir():
        raise InputError(f"{options.path} is a folder of films: keys and detections are a folder with a file for each")
    names: dict[str, Path] = {}
    for film in films:
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", film.stem)
        if names.setdefault(name, film) is not film:
            raise InputError(f"{names[name].name} and {film.name} would have one name; rename one of them")
    fitting: dict[Path, list[Path]] = {film: [] for film in films}
    for item in sorted(given.iterdir()) if given else []:
        named_so = [film for film in films if is_named_after(item.stem, film.stem)]
        if named_so and item.suffix.lower() not in VIDEO_SUFFIXES:
            fitting[max(named_so, key=lambda film: len(film.stem))].append(item)
    lacking = next((film.name for film, items in fitting.items() if not items), None)
    if given is not None and lacking is not None:
        raise InputError(f"nothing in {given} is named like the film {lacking}")
    shortest = {film: min(items, key=lambda item: len(item.stem), default=None) for film, items in fitting.items()}
    return [(name, film, shortest[film]) for name, film in names.items()]


def _shots_of(
    options: FilmOptions,
    name: str,
    film: Film,
    path: Path,
    given: Path | None,
    networks: tuple[SourceFile, ...],
    is_held_out: bool,
    take_seconds: float | None,
) -> list[FoundShot]:
    camera = None
    if given is not None:
        cameras = find_cameras(given, options.format)
        camera = next((other for other in cameras if is_named_after(other.name, path.stem)), cameras[0])
        if len(cameras) > 1 and not is_named_after(camera.name, path.stem):
            raise InputError(f"{given} holds several cameras, none of them named like {path.name}")
    rate_hz = options.rate_hz or film.rate_hz or ASSUMED_RATE_HZ
    starts = [*(film.starts if options.has_cuts else (0,)), film.num_frames]
    base = f"{options.id}.{name}" if name else options.id
    files = tuple(map(find_file, camera.paths)) if camera else ()
    numbers = ANNOTATION_FORMATS[camera.format].frame_numbers([file.name for file in camera.paths]) if camera else []
    common = options.model_dump(
        exclude={"id", "path", "format", "keys", "detections", "detect", "has_cuts", *SOURCE_FILES}
    )
    shots = []
    for index, (start, stop) in enumerate(pairwise(starts)):
        length = stop - start if take_seconds is None else min(stop - start, frames_in(take_seconds, rate_hz))
        parameters = FilmParameters(
            **common,
            id=base if len(starts) == 2 else f"{base}.shot{index:02d}",
            format=camera.format if camera else "auto",
            is_held_out=is_held_out,
            frames=tuple(numbers),
            video_rate_hz=rate_hz,
            video_size_px=film.image_size_px,
            people=(),
            own_layout=own_layout_of(options.layout_file),
            num_given=len(files),
            num_networks=len(networks),
            is_key=options.keys is not None,
            first_number=film.first_number,
            first_frame=start,
            num_frames=length,
            after_s=film.after_s(start),
            is_constant_rate=film.is_constant or options.rate_hz is not None,
        )
        shots.append(FoundShot(parameters, (*files, *networks, *film.files), film))
    shots = [shot for shot in shots if shot.parameters.num_frames > 1]
    if camera is None or not shots:
        return shots
    checked = _check_given(shots[0], given or path, film, rate_hz, options)
    frames, notes = checked.given().frame, (*checked.remarks, *checked.doubts)
    spans = [(replace(shot, notes=notes), film.first_number + shot.parameters.first_frame) for shot in shots]
    return [
        source for source, first in spans if ((frames >= first) & (frames < first + source.parameters.num_frames)).any()
    ]


def _check_given(shot: FoundShot, given: Path, film: Film, rate_hz: float, options: FilmOptions) -> AnnotatedFrames:
    """Check the given keypoints against the film, and return them."""
    with named(given.name):
        parameters = shot.parameters
        files = shot.files[: parameters.num_given]
        frames = read_given(parameters, files, Footage(film.image_size_px))
        if frames.rate_hz and max(frames.rate_hz / rate_hz, rate_hz / frames.rate_hz) > _MAX_RATE_RATIO:
            raise InputError(
                f"it is about a film of {frames.rate_hz:g} Hz, but this one has {rate_hz:.6g}; if the film states a "
                "wrong rate, set rate_hz"
            )
        last = film.first_number + film.num_frames - 1
        outside = frames.frame[(frames.frame < film.first_number) | (frames.frame > last)]
        if len(outside):
            raise InputError(f"frame {outside[0]} is not in the film, whose frames are {film.first_number} to {last}")
        if len(set(zip(frames.frame.tolist(), frames.person_id.tolist(), strict=True))) < frames.num_rows:
            raise InputError(
                f"it holds {len(set(frames.sequence_id))} sequences with the same frames; give each film its own file"
            )
        return frames
