"""`generate`: samples new bodies and their motion from a trained model, for a take of a store or of files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from typer import Argument, Option

from flows.console import options
from flows.console.context import app, echo, say
from flows.console.inputs import RateOption, TakeArgument, UnitOption, find_model, find_take, known_take
from flows.exports.credits import write_credits
from flows.exports.own_skeletons import RigFiles, people_of_take
from pasdedeux.augmentation import Variant
from pasdedeux.errors import InputError
from pasdedeux.learning.key_frames import KeyFrames, read_key_frames
from pasdedeux.learning.registry import Weights
from pasdedeux.learning.sampling import VariantSampler
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Store, source_credits
from tasks.generation import draws_bodies, sampling_stream, variant_name
from tasks.ingest.files import load_file
from tasks.rows.takes import read_take
from tasks.stage.facts import TakeFacts


@app.command()
def generate(
    model: Annotated[str, Argument(metavar="MODEL", help="Trained model: NAME, NAME@STUDY/SPLIT, or file.")],
    take: TakeArgument,
    out: options.OutFolder,
    num: Annotated[int, Option("--num", min=1, max=10_000, help="How many motions.")] = 1,
    scales: Annotated[str, Option(metavar="S,S", help="Scales of all of B's bones; drawn when not given.")] = "",
    key_frames: Annotated[Path | None, Option(metavar="FILE", help="Poses that B passes through (JSON).")] = None,
    seed: Annotated[int, Option(min=0, help="Seed of the random numbers.")] = 0,
    store: Annotated[Path, Option(metavar="DIR", help="Store of MODEL and TAKE.")] = Path("store"),
    unit: UnitOption = None,
    rate: RateOption = None,
    file_format: Annotated[
        Literal["bvh"], Option("--format", help="bvh: a BVH and an npz file per person, as `export` writes them.")
    ] = "bvh",
) -> None:
    """Sample new bodies for person B, and the motion of both, from a trained model.

    MODEL is NAME, NAME@STUDY/SPLIT if the store has several models of that name, or a .safetensors file written by
    `export`.  TAKE is STUDY/TAKE of a store, a reference to poses, a study file, or two motion files (BVH, AMC with
    its ASF, positions), person A first.  B's bones are drawn from the bodies that the model learned, or scaled by
    --scales (one scale per motion, in turn).  Two steps of the interaction mesh then make bone lengths exact and
    restore contacts.

    \b
      pasdedeux generate paper_cvae models/waltz --num 5 --out new
      pasdedeux generate cvae.safetensors a.bvh b.bvh --num 2 --out new

    With --key-frames B passes through given poses: a JSON file with `frames`, such as [10, 40], and `body22_m`, the 22
    joints of B in metres for each of them, in the coordinates of the take.  Without --scales, B gets their bones.

    The same --seed gives the same files; a larger --num only adds files.  The verdict of each motion is printed; one
    that fails is not written, and if none is left the exit code is 1.
    """
    given = _read_scales(scales)
    keys = None if key_frames is None else read_key_frames(load_file(key_frames).data, key_frames.name)
    weights = find_model(model, store)
    if not given and keys is None and not draws_bodies(type(weights.model)):
        raise InputError(f"{weights.model.name} draws no bodies: say --scales, such as 0.9,1.1")
    with find_take(take, store, unit or (), rate) as (opened, ref):
        _generate(opened, ref, weights, given, keys, out, num, seed)


def _read_scales(text: str) -> list[float]:
    try:
        return [float(scale) for scale in text.split(",")] if text else []
    except ValueError:
        raise InputError(f"--scales {text}: numbers separated by commas are allowed, such as 0.9,1.1") from None


def _generate(
    store: Store,
    ref: ArtifactRef,
    weights: Weights,
    scales: Sequence[float],
    keys: KeyFrames | None,
    out: Path,
    num: int,
    seed: int,
) -> None:
    take = TakeFacts.of(store.manifest(ref))
    name, whether_known = known_take(weights, ref, take.take_id)
    source = read_take(store, ref).source
    sampler = VariantSampler(weights.model, source, take_id=name, contacts=take.contacts, key_frames=keys)
    people = people_of_take(store, ref)
    files, num_usable = None, 0
    try:
        for index in range(num):
            scale = np.full(BODY22.num_joints, scales[index % len(scales)]) if scales else None
            variant_id = variant_name(weights.model.name, index)
            variant = sampler.sample(variant_id, sampling_stream(seed, take.take_id, index), scale)
            echo(f"{index + 1} of {num}: {_said(variant, keys)}")
            if variant.verdict.level is Level.FAIL:
                continue
            if files is None:
                out.mkdir(parents=True, exist_ok=True)
                credits_path = write_credits(source_credits(store, ref), [ref], f"take {take.take_id}", out)
                files = RigFiles(out, rest_pose="source", units="cm")
            files.write_variant(variant_id, people, variant.positions_m, variant.bone_scale)
            num_usable += 1
    finally:  # also after an interruption: the files written so far need their units
        written = () if files is None else files.close()
    if files is None:
        echo(f"error: none of {num} motions is usable, nothing was written", err=True)
        raise typer.Exit(1)
    say(map(str, (*written, credits_path)))
    echo(f"usable: {num_usable} of {counted(num, 'motion')}; {whether_known}")


def _said(variant: Variant, keys: KeyFrames | None) -> str:
    bones = np.delete(variant.bone_scale[1], BODY22.root)
    words = [
        f"{variant.variation.variant_id} {variant.verdict.level.value}, bones of B {bones.min():.2f}-{bones.max():.2f}"
    ]
    drift_m = variant.quality.contact_drift_m
    words += [f"contact drift {1e3 * drift_m:.1f} mm"] if np.isfinite(drift_m) else []
    if keys is not None:
        away_m = np.linalg.norm(variant.positions_m[keys.frames, 1] - keys.positions_m, axis=-1).max()
        words.append(f"key frames missed by {1e3 * away_m:.1f} mm at most")
    return ", ".join(words) + (f": {variant.verdict.reason}" if variant.verdict.reason else "")
