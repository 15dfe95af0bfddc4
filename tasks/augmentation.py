"""Stage `augmentation`: every pair again for other body proportions, contacts kept, each variant measured."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pasdedeux.augmentation import (
    Augmenter,
    Source,
    Variant,
    variant_rotations,
)
from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store
from storage_schema.artifact_writer import ArtifactWriter
from tasks.augmentation_parameters import AugmentationParameters, settings_of, variations_of
from tasks.stage import Shard, Stage, StageInputs, artifact_fields

__all__ = ["STAGE", "VERSION", "AugmentationParameters", "PairTake", "plan", "read_pair", "run_shard"]

VERSION = 5

_SOLVED_TOGETHER = 16
"""Variants solved in one batch: a few dozen columns fill the matrix products, and memory stays small."""


@dataclass(frozen=True)
class PairTake:
    """A pair as the store holds it: its motion, its rest poses (2, 22, 3) and world rotations (T, 2, 22, 4)."""

    source: Source
    rest_m: np.ndarray
    world_unitquat: np.ndarray
    time_s: np.ndarray


def plan(inputs: StageInputs, parameters: AugmentationParameters) -> list[Shard]:
    """Plan one shard per pair and batch of variants; takes of other than two people have none."""
    asked = parameters.model_dump(mode="json")
    size = asked.pop("variants_per_shard")
    stated = asked.pop("contacts")
    known = {take.facts["take_id"] for take in inputs.of("poses") if take.facts.get("kind") == "take"}
    for take_id in stated:
        if take_id not in known:
            raise InputError(f"augmentation.contacts: take '{take_id}' is not there; takes: {', '.join(sorted(known))}")
    shards = []
    for take in inputs.of("poses"):
        if take.facts.get("kind") != "take" or take.facts["num_persons"] != 2:
            continue
        take_id = take.facts["take_id"]
        names = [variation.variant_id for variation in variations_of(parameters, inputs.seed, take_id)]
        for start in range(0, len(names), size):
            batch = names[start : start + size]
            shards.append(
                Shard(
                    stage="augmentation",
                    version=VERSION,
                    partition=take_id,
                    name=f"{batch[0]} to {batch[-1]}",
                    parameters={**asked, "contacts": {take_id: stated.get(take_id, [])}, "variants": batch},
                    inputs=(take.ref,),
                    seed=inputs.seed,
                )
            )
    return shards


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Solve a batch of variants of one take and stream them to the store."""
    names = list(shard.parameters["variants"])
    asked = {name: value for name, value in shard.parameters.items() if name != "variants"}
    parameters = AugmentationParameters.model_validate(json.loads(json.dumps(asked)))
    manifest = store.manifest(shard.inputs[0])
    take_id = manifest.facts["take_id"]
    known = {v.variant_id: v for v in variations_of(parameters, shard.seed, take_id)}
    take = read_pair(store, shard.inputs[0])
    started = time.monotonic()
    augmenter = Augmenter(take.source, settings_of(parameters, take_id))
    facts = {
        "kind": "variants",
        "takes": [take_id],
        "take_id": take_id,
        "variants": names,
        "num_frames": take.source.num_frames,
        "rate_hz": take.source.rate_hz,
        "is_held_out": bool(manifest.facts.get("is_held_out", False)),
        "closest_m": take.source.closest_m,
    }
    verdicts = {"pass": 0, "warn": 0, "fail": 0}
    with store.writer(**artifact_fields(shard, store), facts=facts) as writer:
        for start in range(0, len(names), _SOLVED_TOGETHER):
            batch = [known[name] for name in names[start : start + _SOLVED_TOGETHER]]
            for variant in augmenter.solve(batch):
                verdicts[variant.verdict] += 1
                _write(writer, take_id, take, variant)
        writer.facts["verdicts"] = verdicts
        writer.facts["num_joggled_frames"] = augmenter.num_joggled
        writer.timings["solve_s"] = time.monotonic() - started
    return writer.ref


def read_pair(store: Store, ref: ArtifactRef) -> PairTake:
    """Read a pair's take from its artifact.

    Raises:
        InputError: A frame is not finite.
    """
    facts = store.manifest(ref).facts
    takes = store.read(ref, "takes", columns=["person", "body22_rest_m"])
    poses = store.read(ref, "poses", columns=["time_s", "body22_m", "body22_world_unitquat"])
    people, world = (
        np.swapaxes(poses[name].astype(np.float64).reshape(2, -1, *poses[name].shape[1:]), 0, 1)
        for name in ("body22_m", "body22_world_unitquat")
    )
    return PairTake(
        source=Source(np.ascontiguousarray(people), float(facts["rate_hz"]), f"take {facts['take_id']}"),
        rest_m=takes["body22_rest_m"].astype(np.float64),
        world_unitquat=np.ascontiguousarray(world),
        time_s=np.asarray(poses["time_s"][: len(people)]),
    )


def _write(writer: ArtifactWriter, take_id: str, take: PairTake, variant: Variant) -> None:
    frames = take.source.num_frames
    name = variant.variation.variant_id
    rotations = variant_rotations(take.rest_m, variant.bone_scale, variant.positions_m, take.world_unitquat)
    writer.append(
        "variants",
        {
            "take_id": [take_id] * frames,
            "variant_id": [name] * frames,
            "frame": np.arange(frames, dtype=np.int32),
            "time_s": take.time_s,
            "body22_m": variant.positions_m,
            "body22_unitquat": rotations,
        },
    )
    figures = {field.name: getattr(variant.frames, field.name) for field in fields(variant.frames)}
    writer.append(
        "variant_frames",
        {
            "take_id": [take_id] * frames,
            "variant_id": [name] * frames,
            "frame": np.arange(frames, dtype=np.int32),
            **figures,
            "verdict": [_VERDICTS[verdict] for verdict in variant.frame_verdicts],
        },
    )
    quality = variant.quality
    row: dict[str, Any] = {
        "take_id": take_id,
        "variant_id": name,
        "bone_scale": variant.bone_scale,
        "scale_a": variant.variation.uniform_scale(0),
        "scale_b": variant.variation.uniform_scale(1),
        "num_frames": frames,
        **{field.name: getattr(quality, field.name) for field in fields(quality)},
        "num_iterations": variant.num_iterations,
        "solver": variant.solver,
        "num_warn_frames": int((variant.frame_verdicts == 1).sum()),
        "num_fail_frames": int((variant.frame_verdicts == 2).sum()),
        "verdict": variant.verdict,
        "reason": variant.reason,
    }
    writer.append("variant_quality", {column: _one_row(value) for column, value in row.items()})


_VERDICTS = ("pass", "warn", "fail")


def _one_row(value: Any) -> Any:
    return value[None] if isinstance(value, np.ndarray) else [value]


STAGE = Stage(
    name="augmentation",
    version=VERSION,
    reads=("takes", "poses"),
    writes=("variants", "variant_quality", "variant_frames"),
    parameters=AugmentationParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Variants of every pair for other body proportions, by interaction mesh with exact bone lengths",
)
