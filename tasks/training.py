"""Stage `training`: models of augmentation, trained on the training set of a split, with what is left for testing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from pasdedeux.learning import MODELS, LogEntry, TrainingItem, VariantKey, VariantRequest, make_split, model_class
from storage_schema import ArtifactRef, Store
from tasks.augmentation import PairTake, read_pair
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, stream

__all__ = ["STAGE", "VERSION", "TrainingParameters", "plan", "read_items", "run_shard"]

VERSION = 1

SplitName = Literal["random", "cross_scale", "cross_interaction", "cross_scale_interaction"]


class TrainingParameters(Parameters):
    """Which models are trained on which splits."""

    splits: tuple[SplitName, ...] = Field(
        ("cross_scale",), description="Splits: random, cross_scale, cross_interaction, cross_scale_interaction"
    )
    models: tuple[str, ...] = Field(tuple(MODELS), min_length=1, description=f"Models: {', '.join(MODELS)}")
    test_takes: tuple[str, ...] = Field((), description="Takes the splits across interactions test on, beside held-out")

    @field_validator("models")
    @classmethod
    def _models_are_known(cls, models: tuple[str, ...]) -> tuple[str, ...]:
        for name in models:
            if name not in MODELS:
                raise ValueError(f"training.models: '{name}' is not known; known models: {', '.join(MODELS)}")
        return models


def plan(inputs: StageInputs, parameters: TrainingParameters) -> list[Shard]:
    """Plan one shard per split; held-out takes are never trained on."""
    variants = [manifest for manifest in inputs.of("variants") if manifest.facts.get("kind") == "variants"]
    used = {manifest.facts["take_id"] for manifest in variants}
    takes = [manifest for manifest in inputs.of("poses") if manifest.facts.get("take_id") in used]
    if not variants:
        return []
    return [
        Shard(
            stage="training",
            version=VERSION,
            partition=split,
            name=split,
            parameters={
                "split": split,
                "models": list(parameters.models),
                "test_takes": sorted(parameters.test_takes),
            },
            inputs=tuple(manifest.ref for manifest in (*takes, *variants)),
            seed=inputs.seed,
        )
        for split in parameters.splits
    ]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Train every model of a split.

    Raises:
        InputError: The split has no training or no test variant.
    """
    split_name = str(shard.parameters["split"])
    takes: dict[str, PairTake] = {}
    homes: dict[tuple[str, str], ArtifactRef] = {}
    keys: list[VariantKey] = []
    held_out: set[str] = set()
    for ref in shard.inputs:
        facts = store.manifest(ref).facts
        if facts["kind"] == "take":
            takes[facts["take_id"]] = read_pair(store, ref)
            continue
        table = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "verdict"])
        if facts["is_held_out"]:
            held_out.add(facts["take_id"])
        for row, variant_id in enumerate(table["variant_id"]):
            if table["verdict"][row] != "fail":
                keys.append(VariantKey(facts["take_id"], str(variant_id), table["bone_scale"][row]))
            homes[facts["take_id"], str(variant_id)] = ref
    test_takes = sorted(held_out | set(shard.parameters["test_takes"]))
    split = make_split(split_name, keys, stream(shard.seed, "training", split_name), test_takes=test_takes)

    def items() -> Iterator[TrainingItem]:
        return read_items(store, split.train, homes, takes)

    models: dict[str, list] = {"split": [], "model": [], "array_name": [], "array_shape": [], "values": []}
    log: dict[str, list] = {"split": [], "model": [], "step": [], "quantity": [], "value": []}
    for name in sorted(shard.parameters["models"]):
        model, entries = model_class(name).train(items)
        for array_name, values in sorted(model.arrays().items()):
            _add(models, split_name, name, array_name, np.array(values.shape, np.int32), values.ravel())
        sizes = [LogEntry(0, "num_train", len(split.train)), LogEntry(0, "num_test", len(split.test))]
        for entry in sorted([*entries, *sizes], key=lambda entry: (entry.step, entry.quantity)):
            _add(log, split_name, name, entry.step, entry.quantity, float(entry.value))
    return commit(
        shard,
        store,
        tables={"models": models, "training_log": log},
        facts={
            "kind": "models",
            "split": split_name,
            "models": sorted(shard.parameters["models"]),
            "takes": split.train_takes,
            "shares_takes": split.shares_takes,
            "train": _by_take(split.train),
            "test": _by_take(split.test),
        },
    )


def read_items(
    store: Store,
    keys: Sequence[VariantKey],
    homes: dict[tuple[str, str], ArtifactRef],
    takes: dict[str, PairTake],
) -> Iterator[TrainingItem]:
    """Read variants one at a time, artifact by artifact; `homes` says where each (take, variant) lies."""
    wanted: dict[ArtifactRef, dict[str, VariantKey]] = {}
    for key in keys:
        wanted.setdefault(homes[key.take_id, key.variant_id], {})[key.variant_id] = key
    for ref, by_name in wanted.items():
        offset = 0
        sizes = store.read(ref, "variant_quality", columns=["variant_id", "num_frames"])
        for name, frames in zip(sizes["variant_id"], sizes["num_frames"], strict=True):
            rows = slice(offset, offset + int(frames))
            offset = rows.stop
            if str(name) not in by_name:
                continue
            key = by_name[str(name)]
            motion = store.read(ref, "variants", columns=["body22_m"], rows=rows)["body22_m"].astype(np.float64)
            request = VariantRequest(key.take_id, takes[key.take_id].source, key.bone_scale)
            yield TrainingItem(key.variant_id, request, motion)


def _by_take(keys: Sequence[VariantKey]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for key in keys:
        found.setdefault(key.take_id, []).append(key.variant_id)
    return found


def _add(columns: dict[str, list], *values: object) -> None:
    for column, value in zip(columns.values(), values, strict=True):
        column.append(value)


STAGE = Stage(
    name="training",
    version=VERSION,
    reads=("variants", "variant_quality", "poses"),
    writes=("models", "training_log"),
    parameters=TrainingParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Models that give a pair's motion for new body proportions",
)
