"""Datasets of made-up motion in a store: takes of two people, a batch of variants of each, and scores of all."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pasdedeux.skeletons import BODY22
from storage_schema import Dataset, Manifest, SourceCredit, Store, create_dataset
from tasks.augmentation import BatchParameters
from tests.builders.moving_pairs import swaying_pair
from tests.builders.storage_rows import MADE_UP, put, random_columns, take_rows

VARIANTS = ("A-uniform-0.80", "A-uniform-1.10", "B-uniform-0.90")


def put_dataset(
    store: Store,
    takes: Mapping[str, bool],
    *,
    version: str | None = None,
    num_frames: int = 12,
    variants: Sequence[str] = VARIANTS,
    sources: Mapping[str, SourceCredit] | None = None,
    choices: Mapping[str, str] | None = None,
    is_scored: bool = True,
) -> Dataset:
    """Commit takes by name, whether they are held out, with their variants and scores, and name them `made`.

    Args:
        store: The store.
        takes: Whether each take is held out, by its name.
        version: Version of the dataset.
        num_frames: Frames of each take.
        variants: Names of the variants of each.
        sources: Where takes come from that are not made up.
        choices: What was accepted and rejected, as a study has it.
        is_scored: Whether there are scores, which name every take.
    """
    made: list[Manifest] = []
    for number, (take_id, is_held_out) in enumerate(takes.items()):
        source = (sources or {}).get(take_id, MADE_UP)
        made += put_clips(store, take_id, number, num_frames, variants, source, is_held_out=is_held_out)
    if is_scored:
        scores = random_columns("scores", len(takes)) | {"item": list(takes)}
        page = {"kind": "report"}
        made.append(put(store, "evaluation", " ".join(takes), {"scores": scores}, page, tuple(made)))
    study = {"study": {"name": "made"}, "curation": {"choices": dict(choices or {})}}
    files = {"study.json": json.dumps(study).encode(), "environment.json": b"{}"}
    return create_dataset(store, "made", [one.ref for one in made], version=version, attachments=files)


def put_clips(
    store: Store,
    take_id: str,
    seed: int,
    num_frames: int,
    variants: Sequence[str] = VARIANTS,
    source: SourceCredit = MADE_UP,
    *,
    is_held_out: bool = False,
) -> list[Manifest]:
    """Commit a take of two people and a batch of its variants."""
    people = swaying_pair(num_frames, apart_m=2.0 if take_id == "alone" else 0.3, seed=seed).astype(np.float32)
    by_person = people.swapaxes(0, 1).reshape(-1, *people.shape[2:])
    columns, facts = take_rows(take_id, 2, num_frames, is_held_out=is_held_out, body22_m=by_person)
    people_rows = random_columns("takes", 2) | {"take_id": [take_id] * 2, "person": [0, 1], "body22_rest_m": people[0]}
    take = put(store, "ingest", take_id, {"takes": people_rows, "poses": columns}, facts, source=source)
    count, size = len(variants), 2 * num_frames
    frame = np.repeat(np.arange(num_frames), 2)
    rows: dict[str, Any] = {
        "take_id": [take_id] * (count * size),
        "variant_id": [name for name in variants for _ in range(size)],
        "frame": np.tile(frame, count),
        "person": np.tile([0, 1], count * num_frames),
        "time_s": np.tile(frame / 30.0, count),
        "body22_m": np.concatenate([people.reshape(-1, *people.shape[2:]) * (1 + at / 50) for at in range(count)]),
        "body22_unitquat": np.tile(np.float32([0, 0, 0, 1]), (count * size, BODY22.num_joints, 1)),
    }
    quality = random_columns("variant_quality", count) | {
        "take_id": [take_id] * count,
        "variant_id": list(variants),
        "bone_scale": [np.full(2 * BODY22.num_joints, 1 + at / 50) for at in range(count)],
        "verdict": ["pass"] * count,
    }
    frames = random_columns("variant_frames", count * num_frames) | {
        "take_id": [take_id] * (count * num_frames),
        "variant_id": [name for name in variants for _ in range(num_frames)],
        "frame": np.tile(np.arange(num_frames), count),
    }
    parameters = BatchParameters(contacts=(), variants=tuple(variants)).model_dump(mode="json", exclude={"limits"})
    facts = {"kind": "variants", "takes": [take_id], "take_id": take_id, "variants": list(variants), "told": parameters}
    facts |= {"num_persons": 2, "num_frames": num_frames, "rate_hz": 30.0, "is_held_out": is_held_out}
    tables = {"variants": rows, "variant_quality": quality, "variant_frames": frames}
    return [take, put(store, "augmentation", take_id, tables, facts, (take,), source=MADE_UP)]
