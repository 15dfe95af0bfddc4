"""The report: everything that was found as one page, and the dataset card."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from pasdedeux.evaluation.card import CardSource, DatasetCard, card_tables, render_card
from pasdedeux.evaluation.report import Picture, Report, Section, render_report
from pasdedeux.evaluation.score_tables import mean_table, score_table
from pasdedeux.evaluation.scores import COLUMNS, Score
from pasdedeux.evaluation.verdicts import Judged, by_stage, verdict_columns, verdict_line, verdict_table
from pasdedeux.verdict import summarise_verdicts
from storage_schema import ArtifactRef, Manifest, Store
from tasks.evaluation.topic import STAGE_NAME, VERSION, ScoresOf, Topic
from tasks.stage import Parameters, Shard, StageInputs, commit, merge_takes, named_refs, verdict_of, verdicts_of_parts

__all__ = ["PARTITION", "READS", "PageSettings", "plan", "run_shard"]

PARTITION = "report"
READS = ("takes", "take_quality", "training_log")
"""Tables that the page and the card read beside those of the topics; of a take that is left out only its quality is."""


class PageSettings(Parameters):
    """What the page says of the study."""

    title: str = Field("A dataset of close two-person motion", description="Title of the report and the card")
    description: str = Field(
        "Made with pasdedeux from the takes and annotations named in the study.",
        description="What the study makes, a sentence or two for the report and the card",
    )


def plan(inputs: StageInputs, settings: PageSettings, planned: Sequence[Shard]) -> Shard:
    """Return the shard that assembles what the shards of all topics found."""
    every = {manifest.ref.key: manifest for table in inputs.manifests for manifest in inputs.of(table)}
    return Shard(
        stage=STAGE_NAME,
        version=VERSION,
        partition=PARTITION,
        name=PARTITION,
        parameters=settings.part(PageSettings),
        inputs=named_refs(made=list(every.values())),
        after=tuple(shard.key for shard in planned),
        seed=inputs.seed,
    )


def run_shard(topics: Sequence[Topic], shard: Shard, store: Store) -> ArtifactRef:
    """Assemble the page and the card, and commit both with a table of all verdicts."""
    found = [manifest for key in shard.after if (manifest := store.find(STAGE_NAME, key)) is not None]
    assert len(found) == len(shard.after), "a topic that the report reads is not in the store"
    inputs = [store.manifest(ref) for ref in shard.refs("made")]
    settings = shard.options(PageSettings)
    skipped = sorted({note for manifest in [*inputs, *found] for note in _skipped(manifest)})
    scores = {topic.name: _scores(store, found, topic) for topic in topics}
    judged = _judged([*inputs, *found])
    verdicts = by_stage(judged, apart=STAGE_NAME)
    card = _card(settings, topics, inputs, skipped, [verdict_line(*one) for one in verdicts.items()])
    page = render_report(
        Report(
            title=settings.title,
            summary=(settings.description,),
            sections=[
                *([Section(heading="Is it good?", tables=(verdict_table(verdicts),))] if verdicts else []),
                *(section for topic in topics if (section := _section(store, found, topic, scores)) is not None),
                Section(heading="Left out, and why", paragraphs=tuple(skipped) or ("Nothing was left out.",)),
                Section(heading="Sources and licences", tables=card_tables(card)),
            ],
        )
    )
    return commit(
        shard,
        store,
        tables={"verdicts": verdict_columns(judged)} if judged else {},
        attachments={"report.html": page.encode(), "card.md": render_card(card).encode()},
        facts={"takes": merge_takes(*inputs)},
    )


def _scores(store: Store, found: Sequence[Manifest], topic: Topic) -> list[Score]:
    scores = []
    for manifest in found:
        if manifest.partition == topic.name and "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores")
            columns = [table[name].tolist() for name in COLUMNS]
            scores += [Score(**dict(zip(COLUMNS, row, strict=True))) for row in zip(*columns, strict=True)]
    return scores


def _judged(manifests: Sequence[Manifest]) -> list[Judged]:
    """Return one verdict for each part of a stage and partition, or for the whole of it, in order of appearance."""
    groups: dict[tuple[str, str], list[Manifest]] = {}
    for manifest in manifests:
        groups.setdefault((manifest.ref.stage, manifest.partition), []).append(manifest)
    judged = []
    for (stage, partition), found in groups.items():
        parts = {name: verdict for one in found for name, verdict in verdicts_of_parts(one).items()}
        judged += [Judged(stage, f"{partition} {name}", verdict) for name, verdict in parts.items()]
        whole = summarise_verdicts(verdict for one in found if (verdict := verdict_of(one)) is not None)
        if whole is not None and not parts:
            judged.append(Judged(stage, partition, whole))
    return judged


def _section(store: Store, found: Sequence[Manifest], topic: Topic, scores: ScoresOf) -> Section | None:
    """Return a topic's section, with tables before its figures, or None when nothing was found."""
    parts = [manifest for manifest in found if manifest.partition == topic.name]
    if not parts:
        return None
    own = scores[topic.name]
    means = mean_table(own, caption=f"{topic.heading}: means") if topic.has_means_first else None
    figures = [score_table(own, caption=f"{topic.heading}: figures")] if own else []
    return Section(
        heading=topic.heading,
        paragraphs=(topic.introduction, *dict.fromkeys(note for part in parts for note in part.facts["notes"])),
        tables=(*topic.tables(scores), *([] if means is None else [means]), *figures),
        pictures=tuple(
            Picture(name=name, caption=part.facts["captions"][name], content=store.attachment(part.ref, name))
            for part in parts
            for name in sorted(part.attachments)
        ),
    )


def _skipped(manifest: Manifest) -> list[str]:
    """Say in sentences what an artifact left out."""
    facts = manifest.facts
    found = list(facts.get("skipped", []))
    if "poses" in manifest.tables and facts["num_persons"] != 2:
        who = "one person" if facts["num_persons"] == 1 else f"{facts['num_persons']} people"
        found.append(f"Take {facts['take_id']}: {who}; the stages that need pairs passed it over.")
    if facts.get("num_skipped_frames"):
        named = ", ".join(facts["skipped_files"])
        found.append(f"{manifest.partition}: {facts['num_skipped_frames']} unreadable frames were left out ({named}).")
    if facts.get("num_annotations_skipped"):
        count = facts["num_annotations_skipped"]
        found.append(f"Chains: {count} annotations without all joints of two people, or without a view, were left out.")
    return found


def _card(
    settings: PageSettings,
    topics: Sequence[Topic],
    inputs: Sequence[Manifest],
    skipped: Sequence[str],
    verdicts: Sequence[str],
) -> DatasetCard:
    rows: dict[str, int] = {}
    for manifest in inputs:
        for table, part in manifest.tables.items():
            rows[table] = rows.get(table, 0) + part.rows
    takes = [manifest.facts for manifest in inputs if "poses" in manifest.tables]
    sources = {(s.name, s.licence, s.credit) for manifest in inputs for s in manifest.sources}
    return DatasetCard(
        title=settings.title,
        description=settings.description,
        rows=rows,
        takes=sorted(facts["take_id"] for facts in takes),
        held_out=sorted(facts["take_id"] for facts in takes if facts["is_held_out"]),
        sources=[CardSource(*source) for source in sorted(sources)],
        skipped=skipped,
        cautions=tuple(sentence for topic in topics for table, sentence in topic.cautions if table in rows),
        verdicts=verdicts,
    )
