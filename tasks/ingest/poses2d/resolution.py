"""Finding and reading sources of 2D poses in planning: cameras, format, layout, rate, and identities."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from pasdedeux.errors import InputError, named
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.detections import UNKNOWN, Footage
from pasdedeux.formats.poses2d.own_layout import read_layout
from pasdedeux.formats.registry import ANNOTATION_FORMATS, read_annotations
from pasdedeux.people.decisions import Decision, check_sequences, read_decisions, write_decisions
from pasdedeux.people.resolution import PeopleSettings, ResolvedPeople, resolve_people
from tasks.ingest.common import frames_in
from tasks.ingest.files import find_file, load_file, read_again
from tasks.ingest.poses2d.parameters import SOURCE_FILES, AnnotationOptions, AnnotationParameters
from tasks.ingest.poses2d.readers import CameraFiles, find_cameras, read_header, video_beside
from tasks.stage import SourceFile

DEFAULT_RATE_HZ = 30.0
PEOPLE_NAME = "people.csv"
"""Attachment: the table of people, as resolved by ingest."""
_MAX_PLANNED_BYTES = 16_000_000
"""Maximum size of a source that is read in planning, to refuse bad input early: about a second."""
MAX_NAMED_FILES = 20
"""Maximum number of skipped files that are named."""


@dataclass(frozen=True)
class FoundAnnotations:
    """A source of 2D poses, or one camera of it.

    Args:
        parameters: Parameters of its shard, with all choices made.
        files: Its files.
        video: The video beside them whose header was read; None if there is none.
        notes: Notes for the user on how they are read; empty if they have not been read.
    """

    parameters: AnnotationParameters
    files: tuple[SourceFile, ...]
    video: Path | None
    notes: tuple[str, ...] = ()

    def read(self) -> AnnotatedFrames:
        """Return the annotations in pixels, with rate, and with image size and focal length if they are known.

        Raises:
            InputError: A file is damaged or has changed.
        """
        frames = self._read()
        return replace(frames, rate_hz=frames.rate_hz or DEFAULT_RATE_HZ)

    def resolve(self) -> ResolvedPeople:
        """Return the annotations with identities resolved.

        Raises:
            InputError: As `read`; nobody is in it, or the table of people is about other people.
        """
        with named(f"annotations {self.parameters.id}"):
            decisions = [Decision.from_words(row) for row in self.parameters.people]
            is_start = self.parameters.take_seconds is not None  # while decisions are about whole sequences
            return resolve_people(self.read(), self.parameters.part(PeopleSettings), decisions, is_start=is_start)

    def in_words(self) -> str:
        """Describe the files, and the origin of the video's properties."""
        stated, frames = self.parameters, self._read()
        words = self._kind_in_words()
        words += [f"layout '{frames.layout}'", f"{frames.rate_hz or DEFAULT_RATE_HZ:g} frames a second"]
        beside = "" if self.video is None else f" ({self.video.name})"
        if stated.rate_hz is None and frames.rate_hz is None:
            words[-1] += " assumed (rate_hz)"
        elif stated.rate_hz is None:
            words[-1] += beside if frames.rate_hz == stated.video_rate_hz else " (the file)"
        sizes = sorted(set(frames.image_size_px.values()))
        known = " and ".join(f"{width} x {height}" for width, height in sizes)
        words.append(known or "image size unknown (image_size_px)")
        if sizes and stated.image_size_px is None:
            words[-1] += beside if sizes == [stated.video_size_px] else " (the file)"
        focals = sorted(set(frames.focal_px.values()))
        lens = " and ".join(f"{focal:.0f} px" for focal in focals)
        words.append(f"focal length {lens}" if lens else "lens of a phone assumed (focal_px, fov_deg)")
        if frames.skipped:
            words.append(f"{len(frames.skipped)} damaged files skipped ({', '.join(frames.skipped[:3])})")
        return f"{stated.id}: {', '.join((*words, *frames.remarks, *frames.doubts))}"

    def attachments(self, resolved: ResolvedPeople) -> dict[str, bytes]:
        """Return the attachments: the table of people."""
        decisions = write_decisions(row for sequence in resolved.sequences for row in sequence.decisions)
        return {PEOPLE_NAME: decisions.encode()}

    def _read(self) -> AnnotatedFrames:
        return _read(self.parameters, self.files)

    def _kind_in_words(self) -> list[str]:
        number, kind = len(self.files), self.parameters.format
        return [f"{number} files of the format '{kind}'" if number > 1 else f"format '{kind}'"]


def find_annotations(
    options: AnnotationOptions,
    *,
    is_held_out: bool = False,
    skipped: dict[str, str] | None = None,
    take_seconds: float | None = None,
) -> list[FoundAnnotations]:
    """Find a source's files, a camera at a time, and read them once, so that bad input is refused before any work.

    Args:
        options: The source.
        is_held_out: Whether it shows a take that is held out.
        skipped: If given, cameras that cannot be read are added to it with the reason, instead of an error.
        take_seconds: Seconds from the start of each sequence; None for all.

    Sources larger than 16 MB are read when their shard runs.

    Raises:
        InputError: The path does not exist, a file is damaged, or the layout is not the requested one.
    """
    sources: list[FoundAnnotations] = []
    known: set[str] = set()
    ids: set[str] = set()
    with named(f"annotations {options.id}"):
        decisions = decisions_of(options.people_file)
        for camera in find_cameras(options.path, options.format, skipped=skipped):
            try:
                source = _find_camera(options, camera, is_held_out=is_held_out, take_seconds=take_seconds)
                planned, name = source.parameters, camera.paths[0].name
                is_large = sum(path.stat().st_size for path in camera.paths) > _MAX_PLANNED_BYTES
                # Decisions and watched folders need the content: names of sequences, and whether the file is whole.
                is_read = not is_large or bool(decisions) or skipped is not None
                frames = source.read() if is_read else None
                sequences = set(frames.sequence_id) if frames else set()
                notes = (*frames.remarks, *frames.doubts) if frames else ()
                if planned.id in ids:
                    raise InputError(f"{name}: another file is '{planned.id}' already; rename one of them")
            except InputError as error:
                if skipped is None:
                    raise
                skipped[camera.name] = str(error)
                continue
            ids.add(planned.id)
            known |= sequences
            rows = tuple(row.in_words() for row in decisions if row.sequence_id in sequences)
            sources.append(replace(source, parameters=planned.model_copy(update={"people": rows}), notes=notes))
        check_sequences(decisions, known)
    return sources


def own_layout_of(path: Path | None) -> str | None:
    """Read and check a keypoint layout of the user, and return its text.

    Raises:
        InputError: It does not exist, or is damaged.
    """
    if path is None:
        return None
    text = load_file(path).data.decode("utf-8", errors="replace")
    with named(path.name):
        read_layout(text)
    return text


def decisions_of(people_file: Path | None) -> list[Decision]:
    """Read the table of people; empty if there is none."""
    if people_file is None:
        return []
    data = load_file(people_file).data
    with named(people_file.name):
        return read_decisions(data)


def _find_camera(
    options: AnnotationOptions, camera: CameraFiles, *, is_held_out: bool, take_seconds: float | None
) -> FoundAnnotations:
    video = video_beside(options.path, camera)
    header = UNKNOWN if video is None else read_header(video)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", camera.name)
    parameters = AnnotationParameters(
        **options.model_dump(exclude={"id", "path", "format", "is_watched", *SOURCE_FILES}),
        id=f"{options.id}.{name}" if name else options.id,
        format=camera.format,
        is_held_out=is_held_out,
        frames=tuple(ANNOTATION_FORMATS[camera.format].frame_numbers([path.name for path in camera.paths])),
        video_rate_hz=header.rate_hz,
        video_size_px=header.image_size_px,
        people=(),
        take_seconds=take_seconds,
        own_layout=own_layout_of(options.layout_file),
    )
    files = tuple(map(find_file, camera.paths))
    return FoundAnnotations(parameters, files, None if header == UNKNOWN else video)


def read_given(
    parameters: AnnotationParameters, files: tuple[SourceFile, ...], stated: Footage, *, video: Footage = UNKNOWN
) -> AnnotatedFrames:
    """Read files of 2D poses with the choices of their shard; see `read_annotations`.

    Raises:
        InputError: A file is damaged or has changed.
    """
    return read_annotations(
        ANNOTATION_FORMATS[parameters.format],
        {Path(file.path).name: read_again(file) for file in files},
        source_id=parameters.id,
        layout=parameters.keypoint_layout(),
        stated=stated,
        video=video,
        min_confidence=parameters.min_confidence,
        skip_unreadable=parameters.on_unreadable == "skip",
        frame_offset=parameters.frame_offset,
    )


@lru_cache(maxsize=16)
def _read(parameters: AnnotationParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Read a source; the last few are cached, because a study is planned several times in a run."""
    stated = Footage(parameters.image_size_px, parameters.rate_hz, parameters.focal_px, parameters.fov_deg)
    video = Footage(parameters.video_size_px, parameters.video_rate_hz)
    frames = read_given(parameters, files, stated, video=video)
    if parameters.take_seconds is None:
        return frames
    return frames.start_of_each(frames_in(parameters.take_seconds, frames.rate_hz or DEFAULT_RATE_HZ))
