"""Film as a source of 2D poses, and the work of a shot's shard."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pasdedeux.errors import named
from pasdedeux.film.drawing import contact_sheet, draw_people, moving_svg
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.people.decisions import check_sequences
from pasdedeux.people.resolution import ResolvedPeople
from pasdedeux.spread import some_of
from storage_schema import ArtifactRef, Store
from tasks.ingest.film.parameters import FilmOptions, FilmParameters
from tasks.ingest.film.resolution import annotate_film, find_shots, read_shot, shot_images
from tasks.ingest.poses2d.readers import IMAGE_SUFFIXES
from tasks.ingest.poses2d.resolution import DEFAULT_RATE_HZ, FoundAnnotations, decisions_of
from tasks.ingest.poses2d.run import commit_poses2d
from tasks.stage import Shard, SourceFile

ANNOTATIONS_NAME = "annotations.csv"
"""Attachment: annotations of a film with the status of each keypoint."""
SHEET_NAME, CLIP_NAME = "sheet.svg", "clip.svg"
"""Attachments: images of a film with the people drawn, and a short clip of it."""
_SHEET_IMAGES, _CLIP_IMAGES = 8, 30


@dataclass(frozen=True)
class FoundFilm(FoundAnnotations):
    """A shot of a film as a source of 2D poses."""

    parameters: FilmParameters

    def attachments(self, resolved: ResolvedPeople) -> dict[str, bytes]:
        """Return the table of people, all keypoints with their status, for corrections, and pictures."""
        frames = annotate_film(self.parameters, self.files).frames
        table = {ANNOTATIONS_NAME: write_annotation_csv(frames).encode()}
        return super().attachments(resolved) | table | _pictures(self.parameters, self.files, frames)

    def _read(self) -> AnnotatedFrames:
        return _read(self.parameters, self.files)

    def _kind_in_words(self) -> list[str]:
        stated = self.parameters
        film, first = Path(self.files[-1].path), stated.first_number + stated.first_frame
        name = film.parent.name if film.suffix.lower() in IMAGE_SUFFIXES else film.name
        words = [f"frames {first} to {first + stated.num_frames - 1} of {name}"]
        words.append("by a detector" if stated.num_networks else f"by the format '{stated.format}'")
        return words


def find_videos(
    options: FilmOptions, *, is_held_out: bool = False, take_seconds: float | None = None
) -> list[FoundFilm]:
    """Find the shots of films as sources of 2D poses, as `find_annotations` finds cameras."""
    shots = find_shots(options, is_held_out=is_held_out, take_seconds=take_seconds)
    films = []
    with named(f"video {options.id}"):
        decisions = decisions_of(options.people_file)
        check_sequences(decisions, {shot.parameters.id for shot in shots})
        for shot in shots:
            rows = tuple(row.in_words() for row in decisions if row.sequence_id == shot.parameters.id)
            parameters = shot.parameters.model_copy(update={"people": rows})
            films.append(FoundFilm(parameters, shot.files, Path(shot.files[-1].path), shot.notes))
    return films


def run_film(shard: Shard, store: Store, parameters: FilmParameters) -> ArtifactRef:
    """Annotate a shot, resolve identities, and derive the working skeletons."""
    return commit_poses2d(shard, store, FoundFilm(parameters, shard.files, None))


@lru_cache(maxsize=16)
def _read(parameters: FilmParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Annotate a shot; the last few are cached, because a study is planned several times in a run."""
    return read_shot(parameters, files)


def _pictures(parameters: FilmParameters, files: tuple[SourceFile, ...], frames: AnnotatedFrames) -> dict[str, bytes]:
    """Return a sheet of images of a shot and a short clip from its middle, with drawn people and blurred faces."""
    on_sheet = some_of(np.unique(frames.frame).tolist(), _SHEET_IMAGES)
    middle = int(np.median(frames.frame))
    in_clip = range(middle - _CLIP_IMAGES, middle + _CLIP_IMAGES, 2)
    sheet, clip = [], []
    for number, frame in shot_images(parameters, files):
        if number in on_sheet or number in in_clip:
            drawn = draw_people(frame.image, frames, number)
            sheet += [(f"frame {number}", drawn)] if number in on_sheet else []
            clip += [contact_sheet([drawn], [f"frame {number}"])] if number in in_clip else []
    rate_hz = 0.5 * (frames.rate_hz or DEFAULT_RATE_HZ)
    titles, images = zip(*sheet, strict=True)
    return {SHEET_NAME: moving_svg([contact_sheet(images, titles)], 1.0), CLIP_NAME: moving_svg(clip, rate_hz)}
