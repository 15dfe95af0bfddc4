"""`annotate`: 2D poses in every frame of a film, from key frames, detections or a detector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from flows.console.context import app

KeysOption = Annotated[Path | None, Option(metavar="FILE", help="Annotated key frames of the film.")]
DetectionsOption = Annotated[Path | None, Option(metavar="FILE_OR_DIR", help="A detector's keypoints of the film.")]
DetectOption = Annotated[
    list[str] | None,
    Option(metavar="ONNX", help="Run a detector: RTMO, or RTMPose with YOLOX; a path, or ADDRESS#sha256=DIGEST."),
]


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
        list[str] | None, Option("--set", metavar="KEY=C", help="A key of [[ingest.videos]], such as rate_hz=25.")
    ] = None,
    num_corrections: Annotated[int, Option("--corrections", min=0, help="Frames to correct next, of a shot.")] = 8,
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
    from flows.console.annotating import annotate_film  # here: tracking takes a second to load

    annotate_film(
        film,
        keys,
        detections,
        detect or (),
        settings or (),
        out,
        num_corrections=num_corrections,
        sheet=sheet,
        overlay=overlay,
        has_faces=show_faces,
    )
