"""Shards of the stage `training`: one segment of one model's training on one split."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.evaluation.verdicts import Items, compare
from pasdedeux.learning.model import Arrays, LogEntry, Trained, Training, TrainingItem, VariantModel
from pasdedeux.learning.registry import (
    BASELINES,
    ModelDescription,
    describe_model,
    load_model,
    model_arrays,
    model_class,
)
from pasdedeux.learning.settings import has_torch
from pasdedeux.learning.splits import VariantKey
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Shard
from tasks.stage.committing import commit, followed
from tasks.stage.facts import ModelFacts
from tasks.stage.streams import stream
from tasks.training.items import StoredVariants, frame_errors
from tasks.training.parameters import TrainingSegmentParameters
from tasks.training.plan import split_variants

_JUDGED = 24
"""Validation variants that the verdict looks at, spread evenly."""


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Train one segment of a model and commit its result: the model after the last segment, a state after the others.

    Raises:
        InputError: Every variant to train on failed, training came to numbers that are not finite, or torch is missing.
    """
    options = shard.options(TrainingSegmentParameters)
    kind = model_class(options.model)
    if kind.needs_torch:
        refuse_without_torch(options.name, "training.models=MODELS, with those that need none")
    takes, variants_of = ([store.manifest(ref) for ref in shard.refs(name)] for name in ("takes", "variants"))
    split = split_variants(options.split, takes, variants_of, options.test_takes, shard.seed)
    refs = shard.refs("takes"), shard.refs("variants")
    variants = StoredVariants(store, *refs, options.skeleton, rejected=options.rejected)
    train, validation = variants.sound(split.train), variants.sound(split.validation)
    if not train and kind.is_trained:
        raise InputError(
            f"split '{options.split}': every variant that it would learn from failed or is rejected "
            f"({len(split.train)})"
        )
    done = {"models": None, "model_states": None} | {
        next(name for name in ("models", "model_states") if name in segment.tables): segment
        for segment in followed(shard, store)
    }
    before, start = done["model_states"], done["models"]
    again = [options.seed] if options.seed else []
    trained = kind.train(
        Training(
            items=_reader(variants, train),
            validation=_reader(variants, validation),
            settings=options.settings,
            generator=stream(shard.seed, "training", options.split, options.model, options.segment, *again),
            segment=options.segment,
            state={} if before is None else read_arrays(store, before.ref, "model_states"),
            start=None if start is None else load_stored(store, start),
            device=options.device,
        )
    )
    log = [
        *trained.log,
        LogEntry(0, "num_train", len(train)),
        LogEntry(0, "num_validation", len(validation)),
        LogEntry(0, "num_test", len(split.test)),
    ]
    is_last = options.segment == kind.num_segments(options.settings) - 1
    arrays = model_arrays(trained.model) if is_last else trained.state
    judged = validation[:: -(-len(validation) // _JUDGED) or 1]
    return commit(
        shard,
        store,
        tables={
            "models" if is_last else "model_states": _array_rows(options, arrays),
            "training_log": _log_rows(options, log if options.segment == 0 else trained.log),
        },
        facts=ModelFacts(
            kind="model" if is_last else "model_state",
            split=options.split,
            model=options.name,
            class_name=options.model,
            **({"description": describe_model(trained.model).model_dump(mode="json")} if is_last else {}),
            skeleton=options.skeleton,
            device=trained.device,
            segment=options.segment,
            takes=tuple(sorted({key.take_id for key in train})),
            shares_takes=split.shares_takes,
            train=_by_take(train),
            validation=_by_take(validation),
            test=_by_take(split.test),
        ),
        verdict=_judge(options.name, trained, _reader(variants, judged)) if is_last else None,
    )


def read_arrays(store: Store, ref: ArtifactRef, table: str = "models") -> dict[str, np.ndarray]:
    """Return the arrays of a stored model, or of the segment that its training continues."""
    rows = store.read(ref, table)
    return {
        str(name): np.asarray(rows["values"][row], dtype=str(rows["array_dtype"][row])).reshape(
            rows["array_shape"][row]
        )
        for row, name in enumerate(rows["array_name"])
    }


def load_stored(store: Store, manifest: Manifest) -> VariantModel:
    """Return the model that an artifact holds.

    Raises:
        InputError: It needs torch, which is not installed, or it was stored by a version that did not describe models.
    """
    facts = ModelFacts.of(manifest)
    if facts.description is None:
        raise InputError(f"model '{facts.model}' was stored by an older version; train it again")
    return load_model(ModelDescription.model_validate(facts.description), read_arrays(store, manifest.ref))


def refuse_without_torch(who: str, instead: str) -> None:
    """Refuse to run a shard that needs torch without it; InputError with the setting that goes without."""
    if not has_torch():
        raise InputError(
            f"{who} needs torch, which is not installed where this ran: pip install 'pasdedeux[learning]', "
            f"or go without: --set {instead}"
        )


def _reader(variants: StoredVariants, keys: Sequence[VariantKey]) -> Callable[[], Iterator[TrainingItem]]:
    return lambda: variants.items([(key.take_id, key.variant_id) for key in keys])


def _judge(name: str, trained: Trained, items: Callable[[], Iterator[TrainingItem]]) -> Verdict:
    """Judge whether a model is better than every baseline over validation variants; the test set is not used.

    A baseline is not judged.  A network with a dead layer fails whatever its error.
    """
    if name in BASELINES:
        return Verdict(Level.PASS)
    if dead := [f"{entry.quantity} {entry.value:.2g} %" for entry in trained.log if entry.is_dead_layer]:
        return Verdict(Level.FAIL, f"{name} has dead layers, so part of it learned nothing: {', '.join(dead)}")
    models = {name: trained.model} | {
        baseline: load_model(ModelDescription(model=baseline), {}) for baseline in BASELINES
    }
    parts: list[Items] = []
    for item in items():
        parts.append(frame_errors(item, {name: model.predict(item.request) for name, model in models.items()}))
    paired = Items.joined(parts).paired([name], BASELINES)
    if paired is None:
        return Verdict(Level.WARN, "no variant is left for validation, so nothing is said of the model")
    return compare(paired, "joint error of validation variants", "cm", "variants")


def _by_take(keys: Sequence[VariantKey]) -> dict[str, tuple[str, ...]]:
    by_take: dict[str, tuple[str, ...]] = {}
    for key in keys:
        by_take[key.take_id] = (*by_take.get(key.take_id, ()), key.variant_id)
    return by_take


def _array_rows(options: TrainingSegmentParameters, arrays: Arrays) -> dict[str, list[Any]]:
    names, count = sorted(arrays), len(arrays)
    return {
        "split": [options.split] * count,
        "model": [options.name] * count,
        "array_name": names,
        "array_shape": [np.array(arrays[name].shape, np.int32) for name in names],
        "array_dtype": [arrays[name].dtype.name for name in names],
        "values": [arrays[name].ravel() for name in names],
    }


def _log_rows(options: TrainingSegmentParameters, log: Sequence[LogEntry]) -> dict[str, list[Any]]:
    ordered = sorted(log, key=lambda entry: (entry.step, entry.quantity))
    return {
        "split": [options.split] * len(ordered),
        "model": [options.name] * len(ordered),
        "step": [entry.step for entry in ordered],
        "quantity": [entry.quantity for entry in ordered],
        "value": [float(entry.value) for entry in ordered],
    }
