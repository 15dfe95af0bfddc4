"""A topic of the evaluation: it computes scores, draws pictures, and tabulates the scores of all its shards."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.scores import Score, columns_of
from pasdedeux.evaluation.verdicts import Criterion, Items, merge_verdicts
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Parameters, Shard, StageInputs, StageName
from tasks.stage.committing import commit
from tasks.stage.facts import Facts, TopicFacts, merge_takes

EVALUATION = StageName("evaluation", 71)

ScoresOf = Mapping[str, Sequence[Score]]
"""Scores of all shards by topic."""

D = TypeVar("D")


@dataclass(frozen=True)
class TopicResult(Generic[D]):
    """Result of a topic in one shard.

    Args:
        scores: The figures.
        notes: Sentences for the reader: the measurement, skipped data and the reasons.
        items: Items to judge by the name of a criterion; nothing was learned from them.
        baselines: Methods that others are compared with, in scores and items.
        shown: Input of the pictures; None where there are none.
    """

    scores: Sequence[Score] = ()
    notes: Sequence[str] = ()
    items: Mapping[str, Items] = field(default_factory=dict)
    baselines: Collection[str] = ()
    shown: D | None = None


@dataclass(frozen=True)
class Topic(Generic[D]):
    """A question that the evaluation answers: a section of the report.

    A topic is a file with one of these, and a line in `TOPICS` (tasks/evaluation/__init__.py), whose order is that of
    the page.  The file has `plan`, `compute` and, if needed, `draw` and `tabulate`; `compute` hands a `D` to `draw`.

    Args:
        name: Name of the topic: the partition of its shards, and `topic` of its rows in the `scores` table.
        heading: Heading of its section.
        introduction: Explains its figures to the reader of the page.
        reads: Tables that its shards read; the stage reads those of all topics.
        plan: Gives the shards for these inputs and settings (an instance of `settings`), made by `shard`; none where
            there is nothing to score, or the settings do not ask for it.  Reads manifests, never data.
        compute: Scores one of these shards; reads its artifacts.
        draw: Draws what `compute` shows: figures (.svg) and moving people (.player.json).
        tabulate: Tables beside the figures, from the scores of all shards of all topics.
        settings: Its keys in the study's section `evaluation`.
        criteria: Criteria of its result: a verdict for each whose items a shard has.
        has_means_first: The page shows means over many items before the items.
        cautions: Warnings about a dataset, as pairs of a table and a sentence that applies if the table is present.
    """

    name: str
    heading: str
    introduction: str
    reads: tuple[str, ...]
    plan: Callable[[StageInputs, Any], list[Shard]]
    compute: Callable[[Shard, Store], TopicResult[D]]
    draw: Callable[[D], Iterable[Picture]] = field(default=lambda _: ())
    tabulate: Callable[[ScoresOf], Sequence[TextTable]] = field(default=lambda _: ())
    settings: type[Parameters] = Parameters
    criteria: tuple[Criterion, ...] = ()
    has_means_first: bool = False
    cautions: tuple[tuple[str, str], ...] = ()

    def pictures(self, result: TopicResult[D]) -> list[Picture]:
        """Draw a result."""
        return [] if result.shown is None else list(self.draw(result.shown))

    def shard(
        self, inputs: StageInputs, name: str, parameters: Parameters | None = None, /, **named: Sequence[Manifest]
    ) -> Shard:
        """Return a shard of the topic that reads these artifacts, by their roles."""
        return EVALUATION.shard(inputs, self.name, name, parameters or Parameters(), named)


def run_topic(topic: Topic[Any], shard: Shard, store: Store) -> ArtifactRef:
    """Compute, draw and commit one shard of a topic, with the verdict of each of its criteria that has items."""
    result = topic.compute(shard, store)
    pictures = topic.pictures(result)
    parts = {
        criterion.name: verdict
        for criterion in topic.criteria
        if criterion.name in result.items
        if (verdict := criterion.verdict(result.items[criterion.name], result.baselines)) is not None
    }
    whole = merge_verdicts(parts.values())
    return commit(
        shard,
        store,
        tables={"scores": columns_of(topic.name, result.scores, result.baselines)} if result.scores else {},
        attachments={picture.name: picture.content for picture in pictures},
        facts=TopicFacts(
            takes=merge_takes(*(store.manifest(ref) for ref in shard.all_inputs)),
            captions={picture.name: picture.caption for picture in pictures},
            notes=tuple(result.notes),
        ),
        verdict=None if whole is None else replace(whole, paired=None),
        parts=parts,
    )


def refuse_learned(store: Store, refs: Iterable[ArtifactRef], held_out: Iterable[str]) -> None:
    """Refuse artifacts that learned from a take that is held out, as `refuse_overlap` does."""
    for manifest in map(store.manifest, refs):
        refuse_overlap(f"artifact {manifest.partition}", Facts.of(manifest).takes, held_out)


def refuse_overlap(what: str, learned_from: Iterable[str], evaluated: Iterable[str]) -> None:
    """Refuse to evaluate on takes that were learned from."""
    both = sorted(set(learned_from) & set(evaluated))
    if both:
        raise InputError(f"{what} learned from {', '.join(both)}, which it is evaluated on; hold these takes out")
