"""`annotate`: 2D poses in every frame of a film, from key frames, detections or a detector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from typer import Argument, Option

from flows.console.context import app, echo, key_option, say
from flows.console.display import format_table
from flows.console.inputs import find_source
from flows.exports.export_format import write_film, write_text
from pasdedeux.errors import InputError
from pasdedeux.film.annotating import AnnotatedShot, frames_to_correct
from pasdedeux.film.drawing import contact_sheet, draw_people
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, join_frames
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.formats.poses2d.coco import write_coco
from pasdedeux.formats.poses2d.cvat import write_cvat
from pasdedeux.plain_text import counted
from tasks.ingest.film.detector_files import fetched_detectors
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import Image
from tasks.ingest.film.resolution import FoundShot, annotate_film, find_shots, shot_images

KeysOption = Annotated[Path | None, key_option(FilmOptions, "keys", metavar="FILE")]
DetectionsOption = Annotated[Path | None, key_option(FilmOptions, "detections", metavar="FILE_OR_DIR")]
DetectOption = Annotated[list[str] | None, key_option(FilmOptions, "detect", metavar="ONNX")]

_WRITERS: Mapping[str, tuple[str, Callable[[AnnotatedFrames], str]]] = {
    ".csv": ("ours", write_annotation_csv),
    ".json": ("COCO", write_coco),
    ".xml": ("CVAT", write_cvat),
}
_HEADER = ("shot", "frames", "people", "annotated", "detected", "tracked", "interpolated", "missing", "correct next")


@app.command()
def annotate(
    film: Annotated[Path, Argument(metavar="FILM", help="Film, folder of numbered images, or folder of films.")],
    keys: KeysOption = None,
    detections: DetectionsOption = None,
    detect: DetectOption = None,
    out: Annotated[
        Path | None,
        Option(metavar="FILE", help="Annotations: .csv, COCO .json, CVAT .xml; default FILM_annotations.csv."),
    ] = None,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=C", help="A key of [[ingest.videos]], for example rate_hz=25.")
    ] = None,
    num_corrections: Annotated[int, Option("--corrections", min=0, help="Frames to correct next, per shot.")] = 8,
    sheet: Annotated[Path | None, Option(metavar="FILE", help="Contact sheet of those frames (jpg, png).")] = None,
    overlay: Annotated[Path | None, Option(metavar="FILE", help="The film with people drawn (mp4).")] = None,
    show_faces: Annotated[bool, Option("--show-faces", help="Do not blur faces in sheet and overlay.")] = False,
) -> None:
    """Annotate every frame of a film.

    Joints are tracked between key frames (COCO, CVAT, the CSV and npz of the docs), or through the gaps of a detector.
    What is hidden is left out.  Each keypoint gets a confidence and a status: annotated, detected, tracked or
    interpolated.

    \b
      pasdedeux annotate dance.mp4 --keys keys.json --sheet next.jpg
      pasdedeux annotate dance.mp4 --detections rtmpose.json --overlay seen.mp4
      pasdedeux annotate dance.mp4 --detect rtmo-m.onnx

    The frames to correct next are listed: there the tracks from both sides, or tracks and detector, disagree most.
    Correct them in your tool or in the CSV (status annotated), and give the file as --keys: what was tracked before is
    tracked anew.  `reconstruct` and studies ([[ingest.videos]]) take the same options.
    """
    target = out or Path(f"{film.resolve().stem}_annotations.csv")
    if target.suffix not in _WRITERS:
        raise InputError(
            f"--out {target}: annotations are {', '.join(f'{end} ({what})' for end, (what, _) in _WRITERS.items())}"
        )
    for path in (target, sheet, overlay):
        if path is not None and path.resolve() == film.resolve():
            raise InputError(f"{path} is the film itself, which is not written over")
    _, write = _WRITERS[target.suffix]
    shots = find_shots(film_source(film, settings or (), keys, detections, detect))
    if len({source.film.files for source in shots}) > 1 and (target.suffix != ".csv" or overlay is not None):
        raise InputError(
            f"{film} is a folder of films, but .json, .xml and --overlay need one film: run this command for each"
        )
    annotated: list[tuple[FoundShot, AnnotatedShot]] = []
    failed: list[InputError] = []
    for source in shots:
        try:
            annotated.append((source, annotate_film(source.parameters, source.files)))
        except InputError as error:
            failed.append(type(error)(f"{source.parameters.id}: {error}"))
    for reason in failed if annotated else failed[:-1]:
        echo(f"skipped: {reason}", err=True)
    if not annotated:
        raise failed[-1]
    write_text(target, write(join_frames([shot.frames for _, shot in annotated])))
    wanted = [frames_to_correct(shot, num_corrections) for _, shot in annotated]
    rows = [_row(source, shot, frames) for (source, shot), frames in zip(annotated, wanted, strict=True)]
    say(format_table(_HEADER, rows, text_columns=(0, len(_HEADER) - 1)))
    for lost in {source.film.num_lost for source, _ in annotated if source.film.num_lost}:
        echo(f"{film.name} states {counted(lost, 'frame')} more than can be read", err=True)
    cells: list[Image] = []
    for (source, shot), frames in zip(annotated, wanted, strict=True):
        cells += _cells(source, shot, frames, show_faces) if sheet is not None else ()
    if sheet is not None and cells:
        _write_image(sheet, contact_sheet(cells, [""] * len(cells)))
    if overlay is not None:
        overlay.parent.mkdir(parents=True, exist_ok=True)
        drawn = (image for source, shot in annotated for image in _drawn(source, shot, show_faces))
        write_film(overlay, drawn, annotated[0][1].frames.rate_hz or 30.0)
    written = (target, sheet if cells else None, overlay)
    echo(f"written: {', '.join(str(path) for path in written if path is not None)}", err=True)


def film_source(
    path: Path, settings: Sequence[str], keys: Path | None, detections: Path | None, detect: Sequence[str] | None
) -> FilmOptions:
    """Return the film that the options of a command describe, by default with a fetched detector; see `find_source`."""
    chosen = tuple(detect or ()) or (() if keys or detections else fetched_detectors()[:1])
    return find_source(FilmOptions, path, settings, keys=keys, detections=detections, detect=chosen)


def _row(found_shot: FoundShot, shot: AnnotatedShot, wanted: Sequence[int]) -> tuple[str, ...]:
    first = found_shot.parameters.first_number + found_shot.parameters.first_frame
    assert shot.frames.status is not None
    people = len(np.unique(shot.frames.person_id))
    total = people * found_shot.parameters.num_frames * shot.frames.status.shape[1]
    counts = np.bincount(shot.frames.status.reshape(-1), minlength=len(KeypointStatus))
    counts[KeypointStatus.MISSING] = total - counts[1:].sum()
    order = (KeypointStatus.ANNOTATED, KeypointStatus.DETECTED, KeypointStatus.TRACKED, KeypointStatus.INTERPOLATED)
    shares = [f"{counts[kind] / total:.0%}" for kind in (*order, KeypointStatus.MISSING)]
    span = f"{first}-{first + found_shot.parameters.num_frames - 1}"
    return found_shot.parameters.id, span, str(people), *shares, " ".join(map(str, wanted))


def _cells(found_shot: FoundShot, shot: AnnotatedShot, wanted: Sequence[int], has_faces: bool) -> Iterator[Image]:
    """Yield the cells of the sheet, each reduced at once, because the images of all shots may fill the memory."""
    for number, frame in shot_images(found_shot.parameters, found_shot.files):
        if number in wanted:
            drawn = draw_people(frame.image, shot.frames, number, has_faces=has_faces)
            yield contact_sheet([drawn], [f"frame {number}"])


def _drawn(found_shot: FoundShot, shot: AnnotatedShot, has_faces: bool) -> Iterator[Image]:
    for number, frame in shot_images(found_shot.parameters, found_shot.files):
        yield draw_people(frame.image, shot.frames, number, has_faces=has_faces)


def _write_image(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.suffix or not cv2.imwrite(str(path), image):
        raise InputError(f"{path} cannot be written; images are .jpg or .png")
