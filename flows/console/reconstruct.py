"""`reconstruct`: 3D motions of the people in a detector's files, at once or while the files are being written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from flows.console.annotate import DetectionsOption, DetectOption, KeysOption
from flows.console.context import StoreOption, app
from pasdedeux.errors import InputError


@app.command()
def reconstruct(
    path: Annotated[Path, Argument(metavar="FILE_OR_DIR", help="2D poses: a file, or a folder of them; or film.")],
    keys: KeysOption = None,
    detections: DetectionsOption = None,
    detect: DetectOption = None,
    database: Annotated[str | None, Option(metavar="REF", help="Projections; default: the store's only ones.")] = None,
    store: StoreOption = Path("store"),
    out: Annotated[
        Path | None, Option(help="Folder for BVH files and a page, this one by default; with --follow a file.")
    ] = None,
    follow: Annotated[bool, Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, Option(min=0.0, metavar="S", help="End after this time without a new file, seconds.")] = 5.0,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=C", help="A key of the source, such as rate_hz=60.")
    ] = None,
    stature: Annotated[list[str] | None, Option(metavar="[PERSON=]M", help="Stature of all, or of a person.")] = None,
    person: Annotated[list[int] | None, Option(min=0, metavar="N", help="Only this person; repeatable.")] = None,
    pitch: Annotated[float | None, Option(min=-80, max=80, metavar="DEG", help="Pitch of the camera, down.")] = None,
    height: Annotated[float | None, Option(min=0.1, max=100, metavar="M", help="Height of the camera.")] = None,
    lag: Annotated[int, Option(min=0, max=1000, metavar="FRAMES", help="Delay of live poses.")] = 6,
    units: Annotated[Literal["cm", "m"], Option(help="Unit of lengths in BVH files.")] = "cm",
    clean_up: Annotated[bool, Option(help="Still planted feet and keep the floor.")] = True,
) -> None:
    """Reconstruct the 3D motion of people from 2D keypoints, with the projection database of a study.

    Inputs are OpenPose folders, COCO annotations and result lists, MediaPipe landmarks, and the CSV and npz of the
    docs; each camera in a folder is a sequence.  --follow reads a folder of OpenPose files while it is being written.

    \b
      pasdedeux reconstruct walk/ --out out/                              a BVH and an npz file for each person, a page
      pasdedeux reconstruct walk/ --database projections:duets --follow   a JSON line per person and frame, live
      pasdedeux reconstruct dance.mp4 --detect rtmo-m.onnx --out out/     film; also --keys or --detections

    Image size, rate and focal length come from the files if stated there, else from --set with the keys of a study
    (image_size_px, rate_hz, focal_px or fov_deg).  --set people_file=FILE overrides identities with an edited copy of
    the table that was written.  The camera pitch is estimated (with --follow: 10 degrees).  --height or --stature fixes
    the scale (with --follow, --stature).

    With --follow, each pose is written --lag frames after its image; the first two seconds of a person are written when
    they are over.  It ends with Ctrl-C, when a file STOP appears in the folder, or after --idle seconds without a new
    file; pending poses and a summary of the delays are then written.
    """
    # Here, because numba and the search take a second that the other commands need not wait for.
    from flows.console.annotate import film_source
    from flows.console.reconstructing import annotation_source, follow_video, reconstruct_video
    from pasdedeux.reconstruction.live.person import LiveOptions
    from tasks.ingest.film.parameters import FilmOptions

    is_film = bool(keys or detections or detect)
    video = (
        film_source(path, keys, detections, detect or (), settings or ())
        if is_film
        else annotation_source(path, settings or ())
    )
    if follow:
        if isinstance(video, FilmOptions):
            raise InputError("--follow reads OpenPose files, not film")
        whole_only = {"--height": height, "--person": person}
        given = [name for name, value in whole_only.items() if value] + ["--units"] * (units != "cm")
        footage = {"rate_hz", "image_size_px", "focal_px", "fov_deg", "statures_m"}
        given += sorted(f"--set {key}" for key in video.model_fields_set - {"id", "path"} - footage)
        if given:
            raise InputError(f"{given[0]} is for whole videos: with --follow, leave it out")
        options = LiveOptions(lag=lag, has_clean_up=clean_up)
        follow_video(video, database, store, out, pitch_deg=pitch, statures=stature or (), idle_s=idle, options=options)
        return
    reconstruct_video(
        video,
        database,
        store,
        out or Path(),
        units=units,
        pitch_deg=pitch,
        camera_height_m=height,
        person_ids=person or (),
        statures=stature or (),
        has_clean_up=clean_up,
    )
