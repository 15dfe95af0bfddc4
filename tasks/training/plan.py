"""Planning of the stage `training`: for each split and model the segments of its training, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pasdedeux.errors import InputError
from pasdedeux.learning.registry import model_class
from pasdedeux.learning.splits import Split, VariantKey, make_split
from storage_schema import Manifest
from tasks.augmentation import planned_variations, variations
from tasks.files.curation import rejections
from tasks.stage import Shard, StageInputs, StageName
from tasks.stage.facts import TakeFacts, VariantFacts
from tasks.stage.streams import stream
from tasks.training.items import interactions_of
from tasks.training.parameters import TrainingParameters, TrainingSegmentParameters

TRAINING = StageName("training", 14)


def plan(inputs: StageInputs, parameters: TrainingParameters) -> list[Shard]:
    """Plan the segments of every model on every split; nothing is learned from takes that are held out or no pair.

    Adding a model or a split computes that one alone. The plan does not depend on installed packages.

    Raises:
        InputError: A split leaves nothing to train on, or nothing to test on.
    """
    variants = [manifest for manifest in inputs.of("variants") if VariantFacts.of(manifest).num_persons == 2]
    if not variants:
        return []
    used = {VariantFacts.of(manifest).take_id for manifest in variants}
    takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).take_id in used]
    test_takes = tuple(sorted(parameters.test_takes))
    _check_test_takes(test_takes, used)
    shards: list[Shard] = []
    rejected = rejections(parameters.choices, "variants")
    rejected = {name: content for name, content in rejected.items() if name.partition("/")[0] in used}
    models = parameters.named()
    for name in dict.fromkeys(split for model in models.values() for split in model.section.splits):
        split_variants(name, takes, variants, test_takes, inputs.seed)
        last: dict[str, str] = {}
        for model, (kind, settings, start, section, seed) in models.items():
            if name not in section.splits or (start is not None and start not in last):
                continue
            before: tuple[str, ...] = ()
            num_segments = model_class(kind).num_segments(settings)
            for segment in range(num_segments):
                shard = TRAINING.shard(
                    inputs,
                    name,
                    model if num_segments == 1 else f"{model}-segment{segment}",
                    TrainingSegmentParameters(
                        split=name,
                        test_takes=test_takes,
                        name=model,
                        model=kind,
                        settings=settings,
                        segment=segment,
                        skeleton=section.skeleton,
                        seed=seed,
                        device=section.device,
                        rejected=rejected,
                    ),
                    {"takes": takes, "variants": variants},
                    after=before + ((last[start],) if start is not None else ()),
                )
                before = (shard.key,)
                shards.append(shard)
            last[model] = shards[-1].key
    return shards


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse impossible models, and splits that, by the other sections, leave nothing to train or test on.

    Only takes of two people count; where a study has none, there is nothing to split.

    Raises:
        InputError: As `TrainingParameters.named`; a split leaves nothing to train on, or nothing to test on, or a test
            take is no take of a pair.
    """
    parameters: TrainingParameters = sections["training"]
    models = parameters.named().values()
    if "ingest" not in sections or "augmentation" not in sections:
        return
    if any(family.takes is None for family in sections["ingest"].pairs.values()):
        return  # files of the folder are known only when it is read
    ingest = sections["ingest"]
    duets = {duet.take_id: duet.name for duet in ingest.resolved_duets()}
    takes = [take_id for take_id, count in ingest.num_people().items() if count == 2]
    known = [variation for part in variations(sections["augmentation"], 2).values() for variation in part]
    keys = [
        VariantKey(take_id, variation.variant_id, variation.bone_scale, duets.get(take_id, ""))
        for take_id in takes
        for variation in known
    ]
    if keys:
        _check_test_takes(parameters.test_takes, takes)
    for name in {split for model in models for split in model.section.splits} if keys else ():
        make_split(name, keys, stream(0, name), test_takes=parameters.test_takes, held_out=ingest.held_out)


def split_variants(
    name: str, takes: Iterable[Manifest], variants: Iterable[Manifest], test_takes: Sequence[str], seed: int
) -> Split:
    """Split variants as they were planned; manifests do not tell which of them failed.

    Raises:
        InputError: The training or the test set is empty.
    """
    interactions = interactions_of(takes)
    keys: list[VariantKey] = []
    held_out: set[str] = set()
    for manifest in variants:
        facts = VariantFacts.of(manifest)
        keys += [
            VariantKey(facts.take_id, variation.variant_id, variation.bone_scale, interactions.get(facts.take_id, ""))
            for variation in planned_variations(manifest)
        ]
        if facts.is_held_out:
            held_out.add(facts.take_id)
    return make_split(name, keys, stream(seed, "training", name), test_takes=test_takes, held_out=sorted(held_out))


def _check_test_takes(test_takes: Sequence[str], takes: Iterable[str]) -> None:
    for take_id in test_takes:
        if take_id not in takes:
            raise InputError(
                f"training.test_takes: '{take_id}' is no take of two people with variants; there are: "
                + (", ".join(sorted(takes)) or "none")
            )
