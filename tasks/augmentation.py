"""Stage `augmentation`: solve every take for other body proportions, keeping contacts, and measure each variant."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from pasdedeux.augmentation import (
    AugmentationSettings,
    Augmenter,
    UserContact,
    Variant,
    VariationSettings,
    make_variations,
    variant_rotations,
)
from pasdedeux.augmentation.variations import Variation
from pasdedeux.errors import InputError
from pasdedeux.evaluation.verdicts import merge_verdicts
from pasdedeux.figure import LEVELS
from pasdedeux.settings import first_problem
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from storage_schema.artifact_writer import ArtifactWriter
from tasks.rows.takes import TakeMotion, read_take
from tasks.stage import EarlyPlan, Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import artifact_fields, commit
from tasks.stage.facts import PeopleFacts, SkippedFacts, TakeFacts, VariantFacts
from tasks.stage.judgements import VERDICT_FACT
from tasks.stage.sweep import SweptParameters

AUGMENTATION = StageName("augmentation", 24)

_SOLVED_TOGETHER, _OF_LONG_TAKES = 32, 16
"""Variants solved in one batch: a few dozen columns fill the matrix products."""
_LONG_FRAMES = 600
"""Longer takes have fewer variants in a batch, because memory grows with both."""


class SolvedParameters(VariationSettings, AugmentationSettings, Parameters):
    """Settings shared by a study's section and a batch of variants: which variants are made, and how."""


class AugmentationParameters(SolvedParameters, SweptParameters):
    """Which variants are made, and how; each sweep makes more of them."""

    contacts: dict[str, tuple[UserContact, ...]] = Field(
        {}, description="Contacts stated by take, in place of what is found between their bones, and of the take's own"
    )


_PER_SHARD = 32
"""Variants of a take in one unit of work."""

_OF_THE_PLAN = {"contacts", "sweep"}


class BatchParameters(SolvedParameters):
    """A batch of variants of one take."""

    contacts: tuple[UserContact, ...]
    variants: tuple[str, ...]


class NobodyParameters(Parameters):
    """A take that is skipped because it has none of the people to be scaled."""

    persons: tuple[str, ...]
    num_persons: int


def plan(inputs: StageInputs, parameters: AugmentationParameters) -> list[Shard]:
    """Plan one shard per take and batch of variants; a take with none of the requested people gets one that says so."""
    takes = {TakeFacts.of(take).take_id: take for take in inputs.of("poses")}
    _check_takes(parameters, takes)
    sections = {"": parameters, **parameters.swept()}
    shards = []
    for take_id, take in takes.items():
        by_name = variations(parameters, TakeFacts.of(take).num_persons)
        if not any(by_name.values()):
            asked = tuple(sorted({who for section in sections.values() for who in section.persons}))
            nobody = NobodyParameters(persons=asked, num_persons=TakeFacts.of(take).num_persons)
            shards.append(AUGMENTATION.shard(inputs, take_id, "nobody", nobody, {"take": [take]}))
        for name, section in sections.items():
            stated = section.contacts.get(take_id, TakeFacts.of(take).contacts)
            for start in range(0, len(by_name[name]), _PER_SHARD):
                batch = tuple(variation.variant_id for variation in by_name[name][start : start + _PER_SHARD])
                solved = BatchParameters(**section.model_dump(exclude=_OF_THE_PLAN), contacts=stated, variants=batch)
                shards.append(
                    AUGMENTATION.shard(inputs, take_id, f"{batch[0]} to {batch[-1]}", solved, {"take": [take]})
                )
    return shards


def variations(parameters: AugmentationParameters, num_people: int) -> dict[str, list[Variation]]:
    """Return the variations of a take with this number of people by sweep; those of no sweep come first.

    Raises:
        InputError: Two sweeps make the same variant, so its name would not tell how it was solved.
    """
    by_take: dict[str, list[Variation]] = {}
    by_id: dict[str, str] = {}
    for name, section in {"": parameters, **parameters.swept()}.items():
        by_take[name] = make_variations(section, num_people)
        for variation in by_take[name]:
            if (other := by_id.setdefault(variation.variant_id, name)) != name:
                raise InputError(
                    f"augmentation.sweep.{name} makes {variation.variant_id}, which "
                    f"{f'augmentation.sweep.{other}' if other else 'augmentation itself'} makes too; a sweep changes "
                    "kinds, persons, groups or scales"
                )
    return by_take


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse two sweeps of one variant, and contacts of a take that the `ingest` section does not have.

    Raises:
        InputError: Names the variant, or the take.
    """
    ingest = sections.get("ingest")
    variations(sections["augmentation"], 2)
    if ingest is not None and all(family.takes is not None for family in ingest.pairs.values()):
        _check_takes(sections["augmentation"], ingest.take_ids())


def _check_takes(parameters: AugmentationParameters, takes: Collection[str]) -> None:
    for take_id in parameters.contacts:
        if take_id not in takes:
            raise InputError(f"augmentation.contacts: take '{take_id}' is not there; takes: {', '.join(sorted(takes))}")


def batch_of(manifest: Manifest) -> BatchParameters:
    """Return the parameters of a batch of variants, but for the limits of its verdicts.

    Settings of earlier versions that are now constants are ignored.

    Raises:
        InputError: They are not allowed any more: names the setting.
    """
    try:
        return BatchParameters.model_validate(VariantFacts.of(manifest).parameters, extra="ignore")
    except ValidationError as error:
        raise InputError(
            f"variants of take '{manifest.partition}' were made by an earlier version and cannot be read: "
            f"augmentation.{first_problem(error)}; run the study again"
        ) from None


def solver_variants(inputs: StageInputs) -> list[Manifest]:
    """Return the batches of variants made by the solver, without those sampled from a model."""
    return [manifest for manifest in inputs.of("variants") if VariantFacts.of(manifest).origin is None]


def planned_variations(manifest: Manifest) -> list[Variation]:
    """Return the variations of a batch of variants, from its manifest alone; no data is read."""
    batch = batch_of(manifest)
    known = _variations(manifest, batch)
    return [variation for variation in known if variation.variant_id in set(batch.variants)]


def _variations(take: Manifest, settings: VariationSettings) -> list[Variation]:
    return make_variations(settings, PeopleFacts.of(take).num_persons)


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Solve a batch of variants of one take, or say why the take has none."""
    if isinstance(shard.parameters, NobodyParameters):
        count = shard.parameters.num_persons
        who = "one person" if count == 1 else f"{count} people"
        reason = f"{who}, and nobody of those who are scaled: {', '.join(shard.parameters.persons)}"
        skipped = (f"No variants of take {shard.partition}: {reason}.",)
        facts = SkippedFacts(kind="nobody", takes=(shard.partition,), skipped=skipped)
        return commit(shard, store, tables={}, facts=facts, verdict=Verdict(Level.WARN, reason))
    return _solve_batch(shard, shard.options(BatchParameters), store)


def _solve_batch(shard: Shard, parameters: BatchParameters, store: Store) -> ArtifactRef:
    """Solve a batch of variants and stream them to the store."""
    manifest = store.manifest(shard.ref("take"))
    take_id = TakeFacts.of(manifest).take_id
    known = {v.variant_id: v for v in _variations(manifest, parameters)}
    take = read_take(store, manifest.ref)
    facts = VariantFacts(
        takes=(take_id,),
        take_id=take_id,
        variants=parameters.variants,
        num_persons=take.source.num_people,
        num_frames=take.source.num_frames,
        rate_hz=take.source.rate_hz,
        is_held_out=TakeFacts.of(manifest).is_held_out,
        closest_m=take.source.closest_m,
        # Readers of variants solve more of them, so the settings count as content even if the bytes are equal.
        parameters=parameters.model_dump(mode="json", exclude={"limits"}),
    )
    together = _OF_LONG_TAKES if take.source.num_frames > _LONG_FRAMES else _SOLVED_TOGETHER

    def solve() -> Iterator[Variant]:
        augmenter = Augmenter(take.source, parameters, user_contacts=parameters.contacts)
        for start in range(0, len(parameters.variants), together):
            yield from augmenter.solve([known[name] for name in parameters.variants[start : start + together]])

    return write_variants(shard, store, take, facts, solve(), timing="solve_s")


def write_variants(
    shard: Shard, store: Store, take: TakeMotion, facts: VariantFacts, variants: Iterable[Variant], *, timing: str
) -> ArtifactRef:
    """Stream variants to the store as they are made, and commit them with one verdict and the time they took."""
    verdicts, started = [], time.monotonic()
    with store.writer(**artifact_fields(shard, store), facts=facts.to_json()) as writer:
        for variant in variants:
            verdicts.append(variant.verdict)
            _write_variant(writer, facts.take_id, take, variant)
        summary = merge_verdicts(verdicts)
        assert summary is not None
        writer.facts[VERDICT_FACT] = summary.to_json()
        writer.timings[timing] = time.monotonic() - started
    return writer.ref


def _write_variant(writer: ArtifactWriter, take_id: str, take: TakeMotion, variant: Variant) -> None:
    """Write the rows of one variant, of the solver or of a model."""
    frames, people = take.source.num_frames, take.source.num_people
    name = variant.variation.variant_id
    rotations = variant_rotations(take.rest_m, variant.bone_scale, variant.positions_m, take.world_unitquat)
    place = {"take_id": [take_id] * frames, "variant_id": [name] * frames, "frame": np.arange(frames, dtype=np.int32)}
    everybody: dict[str, Any] = {
        column: np.repeat(np.array(values), people) for column, values in {**place, "time_s": take.time_s}.items()
    }
    everybody["person"] = np.tile(np.arange(people, dtype=np.int32), frames)
    everybody["body22_m"] = variant.positions_m.reshape(-1, *variant.positions_m.shape[2:])
    everybody["body22_unitquat"] = rotations.reshape(-1, *rotations.shape[2:])
    writer.append("variants", everybody)
    levels = [LEVELS[past].value for past in variant.frame_verdicts]
    writer.append("variant_frames", place | vars(variant.frames) | {"verdict": levels})
    row: dict[str, Any] = {
        "take_id": take_id,
        "variant_id": name,
        "bone_scale": variant.bone_scale.ravel(),
        "uniform_scale": np.array([variant.variation.uniform_scale(person) for person in range(people)]),
        "num_frames": frames,
        **vars(variant.quality),
        "estimated_gap_m": variant.estimated_gap_m,
        "num_iterations": variant.num_iterations,
        "solver": variant.solver,
        "num_warn_frames": int((variant.frame_verdicts == 1).sum()),
        "num_fail_frames": int((variant.frame_verdicts == 2).sum()),
        "verdict": variant.verdict.level.value,
        "reason": variant.verdict.reason,
    }
    writer.append("variant_quality", {column: _one_row(value) for column, value in row.items()})


def _one_row(value: Any) -> Any:
    return value[None] if isinstance(value, np.ndarray) else [value]


STAGE = Stage(
    *AUGMENTATION,
    reads=("takes", "poses"),
    writes=("variants", "variant_quality", "variant_frames"),
    parameters=AugmentationParameters,
    plan=plan,
    run_shard=run_shard,
    check_study=check_study,
    meaning="Variants of every take for other body proportions, by interaction mesh with exact bone lengths",
    needs="takes ([[ingest.takes]], [ingest.pairs])",
    early=(EarlyPlan(plan, each=("poses",)),),
)
