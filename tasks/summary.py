"""Summary of a run from its manifests: products, sources and verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter

from pasdedeux.evaluation.summary import Credit, Made, Summary, folded
from pasdedeux.evaluation.verdicts import NamedVerdict, merge_verdicts, part_name
from pasdedeux.plain_text import counted
from pasdedeux.verdict import Verdict
from storage_schema import Manifest
from tasks.rows.draw_sets import is_chain
from tasks.stage.facts import (
    DrawFacts,
    Facts,
    LiftedFacts,
    ModelFacts,
    PeopleFacts,
    SeedFacts,
    SequenceFacts,
    TakeFacts,
    VariantFacts,
    facts_of,
)
from tasks.stage.judgements import verdict_of, verdicts_of_parts

_APART = "evaluation"
"""The stage whose partitions, topics, are judged one by one."""


@dataclass(frozen=True)
class _Thing:
    """A product that is counted by rows or artifacts: name, table, topics that judge it, and the artifacts with it."""

    name: str
    table: str
    is_artifact: bool = False
    topics: tuple[str, ...] = ()
    is_in: Callable[[Manifest], bool] = lambda _: True


_THINGS = (
    _Thing("takes", "poses", is_artifact=True),
    _Thing("annotations", "annotations"),
    _Thing("seeds", "seeds"),
    _Thing("draws", "draws", topics=("coverage", "leave one out"), is_in=is_chain),
    _Thing("repaired pairs", "draws", is_in=lambda manifest: not is_chain(manifest)),
    _Thing("lifted pairs", "lifted_pairs", topics=("lifting",)),
    _Thing("database poses", "projections"),
    _Thing("reconstructed sequences", "motions", is_artifact=True, topics=("reconstruction",)),
    _Thing("variants", "variant_quality", topics=("augmentation",)),
    _Thing("models", "models", is_artifact=True, topics=("models",)),
)


def summary_of(manifests: Sequence[Manifest]) -> Summary:
    """Return the summary of these artifacts; the same artifacts in any order give the same."""
    in_order = sorted(manifests, key=lambda manifest: (manifest.ref.stage, manifest.partition, manifest.name))
    stated = [(manifest, facts_of(manifest)) for manifest in in_order]
    parts = {
        thing: [
            (manifest, facts) for manifest, facts in stated if thing.table in manifest.tables and thing.is_in(manifest)
        ]
        for thing in _THINGS
    }
    chains = stage_verdict(manifest for manifest in in_order if "chain_info" in manifest.tables)
    verdicts = dict(sorted(_by_stage(in_order).items(), key=lambda named: -named[1].level.rank))
    sources = {Credit(s.name, s.licence, s.credit) for s in {s for manifest in in_order for s in manifest.sources}}
    return Summary(
        made=[product for thing, of_thing in parts.items() if (product := _made(thing, of_thing, chains)).count],
        sources=sorted(sources, key=lambda source: (source.name, source.licence, source.credit)),
        skipped=folded(sorted({sentence for manifest, facts in stated for sentence in _skipped(manifest, facts)})),
        verdicts=verdicts,
    )


def product_verdicts(manifests: Sequence[Manifest]) -> list[str]:
    """Return the names of the verdicts on the things among these artifacts: of their stages, and of their topics."""
    products = [(manifest, thing) for thing in _THINGS for manifest in manifests if thing.table in manifest.tables]
    stages = {manifest.ref.stage for manifest, _ in products}
    topics = tuple(part_name(_APART, f"{topic} ") for _, thing in products for topic in thing.topics)
    return [name for name in summary_of(manifests).verdicts if name in stages or f"{name} ".startswith(topics)]


def stage_verdict(manifests: Iterable[Manifest]) -> Verdict | None:
    """Return one verdict over these artifacts of a stage; None where none of them has one."""
    return merge_verdicts(verdict for manifest in manifests for verdict in _verdicts(manifest).values())


def _skipped(manifest: Manifest, facts: Facts) -> list[str]:
    """Return sentences on what an artifact with these facts, or the stage that made it, skipped and why."""
    sentences = list(facts.skipped)
    match facts:
        case TakeFacts(num_persons=count) if "poses" in manifest.tables and count != 2:
            sentences.append(
                f"Take {facts.take_id}: {counted(count, 'person')}; the stages that need pairs skipped it."
            )
        case SequenceFacts(num_skipped_frames=count) if count:
            sentences.append(
                f"{manifest.partition}: {count} unreadable frames were skipped ({', '.join(facts.skipped_files)}); "
                "`on_unreadable` of its source says whether they stop the run."
            )
        case DrawFacts(num_annotations_skipped=count) | SeedFacts(num_annotations_skipped=count) if count:
            skipped = counted(count, "annotation")
            sentences.append(f"Chains skipped {skipped} without all joints of two people, or without a view.")
    return sentences


def judge(manifests: Sequence[Manifest]) -> list[NamedVerdict]:
    """Return a verdict for each part of a stage and partition, or for the whole of it; stages after what they read."""
    reads: dict[str, set[str]] = {}
    groups: dict[tuple[str, str], list[Verdict]] = {}
    for manifest in manifests:
        reads.setdefault(manifest.ref.stage, set()).update(
            {ref.stage for ref in manifest.inputs} - {manifest.ref.stage}
        )
        for name, verdict in _verdicts(manifest).items():
            groups.setdefault((manifest.ref.stage, f"{manifest.partition} {name}".strip()), []).append(verdict)
    # Sorted: the order of a set of names differs between processes.
    order = list(TopologicalSorter({stage: sorted(before) for stage, before in sorted(reads.items())}).static_order())
    judged = {place: merge_verdicts(verdicts_of_place) for place, verdicts_of_place in groups.items()}
    return [
        NamedVerdict(stage, partition, whole)
        for (stage, partition), whole in sorted(judged.items(), key=lambda item: (order.index(item[0][0]), item[0][1]))
        if whole is not None
    ]


def _verdicts(manifest: Manifest) -> dict[str, Verdict]:
    """Return a shard's verdicts on the parts of its result, by name; of the whole, without a name, where of none."""
    whole = verdict_of(manifest)
    return verdicts_of_parts(manifest) or ({} if whole is None else {"": whole})


def _by_stage(manifests: Sequence[Manifest]) -> dict[str, Verdict]:
    """Return one verdict for each stage, in the order of the graph; topics are judged one by one."""
    judged = judge(manifests)
    parts: dict[str, list[Manifest]] = {product.stage: [] for product in judged if product.stage != _APART}
    for manifest in manifests:
        if manifest.ref.stage in parts:
            parts[manifest.ref.stage].append(manifest)
    verdicts = {name: stage_verdict(of_stage) for name, of_stage in parts.items()}
    apart = {
        part_name(product.stage, product.partition): product.verdict for product in judged if product.stage == _APART
    }
    return {name: verdict for name, verdict in verdicts.items() if verdict is not None} | apart


def _made(thing: _Thing, parts: Sequence[tuple[Manifest, Facts]], chains: Verdict | None) -> Made:
    """Count a thing in its artifacts; seconds are of motion, where its artifacts say how many frames it has."""
    count, seconds = 0, math.nan
    for manifest, facts in parts:
        rows = manifest.tables[thing.table].rows
        if isinstance(facts, LiftedFacts):
            amount = facts.num_lifted
        else:  # a model counts as one, also where it has no arrays
            amount = int(rows > 0 or isinstance(facts, ModelFacts)) if thing.is_artifact else rows
        count += amount
        # Rows of annotations are people and frames; single frames have no duration.
        is_video = not isinstance(facts, SequenceFacts) or facts.purpose == "video"
        if isinstance(facts, PeopleFacts) and facts.rate_hz and is_video:
            times = amount if thing.table == "variant_quality" else 1
            length = times * facts.num_frames / facts.rate_hz
            seconds = length if math.isnan(seconds) else seconds + length
    independent = _independent(thing, [facts for _, facts in parts], chains)
    return Made(thing.name, count, seconds, sum(manifest.num_bytes for manifest, _ in parts), independent)


def _independent(thing: _Thing, facts: Sequence[Facts], chains: Verdict | None) -> tuple[int, str] | None:
    """Return how many items of a product are independent, with their name; None if all are."""

    def some(count: int, what: str, *which: str) -> tuple[int, str]:
        return count, " ".join((counted(count, what).partition(" ")[2], *which))

    if thing.table == "variant_quality":
        return some(len({fact.take_id for fact in facts if isinstance(fact, VariantFacts)}), "take", "with variants")
    if thing.table == "annotations":
        sequence_ids = {name for fact in facts if isinstance(fact, SequenceFacts) for name in fact.sequence_ids}
        return some(len(sequence_ids), "annotated sequence")
    if thing.name == "draws" and chains is not None and chains.figure == "effective sample size":
        return some(round(chains.value * chains.count), "independent draw")
    return None
