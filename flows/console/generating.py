"""The work of `generate`: a model and a take are found, motions are sampled, judged and written one by one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import typer

from flows.console.context import echo, say
from flows.console.retargeting import find_model, find_take
from flows.exports import write_credits
from flows.exports.own_skeletons import RigFiles, people_of_take
from pasdedeux.augmentation import Variant
from pasdedeux.errors import InputError
from pasdedeux.learning.key_frames import KeyFrames, read_key_frames
from pasdedeux.learning.registry import Weights
from pasdedeux.learning.sampling import VariantSampler
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Store, source_credits
from tasks.facts import TakeFacts
from tasks.generation import draws_bodies, sampling_stream, variant_name
from tasks.ingest.files import load_file
from tasks.takes import read_take


def generate_motions(
    model: str,
    take: Sequence[str],
    store_root: Path,
    out: Path,
    *,
    num: int,
    scales: str = "",
    key_frames: Path | None = None,
    seed: int = 0,
    units_m: Sequence[float] = (),
    rate_hz: float | None = None,
) -> None:
    """Sample motions, and write those that do not fail.

    Args:
        model: Trained model.
        take: The take, or its motion files.
        store_root: Store of both.
        out: Folder for the files.
        num: How many motions.
        scales: Scales of B, separated by commas; empty where they are drawn.
        key_frames: File of poses of B.
        seed: Seed of what is drawn.
        units_m: Metres per unit of the motion files.
        rate_hz: True rate of the motion files.

    Raises:
        InputError: Model, take, scales or key frames are not there or do not fit each other.
        Exit: With code 1: every motion failed.
    """
    given = _read_scales(scales)
    keys = None if key_frames is None else read_key_frames(load_file(key_frames).data, key_frames.name)
    weights = find_model(model, store_root)
    if not given and keys is None and not draws_bodies(type(weights.model)):
        raise InputError(f"{weights.model.name} draws no bodies: say --scales, such as 0.9,1.1")
    with find_take(take, store_root, units_m, rate_hz) as (store, ref):
        _generate(store, ref, weights, given, keys, out, num, seed)


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
    is_known = weights.takes.get(take.take_id) == ref.content_digest
    name = take.take_id if is_known else f"{take.take_id} ({ref.key[:12]})"
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
    finally:  # also where it is interrupted: what lies there has its units beside it
        written = () if files is None else files.close()
    if files is None:
        echo(f"error: none of {num} motions is usable, nothing was written", err=True)
        raise typer.Exit(1)
    say(map(str, (*written, credits_path)))
    known = "was" if is_known else "was not"
    echo(f"{num_usable} of {num} motions are usable; {weights.model.name} {known} trained on take {take.take_id}")


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
