"""`reconstruct`: 3D motions of the people in OpenPose files, at once or while the files are being written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pasdedeux.errors import InputError

__all__ = ["register"]

_HELP = """Reconstruct 3D motions of the people in a folder of OpenPose files, from the projections of a study.

\b
  pasdedeux reconstruct walk/ --database store --out out/     a BVH and an npz file a person
  pasdedeux reconstruct walk/ --database projections:duets --follow
                                       a JSON line per person and frame while the files are being written

With --follow, a pose leaves --lag frames after its image.  It ends with Ctrl-C, when a file STOP appears in the
folder, or when nothing new came for --idle seconds: poses that wait are then written, and how long all took is told.
"""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("reconstruct", help=_HELP)(reconstruct)


def reconstruct(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of OpenPose JSON files, one a frame.")],
    database: Annotated[
        str, typer.Option(metavar="REF_OR_STORE", help="Reference to projections, or folder of a store with one study.")
    ] = "store",
    store: Annotated[Path, typer.Option(metavar="DIR", help="Store that a reference is looked up in.")] = Path("store"),
    out: Annotated[
        Path | None, typer.Option(help="Folder for BVH files, or with --follow a file for the lines.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, typer.Option(min=0.0, metavar="S", help="Seconds without a new file that end it.")] = 5.0,
    rate: Annotated[float, typer.Option(min=1.0, max=1000.0, metavar="HZ", help="Frames per second.")] = 30.0,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size in pixels, if known.")] = None,
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
    clean_up: Annotated[bool, typer.Option(help="Still planted feet and keep the floor.")] = True,
) -> None:
    """Run the command."""
    # Here, because numba and the search take a second that the other commands need not wait for.
    from flows.console.reconstructing import Live, Whole, follow_video, reconstruct_video

    if follow and height is not None:
        raise InputError("--height is for whole videos: live, nobody knows yet where the floor is")
    if follow:
        live = Live(out, rate_hz=rate, size=size, pitch_deg=pitch, idle_s=idle, lag=lag, has_clean_up=clean_up)
        follow_video(folder, database, store, live)
    else:
        whole = Whole(out, rate, size, pitch, camera_height_m=height, has_clean_up=clean_up, units=units)
        reconstruct_video(folder, database, store, whole)
