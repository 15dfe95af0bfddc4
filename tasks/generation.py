"""Stage `generation`: new bodies and their motion, sampled from a trained model, as more variants of every pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pasdedeux.augmentation import Variant
from pasdedeux.augmentation.variations import Scale
from pasdedeux.errors import InputError, named
from pasdedeux.learning.key_frames import KeyFrames, read_key_frames
from pasdedeux.learning.model import VariantModel
from pasdedeux.learning.registry import model_class
from pasdedeux.learning.sampling import VariantSampler
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Manifest, Store
from tasks.augmentation import BatchParameters, write_variants
from tasks.ingest.files import load_file, read_again
from tasks.rows.takes import read_take
from tasks.stage import Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.facts import ModelFacts, TakeFacts, VariantFacts, VariantOrigin
from tasks.stage.streams import stream
from tasks.stage.sweep import SweptParameters
from tasks.training.run import load_stored, refuse_without_torch

GENERATION = StageName("generation", 1)

_PER_SHARD = 8
"""Variants of a take in one unit of work."""


class GenerationParameters(SweptParameters):
    """A model to sample from, and the number of samples; `sweep` names others."""

    model: str = Field(
        "", description="Trained model by the name it is kept under, or NAME@SPLIT; nothing is generated without one"
    )
    num_variants: int = Field(8, ge=1, le=10_000, description="Variants of each take")
    scales: tuple[Scale, ...] = Field(
        (), description="Scales of all of B's bones, in turn; drawn from the model's prior p(B_s) where not given"
    )
    key_frames: dict[str, Path] = Field(
        {}, description="By take a JSON file of poses that B goes through: `frames`, and `body22_m` in metres"
    )


class SampledParameters(Parameters):
    """Some of the variants of one take."""

    model: str
    split: str
    first: int
    count: int
    scales: tuple[float, ...]


def plan(inputs: StageInputs, parameters: GenerationParameters) -> list[Shard]:
    """Plan one shard per model, take of two people and block of variants; none without a model.

    Raises:
        InputError: No model or several models have the name, its skeleton is another one, or key frames name no take or
            lie outside it.
    """
    sections = (parameters, *parameters.swept().values())
    return [shard for section in sections for shard in _plan_model(inputs, section)]


def _plan_model(inputs: StageInputs, parameters: GenerationParameters) -> list[Shard]:
    name, _, split = parameters.model.partition("@")
    if not name:
        return []
    model = _model_named(inputs, parameters.model, name, split)
    facts = ModelFacts.of(model)
    takes = {TakeFacts.of(take).take_id: take for take in inputs.of("poses") if TakeFacts.of(take).num_persons == 2}
    keys = {take_id: load_file(path) for take_id, path in parameters.key_frames.items()}
    for take_id, loaded in keys.items():
        if take_id not in takes:
            raise InputError(
                f"generation.key_frames: '{take_id}' is no take of two people; takes: {', '.join(sorted(takes))}"
            )
        with named(f"generation.key_frames.{take_id}"):
            key_frames = read_key_frames(loaded.data, Path(loaded.file.path).name)
            key_frames.check(f"take {take_id}", TakeFacts.of(takes[take_id]).num_frames, BODY22)
    return [
        GENERATION.shard(
            inputs,
            take_id,
            f"{parameters.model} {first} to {first + count - 1}",
            SampledParameters(model=facts.model, split=facts.split, first=first, count=count, scales=parameters.scales),
            {"take": [take], "model": [model]},
            files=[keys[take_id].file] if take_id in keys else (),
        )
        for take_id, take in takes.items()
        for first in range(0, parameters.num_variants, _PER_SHARD)
        for count in [min(_PER_SHARD, parameters.num_variants - first)]
    ]


def _model_named(inputs: StageInputs, text: str, name: str, split: str) -> Manifest:
    models = [(ModelFacts.of(manifest), manifest) for manifest in inputs.of("models")]
    named = [(facts, manifest) for facts, manifest in models if facts.model == name and split in ("", facts.split)]
    if len(named) != 1:
        there = ", ".join(sorted(f"{facts.model}@{facts.split}" for facts, _ in models)) or "none"
        raise InputError(f"generation.model: '{text}' names {len(named)} trained models, not one; there are: {there}")
    facts, model = named[0]
    if facts.skeleton != BODY22.name:
        raise InputError(
            f"generation.model: '{text}' is of {facts.skeleton}; generated motion is cleaned up on {BODY22.name}, so "
            f"a model of {BODY22.name} is needed"
        )
    return model


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse a model that the study does not train or that lacks a requested ability, and invalid key frames.

    Raises:
        InputError: Names the key and the allowed values.
    """
    first: GenerationParameters = sections["generation"]
    for section in (first, *first.swept().values()):
        _check_model(section, sections)


def _check_model(parameters: GenerationParameters, sections: Mapping[str, Any]) -> None:
    name = parameters.model.partition("@")[0]
    for take_id, path in parameters.key_frames.items():
        with named(f"generation.key_frames.{take_id}"):
            read_key_frames(load_file(path).data, path.name)
    if not name or "training" not in sections:
        return
    known = sections["training"].named()
    if name not in known:
        raise InputError(f"generation.model: '{name}' is not trained here; trained are {', '.join(sorted(known))}")
    kind = model_class(known[name].kind)
    if not (parameters.scales or parameters.key_frames or draws_bodies(kind)):
        raise InputError(f"generation.scales: '{name}' draws no bodies, so scales must be given, such as [0.9, 1.1]")
    if parameters.key_frames and not kind.takes_key_frames:
        raise InputError(f"generation.key_frames: '{name}' takes no key frames: it gives A's motion for no motion of B")


def draws_bodies(kind: type[VariantModel]) -> bool:
    """Tell whether a model has a p(B_s)."""
    return kind.generate is not VariantModel.generate


def sampling_stream(seed: int, take_id: str, index: int) -> np.random.Generator:
    """Return the random generator of one variant: the command and the stage draw the same for the same seed."""
    return stream(seed, "generation", take_id, index)


def variant_name(model: str, index: int) -> str:
    """Return the name of a variant.

    >>> variant_name("paper_cvae", 3)
    'B-paper_cvae-0003'
    """
    return f"B-{model}-{index:04d}"


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Sample variants of one take and stream them to the store."""
    options = shard.options(SampledParameters)
    manifest, stored = store.manifest(shard.ref("take")), store.manifest(shard.ref("model"))
    facts, learned = TakeFacts.of(manifest), ModelFacts.of(stored)
    if model_class(learned.class_name).needs_torch:
        refuse_without_torch(options.model, "generation.model=")
    take, take_id = read_take(store, manifest.ref), facts.take_id
    keys: KeyFrames | None = None
    for file in shard.files:
        keys = read_key_frames(read_again(file), Path(file.path).name)
    indices = range(options.first, options.first + options.count)
    names = tuple(variant_name(options.model, index) for index in indices)
    facts_of_variants = VariantFacts(
        takes=tuple(sorted({take_id, *learned.takes})),
        take_id=take_id,
        variants=names,
        num_persons=facts.num_persons,
        num_frames=take.source.num_frames,
        rate_hz=take.source.rate_hz,
        is_held_out=facts.is_held_out,
        closest_m=take.source.closest_m,
        parameters=BatchParameters(contacts=facts.contacts, variants=names).model_dump(mode="json", exclude={"limits"}),
        origin=VariantOrigin(
            model=options.model,
            split=options.split,
            artifact=stored.ref.key,
            segment=learned.segment,
            seed=shard.seed,
        ),
    )

    def sample() -> Iterator[Variant]:
        model = load_stored(store, stored)
        sampler = VariantSampler(model, take.source, take_id=take_id, contacts=facts.contacts, key_frames=keys)
        for index, name in zip(indices, names, strict=True):
            scale = np.full(BODY22.num_joints, options.scales[index % len(options.scales)]) if options.scales else None
            yield sampler.sample(name, sampling_stream(shard.seed, take_id, index), scale)

    return write_variants(shard, store, take, facts_of_variants, sample(), timing="sample_s")


STAGE = Stage(
    *GENERATION,
    reads=("models", "takes", "poses"),
    writes=(),
    adds_to=("variants", "variant_quality", "variant_frames"),
    parameters=GenerationParameters,
    plan=plan,
    run_shard=run_shard,
    check_study=check_study,
    meaning="Variants of every pair for bodies that a trained model draws, cleaned by the interaction mesh",
    needs="a trained model (generation.model) and takes of two people",
)
