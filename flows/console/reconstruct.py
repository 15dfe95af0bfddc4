"""`reconstruct`: 3D motions of the people in a detector's files, at once or while the files are being written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from flows.console.context import app
from pasdedeux.errors import InputError

_HELP = """Reconstruct the 3D motion of people from 2D keypoints, with the projection database of a study.

Inputs are OpenPose folders, COCO annotations and result lists, MediaPipe landmarks, and the CSV and npz of the docs;
each camera in a folder is a sequence.  --follow reads a folder of OpenPose files while it is being written.

\b
  pasdedeux reconstruct walk/ --database store --out out/             a BVH and an npz file for each person
  pasdedeux reconstruct walk/ --database projections:duets --follow   a JSON line per person and frame, live

Image size, rate and focal length come from the files if stated there.  The camera pitch is estimated (with --follow: 10
degrees).  --height or --stature fixes the scale.  --people overrides identities with an edited copy of the table that
was written.

With --follow, each pose is written --lag frames after its image; the first two seconds of a person are written when
they are over.  It ends with Ctrl-C, when a file STOP appears in the folder, or after --idle seconds without a new file;
pending poses and a summary of the delays are then written.
"""


@app.command(help=_HELP)
def reconstruct(
    path: Annotated[Path, Argument(metavar="FILE_OR_DIR", help="2D poses: a file, or a folder of them.")],
    database: Annotated[str, Option(metavar="REF", help="Projections, or a store with one study.")] = "store",
    store: Annotated[Path, Option(metavar="DIR", help="Store of the reference.")] = Path("store"),
    out: Annotated[Path | None, Option(help="Folder for BVH files, or with --follow a file for the lines.")] = None,
    follow: Annotated[bool, Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, Option(min=0.0, metavar="S", help="End after this time without a new file, seconds.")] = 5.0,
    rate: Annotated[float | None, Option(min=1, max=1000, metavar="HZ", help="Frames per second.")] = None,
    size: Annotated[str | None, Option(metavar="WxH", help="Image size; default: as in the files.")] = None,
    focal: Annotated[float | None, Option(min=1.0, metavar="PX", help="Focal length, if known.")] = None,
    fov: Annotated[float | None, Option(min=1.0, max=179.0, metavar="DEG", help="Horizontal field of view.")] = None,
    stature: Annotated[list[str] | None, Option(metavar="[PERSON=]M", help="Stature of all, or of a person.")] = None,
    person: Annotated[list[int] | None, Option(min=0, metavar="N", help="Only this person; repeatable.")] = None,
    min_confidence: Annotated[float | None, Option(min=0.0, max=10.0, help="Lowest confidence; default 0.2.")] = None,
    pitch: Annotated[float | None, Option(min=-80, max=80, metavar="DEG", help="Pitch of the camera, down.")] = None,
    height: Annotated[float | None, Option(min=0.1, max=100, metavar="M", help="Height of the camera.")] = None,
    lag: Annotated[int, Option(min=0, max=1000, metavar="FRAMES", help="Delay of live poses.")] = 6,
    units: Annotated[Literal["cm", "m"], Option(help="Unit of lengths in BVH files.")] = "cm",
    people: Annotated[Path | None, Option(metavar="FILE", help="Edited table of identities.")] = None,
    clean_up: Annotated[bool, Option(help="Still planted feet and keep the floor.")] = True,
) -> None:
    """Run the command."""
    # Here, because numba and the search take a second that the other commands need not wait for.
    from flows.console.reconstructing import annotation_source, follow_video, reconstruct_video

    whole_only: dict[str, object] = {
        "--height": height,
        "--stature": stature,
        "--person": person,
        "--people": people,
        "--focal": focal,
        "--fov": fov,
        "--min-confidence": min_confidence,
        "--units": units if units != "cm" else None,
    }
    given = [name for name, value in whole_only.items() if value not in (None, [])]
    if follow and given:
        raise InputError(f"{given[0]} is for whole videos: with --follow, leave it out")
    if follow:
        follow_video(
            path,
            database,
            store,
            out,
            rate_hz=rate or 30.0,
            size=size,
            pitch_deg=pitch,
            idle_s=idle,
            lag=lag,
            has_clean_up=clean_up,
        )
        return
    stated = {"rate_hz": rate, "focal_px": focal, "fov_deg": fov, "min_confidence": min_confidence}
    reconstruct_video(
        annotation_source(path, size, **stated, people_file=people),
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
