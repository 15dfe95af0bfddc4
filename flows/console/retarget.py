"""`retarget`: a take for the bodies of other people, from a store or straight from motion files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from flows.console.context import app
from flows.exports import RestPose, Units


@app.command()
def retarget(
    take: Annotated[list[str], Argument(metavar="TAKE", help="STUDY/TAKE, a study file, or a motion file a person.")],
    to: Annotated[list[str], Option("--to", metavar="BODY", help="Body of person A, then of B, ...")],
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder for the files; made when missing.")],
    store: Annotated[Path, Option(metavar="DIR", help="Store of TAKE and NAME.")] = Path("store"),
    unit: Annotated[
        list[float] | None, Option("--unit", min=1e-6, metavar="M", help="Metres per unit of the files.")
    ] = None,
    body_unit: Annotated[
        list[float] | None, Option("--body-unit", min=1e-6, metavar="M", help="Metres per unit of --to.")
    ] = None,
    rate: Annotated[float | None, Option(min=1, max=1000, metavar="HZ", help="True rate of the files.")] = None,
    model: Annotated[str | None, Option(metavar="NAME", help="Trained model: NAME, NAME@STUDY/SPLIT, file.")] = None,
    rest_pose: Annotated[RestPose, Option(help="The source's, or a standing T-pose.")] = "source",
    units: Annotated[Units, Option(help="Lengths of BVH files; `source`: as in each source's file.")] = "cm",
) -> None:
    """Retarget a take to other bodies, keep its contacts, and write it on its own skeletons.

    TAKE is STUDY/TAKE of a store, a reference to poses, or motion files that need no study, one a person (BVH, AMC with
    its ASF, positions), person A first.  The first --to is for person A, the next for B, and so on; `source` keeps
    somebody as captured.
    A study file, as `study new` writes it, adds what the files of its first take do not say: layouts, mappings, axes.
    A body is a BVH or ASF file of another person, a table of joint distances in metres (CSV with
    the columns from, to, distance_m), or joint positions with the names of body22 or SMPL (npz, JSON).

    \b
      pasdedeux retarget duets/waltz --to tall.bvh --out waltz_tall
      pasdedeux retarget a.bvh b.bvh --to source --to 02.asf --out b_as_02

    With --model a trained model gives the motion in place of the solver: NAME, or NAME@STUDY/SPLIT where the store has
    several of that name, or a .safetensors file that `export` wrote.

    \b
      pasdedeux retarget a.bvh b.bvh --to 02.asf --model ridge_adapted@models/cross_interaction --out b_as_02

    A BVH and an npz file a person are written, as by `export`, with UNITS.txt and CREDITS.txt.
    """
    # Here, because the solver's kernels take a second that the other commands need not wait for.
    from flows.console.retargeting import find_model, find_take, read_targets, retarget_take

    weights = None if model is None else find_model(model, store)
    targets = read_targets(to, body_unit or ())
    with find_take(take, store, unit or (), rate) as (opened, ref):
        retarget_take(opened, ref, targets, out, rest_pose=rest_pose, units=units, weights=weights)
