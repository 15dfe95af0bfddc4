"""`reconstruct`: 3D motions of the people in a detector's files, at once or while the files are being written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pasdedeux.errors import InputError

_HELP = """Reconstruct 3D motions of the people in a detector's files, from the projections of a study.

Read are OpenPose folders, COCO annotations and result lists, MediaPipe's landmarks, our CSV and npz; a folder of
several cameras is as many sequences.  With --follow: a folder of OpenPose files.

\b
  pasdedeux reconstruct walk/ --database store --out out/     a BVH and an npz file a person
  pasdedeux reconstruct walk/ --database projections:duets --follow
                                       a JSON line per person and frame while the files are being written

With --follow, a pose leaves --lag frames after its image, those of a person's first two seconds when these are over.
It ends with Ctrl-C, when a file STOP appears in the folder, or when nothing new came for --idle seconds: poses that
wait are then written, and how long all took is told.
"""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("reconstruct", help=_HELP)(reconstruct)


def reconstruct(
    path: Annotated[Path, typer.Argument(metavar="FILE_OR_DIR", help="2D poses: a file, or a folder of them.")],
    database: Annotated[
        str, typer.Option(metavar="REF_OR_STORE", help="Reference to projections, or folder of a store with one study.")
    ] = "store",
    store: Annotated[Path, typer.Option(metavar="DIR", help="Store that a reference is looked up in.")] = Path("store"),
    out: Annotated[
        Path | None, typer.Option(help="Folder for BVH files, or with --follow a file for the lines.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, typer.Option(min=0.0, metavar="S", help="Seconds without a new file that end it.")] = 5.0,
    rate: Annotated[
        float | None,
        typer.Option(min=1.0, max=1000.0, metavar="HZ", help="Frames per second; the file's, the video's, or 30."),
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size; the file's or the video's.")] = None,
    focal: Annotated[float | None, typer.Option(min=1.0, metavar="PX", help="Focal length, if known.")] = None,
    fov: Annotated[
        float | None, typer.Option(min=1.0, max=179.0, metavar="DEG", help="Horizontal field of view, if known.")
    ] = None,
    stature: Annotated[
        list[str] | None,
        typer.Option(metavar="[PERSON=]M", help="How tall everybody is, or one person; gives people their size."),
    ] = None,
    person: Annotated[list[int] | None, typer.Option(min=0, metavar="N", help="Only this person; repeatable.")] = None,
    min_confidence: Annotated[
        float | None, typer.Option(min=0.0, max=10.0, help="Keypoints of less are missing; by default 0.2.")
    ] = None,
    pitch: Annotated[
        float | None,
        typer.Option(min=-80.0, max=80.0, metavar="DEG", help="How far the camera looks down; live 10, else found."),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=100.0,
            metavar="M",
            help="Height of the camera over the floor, if known: gives people their size.",
        ),
    ] = None,
    lag: Annotated[int, typer.Option(min=0, max=1000, metavar="FRAMES", help="Delay of live poses.")] = 6,
    units: Annotated[Literal["cm", "m"], typer.Option(help="Unit of lengths in BVH files.")] = "cm",
    people: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Table of who is who, as this command writes it; overrules what it decides."),
    ] = None,
    clean_up: Annotated[bool, typer.Option(help="Still planted feet and keep the floor.")] = True,
) -> None:
    """Run the command."""
    # Here, because numba and the search take a second that the other commands need not wait for.
    from flows.console.reconstructing import Live, Whole, follow_video, reconstruct_video

    whole_only: dict[str, object] = {"--height": height, "--stature": stature, "--person": person, "--people": people}
    given = [name for name, value in (whole_only | {"--focal": focal, "--fov": fov}).items() if value]
    if follow and given:
        raise InputError(f"{given[0]} is for whole videos: live, nobody knows yet where the floor is or who is who")
    if follow:
        live = Live(out, rate or 30.0, size, pitch_deg=pitch, idle_s=idle, lag=lag, has_clean_up=clean_up)
        follow_video(path, database, store, live)
    else:
        whole = Whole(
            out,
            rate_hz=rate,
            size=size,
            focal_px=focal,
            fov_deg=fov,
            min_confidence=min_confidence,
            person_ids=tuple(person or ()),
            statures=tuple(stature or ()),
            pitch_deg=pitch,
            camera_height_m=height,
            people=people,
            has_clean_up=clean_up,
            units=units,
        )
        reconstruct_video(path, database, store, whole)
