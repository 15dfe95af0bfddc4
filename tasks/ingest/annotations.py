"""Sources of 2D poses: found and checked before any work, read, and made into working skeletons."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pasdedeux.errors import InputError, named
from pasdedeux.film.drawing import contact_sheet, draw_people, evenly, moving_svg
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.annotation_csv import write_annotation_csv
from pasdedeux.formats.detections import UNKNOWN, Footage
from pasdedeux.formats.registry import ANNOTATION_FORMATS, read_annotations
from pasdedeux.people.decisions import Decision, read_decisions, write_decisions
from pasdedeux.people.resolution import PeopleSettings, ResolvedPeople, SequencePeople, resolve_people
from pasdedeux.sampling.annotations import is_left_out
from pasdedeux.skeletons import COUNTED17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.facts import Couple, SequenceFacts
from tasks.ingest.cameras import IMAGE_SUFFIXES, CameraFiles, find_cameras, read_header, video_beside
from tasks.ingest.parameters import AnnotationOptions, FilmOptions
from tasks.ingest.shard_parameters import AnnotationParameters, FilmParameters
from tasks.ingest.shots import annotate, find_shots, read_shot, shot_images
from tasks.ingest.sources import load_file, own_layout_of, read_again
from tasks.stage import Shard, SourceFile, commit
from tasks.user_files import digest_of

DEFAULT_RATE_HZ = 30.0
PEOPLE_NAME = "people.csv"
"""Who is who, as ingest decided it, beside the tables."""
ANNOTATIONS_NAME = "annotations.csv"
"""Annotations of a film beside the tables, with the status of each keypoint."""
SHEET_NAME, CLIP_NAME = "sheet.svg", "clip.svg"
"""Images of a film with the people drawn, and a short moving clip of it, beside the tables."""
_SHEET_IMAGES, _CLIP_IMAGES = 8, 30
MAX_NAMED_FILES = 20
"""Skipped files that are named, of any number."""
GOOD_SHARE_SEEN, POOR_SHARE_SEEN = 0.8, 0.4
"""Share of the joints that count which are seen: below the first a source is doubted, below the second useless."""


@dataclass(frozen=True)
class FoundAnnotations:
    """A source of 2D poses that was found and read once, or one camera of it.

    Args:
        parameters: Those of its shard: every choice is made.
        files: Its files.
        video: The video beside them whose header was read, None without.
    """

    parameters: AnnotationParameters
    files: tuple[SourceFile, ...]
    video: Path | None

    def read(self) -> AnnotatedFrames:
        """Return the annotations in pixels, with the rate, and with image size and focal length where they are known.

        Raises:
            InputError: A file is mangled or has changed.
        """
        frames = _read(self.parameters, self.files)
        return replace(frames, rate_hz=frames.rate_hz or DEFAULT_RATE_HZ)

    def resolve(self) -> ResolvedPeople:
        """Return the annotations with identities resolved.

        Raises:
            InputError: As `read`, nobody is in it, or the table of who is who is about others.
        """
        with named(f"annotations {self.parameters.id}"):
            decisions = [Decision.from_words(row) for row in self.parameters.people]
            is_start = self.parameters.take_seconds is not None  # decisions are about the whole sequence
            return resolve_people(self.read(), self.parameters.part(PeopleSettings), decisions, is_start=is_start)

    def in_words(self) -> str:
        """Say what the files are, and where what is known of the video comes from."""
        stated, frames = self.parameters, _read(self.parameters, self.files)
        number = len(self.files)
        words = [f"{number} files of the format '{stated.format}'" if number > 1 else f"format '{stated.format}'"]
        if isinstance(stated, FilmParameters):
            film, first = Path(self.files[-1].path), stated.first_number + stated.first_frame
            name = film.parent.name if film.suffix.lower() in IMAGE_SUFFIXES else film.name
            words = [f"frames {first} to {first + stated.num_frames - 1} of {name}"]
            words.append("by a detector" if stated.num_networks else f"by the format '{stated.format}'")
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
        return f"{stated.id}: {', '.join(words)}"


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
        skipped: Where given, a camera that cannot be read goes there with the reason, and stops nothing.
        take_seconds: Only so much from the start of each sequence.

    Raises:
        InputError: The path does not exist, a file is mangled, or the layout is not the one asked for.
    """
    found: list[FoundAnnotations] = []
    known: set[str] = set()
    ids: set[str] = set()
    with named(f"annotations {options.id}"):
        decisions = _decisions_of(options.people_file)
        for camera in find_cameras(options.path, options.format, skipped=skipped):
            try:
                one = _find_camera(options, camera, is_held_out=is_held_out, take_seconds=take_seconds)
                sequences = set(one.read().sequence_id)
                planned, name = one.parameters, camera.paths[0].name
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
            found.append(replace(one, parameters=planned.model_copy(update={"people": rows})))
        _check_sequences(decisions, known)
    return found


def _decisions_of(people_file: Path | None) -> list[Decision]:
    """Return the table of who is who; nothing where there is none."""
    if people_file is None:
        return []
    with named(people_file.name):
        return read_decisions(load_file(people_file).data)


def _check_sequences(decisions: Sequence[Decision], known: set[str]) -> None:
    for row in decisions:
        if row.sequence_id not in known:
            raise InputError(
                f"people, row '{row.in_words()}': there is no such sequence; sequences: "
                f"{', '.join(sorted(known)[:MAX_NAMED_FILES])}"
            )


def find_videos(
    options: FilmOptions, *, is_held_out: bool = False, take_seconds: float | None = None
) -> list[FoundAnnotations]:
    """Find the shots of films as sources of 2D poses, as `find_annotations` finds cameras."""
    shots = find_shots(options, is_held_out=is_held_out, take_seconds=take_seconds)
    found = []
    with named(f"video {options.id}"):
        decisions = _decisions_of(options.people_file)
        _check_sequences(decisions, {one.parameters.id for one in shots})
        for one in shots:
            rows = tuple(row.in_words() for row in decisions if row.sequence_id == one.parameters.id)
            parameters = one.parameters.model_copy(update={"people": rows})
            found.append(FoundAnnotations(parameters, one.files, Path(one.files[-1].path)))
    return found


def _find_camera(
    options: AnnotationOptions, camera: CameraFiles, *, is_held_out: bool, take_seconds: float | None
) -> FoundAnnotations:
    video = video_beside(options.path, camera)
    header = UNKNOWN if video is None else read_header(video)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", camera.name)
    parameters = AnnotationParameters(
        **options.model_dump(exclude={"id", "path", "format", "people_file", "is_watched", "layout_file"}),
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
    files = tuple(load_file(path).file for path in camera.paths)
    return FoundAnnotations(parameters, files, None if header == UNKNOWN else video)


@lru_cache(maxsize=16)
def _read(parameters: AnnotationParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Read a source; the last few are remembered, because a study is planned several times in a run."""
    if isinstance(parameters, FilmParameters):
        return read_shot(parameters, files)
    frames = read_annotations(
        ANNOTATION_FORMATS[parameters.format],
        {Path(file.path).name: read_again(file) for file in files},
        source_id=parameters.id,
        layout=parameters.keypoint_layout(),
        stated=Footage(parameters.image_size_px, parameters.rate_hz, parameters.focal_px, parameters.fov_deg),
        video=Footage(parameters.video_size_px, parameters.video_rate_hz),
        min_confidence=parameters.min_confidence,
        skip_unreadable=parameters.on_unreadable == "skip",
    )
    if parameters.take_seconds is None:
        return frames
    return frames.start_of_each(max(2, round(parameters.take_seconds * (frames.rate_hz or DEFAULT_RATE_HZ))))


def run_annotations(shard: Shard, store: Store, parameters: AnnotationParameters) -> ArtifactRef:
    """Read a source of 2D poses, resolve who is who, and derive the working skeletons."""
    for file in shard.files:
        if digest_of(Path(file.path)) != file.sha256:
            raise InputError(f"file {file.path} changed since the run was planned; run again")
    resolved = FoundAnnotations(parameters, shard.files, None).resolve()
    frames, op14 = resolved.frames, resolved.op14
    rate_hz = frames.rate_hz or DEFAULT_RATE_HZ
    pair17 = KEYPOINT_LAYOUTS[frames.layout].derive("pair17", frames.keypoints_px, frames.confidence)
    sizes = [frames.image_size_px.get(name) for name in frames.sequence_id]
    count, stills = frames.num_rows, {one.sequence_id for one in resolved.sequences if one.why_not_followed}
    people = Counter(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    return commit(
        shard,
        store,
        tables={
            "annotations": {
                "sequence_id": list(frames.sequence_id),
                "frame": frames.frame,
                "person_id": frames.person_id,
                "partner_id": [None if one < 0 else int(one) for one in resolved.partner_id],
                "source_person_id": resolved.source_person_id,
                "time_s": frames.frame / rate_hz,
                "is_key": np.ones(count, dtype=bool),
                "is_virtual": np.zeros(count, dtype=bool),
                "is_held_out": parameters.is_held_out
                | is_left_out(frames.sequence_id, frames.frame, parameters.leave_one_out_every, stills),
                "take_id": [parameters.take_id] * count,
                "take_frame": [None] * count,
                "layout": [frames.layout] * count,
                "keypoints_px": [row.reshape(-1) for row in frames.keypoints_px],
                "keypoint_confidence": list(frames.confidence),
                "pair17_px": pair17.positions,
                "pair17_confidence": pair17.confidence,
                "op14_px": op14.positions,
                "op14_confidence": op14.confidence,
                "focal_px": [frames.focal_px.get(name) for name in frames.sequence_id],
                "image_width_px": [size[0] if size else None for size in sizes],
                "image_height_px": [size[1] if size else None for size in sizes],
            }
        },
        facts=SequenceFacts(
            takes=(parameters.take_id,) if parameters.take_id else (),
            sequence_ids=tuple(sorted(set(frames.sequence_id))),
            is_held_out=parameters.is_held_out,
            is_virtual=False,
            num_frames=len(people),
            num_persons=max(people.values()),
            rate_hz=rate_hz,
            purpose="given",
            format=parameters.format,
            layout=frames.layout,
            num_skipped_frames=len(frames.skipped),
            skipped_files=tuple(frames.skipped[:MAX_NAMED_FILES]),
            camera_height_m=parameters.camera_height_m,
            statures_m=dict(parameters.statures_m),
            couples=tuple(
                Couple(sequence_id=one.sequence_id, person_ids=(pair.first, pair.second), num_near_frames=pair.num_near)
                for one in resolved.sequences
                for pair in one.pairs
            )[:MAX_NAMED_FILES],
            why_no_video={one.sequence_id: one.why_not_followed for one in resolved.sequences if one.why_not_followed},
            num_merged_rows=sum(one.num_merged_rows for one in resolved.sequences),
            num_ghost_rows=sum(one.num_ghost_rows for one in resolved.sequences),
            num_repaired_joints=sum(one.num_repaired_joints for one in resolved.sequences),
            num_renamed_rows=sum(one.num_renamed_rows for one in resolved.sequences),
        ),
        attachments=_attachments(parameters, shard.files, resolved),
        sources=[SourceCredit(name=parameters.id, licence=parameters.licence, credit=parameters.credit)],
        verdict=_verdict(
            pair17.confidence[:, COUNTED17] > 0,
            len(frames.skipped),
            len(shard.files),
            resolved.sequences,
            stated_of_nobody(dict(parameters.statures_m), frames.person_id.tolist()),
        ),
    )


def stated_of_nobody(person_ids: Iterable[int], known: Iterable[int]) -> str:
    """Say of which people who are not there a stature is stated; nothing where there are none."""
    absent, people = sorted(set(person_ids) - set(known)), ", ".join(map(str, sorted(set(known)))) or "none"
    whom = ", ".join(map(str, absent))
    return f"a stature is stated for person {whom}, who is not there; people: {people}" if absent else ""


def _attachments(
    parameters: AnnotationParameters, files: tuple[SourceFile, ...], resolved: ResolvedPeople
) -> dict[str, bytes]:
    """Return who is who, and of film every keypoint with its status, as key frames can be corrected in it."""
    decisions = write_decisions(row for one in resolved.sequences for row in one.decisions)
    found = {PEOPLE_NAME: decisions.encode()}
    if isinstance(parameters, FilmParameters):
        frames = annotate(parameters, files).frames
        found[ANNOTATIONS_NAME] = write_annotation_csv(frames).encode()
        found |= _film_pictures(parameters, files, frames)
    return found


def _film_pictures(
    parameters: FilmParameters, files: tuple[SourceFile, ...], frames: AnnotatedFrames
) -> dict[str, bytes]:
    """Return a sheet of images of a shot and a short clip from its middle, people drawn and faces blurred."""
    on_sheet = evenly(frames.frame, _SHEET_IMAGES)
    middle = int(np.median(frames.frame))
    in_clip = range(middle - _CLIP_IMAGES, middle + _CLIP_IMAGES, 2)
    first = parameters.first_number + parameters.first_frame
    sheet, clip = [], []
    for number, one in enumerate(shot_images(parameters, files), start=first):
        if number in on_sheet or number in in_clip:
            drawn = draw_people(one.image, frames, number)
            sheet += [(f"frame {number}", drawn)] if number in on_sheet else []
            clip += [contact_sheet([drawn], [f"frame {number}"])] if number in in_clip else []
    rate_hz = 0.5 * (frames.rate_hz or DEFAULT_RATE_HZ)
    titles, images = zip(*sheet, strict=True)
    return {SHEET_NAME: moving_svg([contact_sheet(images, titles)], 1.0), CLIP_NAME: moving_svg(clip, rate_hz)}


def _verdict(
    is_seen: np.ndarray, num_skipped: int, num_files: int, sequences: Sequence[SequencePeople], of_nobody: str
) -> Verdict:
    """Say whether enough is seen: the share of the joints (person in a frame, joint), and the frames skipped.

    What is stated `of_nobody` is doubted.  Tracks that were joined are said, which is no fault.
    """
    reasons, share_seen = [], float(is_seen.mean())
    if share_seen < GOOD_SHARE_SEEN:
        reasons.append(f"{share_seen:.0%} of the joints are seen")
    if num_skipped:
        reasons.append(f"{num_skipped} of {num_files} frames could not be read and were skipped")
    reasons += [of_nobody] if of_nobody else []
    is_poor = share_seen < POOR_SHARE_SEEN or 2 * num_skipped > num_files
    level = Level.PASS if not reasons else Level.FAIL if is_poor else Level.WARN
    reasons += [row.as_joined() for one in sequences for row in one.joined]
    figure = ("joints seen", 100 * share_seen, "%")
    return Verdict(level, "; ".join(reasons), *figure, count=len(is_seen), thing="people in frames")
