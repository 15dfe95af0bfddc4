"""`generate`: new bodies and their motion from a trained model, for a take of a store or of motion files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from flows.console.context import app

_HELP = """Sample new bodies of person B, and the motion of both, from a trained model.

MODEL is NAME, NAME@STUDY/SPLIT where the store has several of that name, or a .safetensors file that `export` wrote.
TAKE is STUDY/TAKE of a store, a reference to poses, or two motion files (BVH, AMC with its ASF, positions), A first.
B's bones are drawn from what the model learned of bodies, or all scaled by --scales, in turn.  Two steps of the
interaction mesh then make bones exact and bring contacts back.

\b
  pasdedeux generate paper_cvae models/waltz --num 5 --out new
  pasdedeux generate weights.safetensors a.bvh b.bvh --scales 0.9,1.1 --num 2 --out new

With --key-frames B goes through given poses: a JSON file with `frames`, such as [10, 40], and `body22_m`, for each of
them the 22 joints of B in metres, where the take is.  Without --scales, B gets their bones.

The same --seed gives the same files, and a larger --num the same first ones.  The verdict of each motion is printed;
one that fails is not written, and if none is left the exit code is 1.
"""


@app.command(help=_HELP)
def generate(
    model: Annotated[str, Argument(metavar="MODEL", help="Trained model: NAME, NAME@STUDY/SPLIT, or file.")],
    take: Annotated[list[str], Argument(metavar="TAKE", help="STUDY/TAKE, a reference, or a motion file a person.")],
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder for the files; made when missing.")],
    num: Annotated[int, Option("--num", min=1, max=10_000, help="How many motions.")] = 1,
    scales: Annotated[str, Option(metavar="S,S", help="Scales of all of B's bones; drawn when not given.")] = "",
    key_frames: Annotated[Path | None, Option(metavar="FILE", help="Poses that B goes through (JSON).")] = None,
    seed: Annotated[int, Option(min=0, help="What is drawn follows from it.")] = 0,
    store: Annotated[Path, Option(metavar="DIR", help="Store of MODEL and TAKE.")] = Path("store"),
    unit: Annotated[
        list[float] | None, Option("--unit", min=1e-6, metavar="M", help="Metres per unit of the files.")
    ] = None,
    rate: Annotated[float | None, Option(min=1, max=1000, metavar="HZ", help="True rate of the files.")] = None,
    file_format: Annotated[
        Literal["bvh"], Option("--format", help="bvh: a BVH and an npz file a person, as `export` writes them.")
    ] = "bvh",
) -> None:
    """Run the command."""
    # Here, because the solver's kernels take a second that the other commands need not wait for.
    from flows.console.generating import generate_motions

    generate_motions(
        model,
        take,
        store,
        out,
        num=num,
        scales=scales,
        key_frames=key_frames,
        seed=seed,
        units_m=unit or (),
        rate_hz=rate,
    )
