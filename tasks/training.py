"""Stage `training`: models of augmentation, trained on the training set of a split, with what is left for testing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydantic import Field, field_validator

from pasdedeux.evaluation.models import model_errors
from pasdedeux.learning import (
    BASELINES,
    MODELS,
    LogEntry,
    SplitName,
    TrainingItem,
    VariantKey,
    VariantModel,
    VariantRequest,
    make_split,
    model_class,
)
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.augmentation import TakeMotion, read_take
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, named_refs, stream

__all__ = ["STAGE", "VERSION", "TrainingParameters", "plan", "read_items", "run_shard"]

VERSION = 1

_JUDGED = 24
"""Test variants that the verdict looks at, spread evenly; the evaluation looks at all."""


class ModelsParameters(Parameters):
    """What the section of a study and the shard of a split have in common."""

    models: tuple[str, ...] = Field(tuple(MODELS), min_length=1, description=f"Models: {', '.join(MODELS)}")
    test_takes: tuple[str, ...] = Field((), description="Takes the splits across interactions test on, beside held-out")

    @field_validator("models")
    @classmethod
    def _models_are_known(cls, models: tuple[str, ...]) -> tuple[str, ...]:
        for name in models:
            if name not in MODELS:
                raise ValueError(f"training.models: '{name}' is not known; known models: {', '.join(MODELS)}")
        return models


class TrainingParameters(ModelsParameters):
    """Which models are trained on which splits."""

    splits: tuple[SplitName, ...] = Field(
        ("cross_scale",), description="Splits: random, cross_scale, cross_interaction, cross_scale_interaction"
    )


class SplitParameters(ModelsParameters):
    """One split, on which all models are trained."""

    split: SplitName


def plan(inputs: StageInputs, parameters: TrainingParameters) -> list[Shard]:
    """Plan one shard per split; held-out takes are never trained on, and of people other than two none is used."""
    variants = [manifest for manifest in inputs.of("variants") if manifest.facts.get("num_persons") == 2]
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
            parameters=SplitParameters(
                split=split,
                models=tuple(sorted(parameters.models)),
                test_takes=tuple(sorted(parameters.test_takes)),
            ),
            inputs=named_refs(takes=takes, variants=variants),
            seed=inputs.seed,
        )
        for split in parameters.splits
    ]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Train every model of a split.

    Raises:
        InputError: The split has no training or no test variant.
    """
    parameters = shard.options(SplitParameters)
    split_name = parameters.split
    takes = {store.manifest(ref).facts["take_id"]: read_take(store, ref) for ref in shard.refs("takes")}
    homes: dict[tuple[str, str], ArtifactRef] = {}
    keys: list[VariantKey] = []
    held_out: set[str] = set()
    for ref in shard.refs("variants"):
        facts = store.manifest(ref).facts
        table = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "verdict"])
        if facts["is_held_out"]:
            held_out.add(facts["take_id"])
        for row, variant_id in enumerate(table["variant_id"]):
            if table["verdict"][row] != "fail":
                keys.append(VariantKey(facts["take_id"], str(variant_id), table["bone_scale"][row].reshape(2, -1)))
            homes[facts["take_id"], str(variant_id)] = ref
    test_takes = sorted(held_out | set(parameters.test_takes))
    split = make_split(split_name, keys, stream(shard.seed, "training", split_name), test_takes=test_takes)

    def items() -> Iterator[TrainingItem]:
        return read_items(store, split.train, homes, takes)

    models: dict[str, list] = {"split": [], "model": [], "array_name": [], "array_shape": [], "values": []}
    log: dict[str, list] = {"split": [], "model": [], "step": [], "quantity": [], "value": []}
    trained: dict[str, VariantModel] = {}
    for name in parameters.models:
        model, entries = model_class(name).train(items)
        trained[name] = model
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
            "models": list(parameters.models),
            "takes": split.train_takes,
            "shares_takes": split.shares_takes,
            "train": _by_take(split.train),
            "test": _by_take(split.test),
        },
        verdict=_judge(trained, read_items(store, split.test[:: -(-len(split.test) // _JUDGED)], homes, takes)),
    )


def _judge(trained: Mapping[str, VariantModel], items: Iterator[TrainingItem]) -> Verdict:
    """Return whether the best model is better than giving the source back, over test variants.

    No split keeps variants for validation, so of several trained models the best is chosen by the very figure that is
    given of it; the verdict says so.
    """
    errors: dict[str, list[float]] = {name: [] for name in trained}
    copied: list[float] = []
    for item in items:
        copied.append(model_errors(item.request.source.positions_m, item.motion_m)["E_r"])
        for name, model in trained.items():
            errors[name].append(model_errors(model.predict(item.request), item.motion_m)["E_r"])
    means = {name: float(np.mean(found)) for name, found in errors.items()}
    learned = [name for name in means if name not in BASELINES]
    best = min(learned or means, key=lambda name: means[name])
    baseline = float(np.mean(copied))
    is_good = best not in BASELINES and means[best] < baseline
    return Verdict(
        Level.PASS if is_good else Level.WARN,
        "" if is_good else f"no trained model is better than copying the source on the test set (best: {best})",
        figure=f"test error of {best}" + (f", the best of {len(learned)} there" if len(learned) > 1 else ""),
        value=means[best],
        unit="cm",
        baseline=baseline,
        baseline_name="copy of the source",
    )


def read_items(
    store: Store,
    keys: Sequence[VariantKey],
    homes: dict[tuple[str, str], ArtifactRef],
    takes: dict[str, TakeMotion],
) -> Iterator[TrainingItem]:
    """Read variants one at a time, artifact by artifact; `homes` says where each (take, variant) lies."""
    wanted: dict[ArtifactRef, dict[str, VariantKey]] = {}
    for key in keys:
        wanted.setdefault(homes[key.take_id, key.variant_id], {})[key.variant_id] = key
    for ref, by_name in wanted.items():
        offset = 0
        sizes = store.read(ref, "variant_quality", columns=["variant_id", "num_frames"])
        for name, frames in zip(sizes["variant_id"], sizes["num_frames"], strict=True):
            rows = slice(offset, offset + 2 * int(frames))
            offset = rows.stop
            if str(name) not in by_name:
                continue
            key = by_name[str(name)]
            motion = store.read(ref, "variants", columns=["body22_m"], rows=rows)["body22_m"].astype(np.float64)
            request = VariantRequest(key.take_id, takes[key.take_id].source, key.bone_scale)
            yield TrainingItem(key.variant_id, request, motion.reshape(-1, 2, *motion.shape[1:]))


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
    needs="variants ([augmentation] of takes of two people)",
)
