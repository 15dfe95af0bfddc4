"""`export`: writes the rows of a reference to files of other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Option

from flows.console import options
from flows.console.context import app, echo, open_store, say
from flows.exports import EXPORT_FORMATS, export_reference, export_selection
from flows.exports.export_format import Rate, RestPose, Units
from pasdedeux.verdict import Level
from storage_schema import parse_reference
from tasks.data import LOOK, Data, player_page


@app.command()
def export(
    reference: options.Reference,
    out: options.OutFolder,
    file_format: Annotated[str, Option("--format", metavar="NAME", help=f"{', '.join(EXPORT_FORMATS)}.")] = "npz",
    rest_pose: Annotated[RestPose, Option(help="For poses and variants: that of the source, or a T-pose.")] = "source",
    units: Annotated[Units, Option(help="Lengths of their BVH files; `source`: as in each source's file.")] = "cm",
    select: Annotated[
        int | None,
        Option(min=1, metavar="N", help="For draws:study: N pairs that represent all, repaired ones if there are any."),
    ] = None,
    verdict: Annotated[
        Literal["pass", "warn"] | None,
        Option(help="For files of poses: the worst verdict allowed; others go to the subfolder `not_good`."),
    ] = None,
    footage: Annotated[
        Path | None, Option(metavar="FILE", help="For mp4: the video to draw on; default: blank frames.")
    ] = None,
    body_model: Annotated[
        Path | None, Option(metavar="FILE", help="For smpl: the body model that the parameters are for.")
    ] = None,
    rate: Annotated[Rate, Option(help="For poses and variants: frame rate of the study or of the source.")] = "study",
    all_methods: Annotated[
        bool, Option("--all-methods", help="For motions and lifted_pairs: every method, not only the best.")
    ] = False,
    curation: Annotated[
        Path | None, Option(metavar="FILE", help="File of choices; default: that of the study or dataset.")
    ] = None,
    store: options.Store = Path("store"),
) -> None:
    """Export the rows of a reference to files, with units, licence and credits.

    \b
      npz   numpy arrays, one file: every table
      csv   one line per row, arrays as columns: every table
      bvh   a file per person: poses and variants (the source's own
            skeleton, an npz beside), motions (a humanoid), draws, seeds,
            lifted_pairs, in_betweens (a frame each)
      glb   everybody in one scene, skinned and animated, for Blender and
            viewers: the same tables
      c3d   joints as labelled points, everybody in one file: the same tables
      trc   the same, for OpenSim
      smpl  parameters of SMPL, SMPL-H or SMPL-X for your own body model:
            poses, variants, motions
      mp4   the result drawn on its footage: motions, lifted_pairs, in_betweens
      coco  2D keypoints: annotations
      json  both people with named joints, for editing: seeds, one draw
      safetensors  trained models with a card

    FBX and USD are not written: import the glb or bvh into Blender and export there (docs/formats-and-units.md).

    \b
      pasdedeux export variants:duets/waltz --format glb --verdict pass --out new
      pasdedeux export poses:duets --format bvh --rest-pose standing --out takes
      pasdedeux export contacts:duets --format csv --out contacts
      pasdedeux export draws:duets --select 500 --out selected
    """
    worst = None if verdict is None else Level(verdict)
    stated = {"verdict": worst, "all_methods": all_methods, "footage": footage, "body_model": body_model}
    some: dict[str, Any] = {name: value for name, value in stated.items() if value}
    opened = open_store(store)
    if select is not None:
        paths, words = export_selection(opened, reference, file_format, out, count=select, **some)
        say([*map(str, paths), words])
        return
    written = export_reference(
        opened, reference, file_format, out, rest_pose=rest_pose, units=units, rate=rate, curation=curation, **some
    )
    say(map(str, written))
    data = Data(opened, curation)
    if left_out := data.left_out(reference):
        echo(f"left out, as somebody rejected it: {len(left_out)} of {parse_reference(reference).table}")
    if pictures := data.pictures(reference):
        (out / LOOK).write_text(player_page(reference, pictures), encoding="utf-8")
        echo(f"look at it: {out / LOOK}")
