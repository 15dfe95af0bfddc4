"""The report: one page with all results, and the dataset card."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

from pydantic import Field

from pasdedeux.evaluation.names import meanings
from pasdedeux.evaluation.pictures import PLAYER, Picture
from pasdedeux.evaluation.report import Report, Section, render
from pasdedeux.evaluation.score_tables import TextTable, mean_table, score_table
from pasdedeux.evaluation.scores import COLUMNS, Score
from pasdedeux.evaluation.summary import Summary, folded, listed
from pasdedeux.evaluation.verdicts import part_name, verdict_columns, verdict_words
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Manifest, SourceCredit, Store
from storage_schema.credits import merge_credits
from storage_schema.runs import REPORT_PAGE
from tasks.evaluation.topic import EVALUATION, ScoresOf, Topic
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.committing import commit, followed
from tasks.stage.facts import Facts, TakeFacts, TopicFacts, merge_takes
from tasks.stage.judgements import verdict_of
from tasks.summary import judge, summary_of

PARTITION = "report"
_OPENING = ("augmentation", "generation", "reconstruction", "lifting", "takes", "clips")
"""Topics whose moving people may open the page, the best first."""
_STAGES = {"takes": "ingest", "models": "training"}
"""The stage whose results a topic's section shows, where it has another name than the topic."""
_MAX_NOTES = 60
"""Sentences of a section, at most; tables have the rest."""
_MAX_PICTURES = 24
"""Pictures of a section within the page, at most, of up to 160 kB each; all of them lie beside it."""
_MAX_ROWS = 500
"""Rows of a table within the page, at most; `scores` has all."""
READS = ("takes", "take_quality", "joint_limits", "training_log")
"""Tables that the page and the card read besides those of the topics; a skipped take has its quality only."""


class PageSettings(Parameters):
    """Title and description of the study on the page."""

    title: str = Field(
        "A dataset of close two-person motion",
        description="Title of the report and the card; default: the title of the study",
    )
    description: str = Field(
        "Made with pasdedeux from the takes and annotations named in the study.",
        description="What the study makes, in one or two sentences, for the report and the card",
    )


class PageParameters(PageSettings):
    """Parameters of the page, including the current licences and credits, because a change needs a new page."""

    sources: tuple[SourceCredit, ...]


def plan(inputs: StageInputs, settings: PageSettings, planned: Sequence[Shard]) -> Shard:
    """Return the shard that assembles the results of all topics' shards."""
    every = {manifest.ref: manifest for table in inputs.manifests for manifest in inputs.of(table)}
    every |= {manifest.ref: manifest for manifest in inputs.empty}
    sources = merge_credits(*(manifest.sources for manifest in every.values()))
    parameters, after = settings.part(PageParameters, sources=sources), tuple(shard.key for shard in planned)
    return EVALUATION.shard(inputs, PARTITION, PARTITION, parameters, {"made": list(every.values())}, after=after)


def run_shard(topics: Sequence[Topic[Any]], shard: Shard, store: Store) -> ArtifactRef:
    """Assemble the page and the card, and commit both with a table of all verdicts."""
    manifests = followed(shard, store)
    inputs = [store.manifest(ref) for ref in shard.refs("made")]
    settings = shard.options(PageParameters)
    scores = {topic.name: _scores(store, manifests, topic) for topic in topics}
    judged, summary = judge([*inputs, *manifests]), summary_of([*inputs, *manifests])
    card = _card(settings, topics, inputs, summary)
    drawn = {
        topic.name: drawn for topic in topics if (drawn := _compared(topic, scores[topic.name], summary)) is not None
    }
    every = [_section(store, manifests, topic, scores, summary, drawn.get(topic.name)) for topic in topics]
    silent = [topic for topic, section in zip(topics, every, strict=True) if section is None]
    there = {table for manifest in inputs for table in manifest.tables}
    page = _page(
        Report(
            settings.title,
            settings.description,
            summary,
            [section for section in every if section is not None],
            _hero(store, manifests),
        ),
        [*summary.skipped, *_unasked(silent, there)],
        card_tables(card),
    )
    figures = {f"{name}-compared.svg": content for name, (content, _) in drawn.items()}
    return commit(
        shard,
        store,
        tables={"verdicts": verdict_columns(judged)} if judged else {},
        attachments={**figures, REPORT_PAGE: page.encode(), "card.md": render("card.md", card=card).encode()},
        facts=Facts(takes=merge_takes(*inputs)),
    )


def _hero(store: Store, manifests: Sequence[Manifest]) -> Picture | None:
    """Return the moving picture at the top of the page: the first of the topics that show people best."""
    for topic in _OPENING:
        for part in (manifest for manifest in manifests if manifest.partition == topic):
            for name in sorted(name for name in part.attachments if name.endswith(PLAYER)):
                return Picture(name, TopicFacts.of(part).captions[name], store.attachment(part.ref, name)).of_panels(2)
    return None


def _compared(topic: Topic[Any], scores: Sequence[Score], summary: Summary) -> tuple[bytes, str] | None:
    """Draw the figure of a topic's first criterion that can be drawn, method by method, as its verdict has it."""
    for criterion in topic.criteria:
        verdict = summary.verdicts.get(part_name(EVALUATION.name, f"{topic.name} {criterion.name}".strip()))
        if (drawn := criterion.picture(scores, verdict)) is not None:
            return drawn
    return None


def _page(report: Report, notes: Sequence[str], card: Sequence[TextTable]) -> str:
    """Return the page, with a section on what it omits."""
    beyond = [sentence for section in report.sections for sentence in _beyond(section)]
    skipped = Section("Skipped, and why", (*beyond, *notes) or ("Nothing was skipped.",))
    sections = [*map(_bounded, report.sections), skipped, Section("Sources and licences", tables=tuple(card))]
    return render("report.html", report=replace(report, sections=sections))


def _bounded(section: Section) -> Section:
    """Return a section reduced to the pictures and rows that a page can hold."""
    tables = tuple(replace(table, rows=table.rows[:_MAX_ROWS]) for table in section.tables)
    return replace(section, tables=tables, pictures=section.pictures[:_MAX_PICTURES])


def _beyond(section: Section) -> list[str]:
    """Return sentences on pictures and rows of a section that the page omits."""
    beside = [picture.name for picture in section.pictures[_MAX_PICTURES:]]
    sentences = [f"{len(beside):,} pictures lie beside the page: {listed(beside)}."] if beside else []
    long = [table for table in section.tables if len(table.rows) > _MAX_ROWS]
    return sentences + [
        f"{table.caption}: the first {_MAX_ROWS} of {len(table.rows):,} rows; the table `scores` has all."
        for table in long
    ]


def _unasked(silent: Sequence[Topic[Any]], there: Set[str]) -> list[str]:
    """Return sentences on topics without a section, and on the keys that request them."""
    keys = {
        topic.heading: [
            f"`evaluation.{key}`" for key, field in topic.settings.model_fields.items() if not field.default
        ]
        for topic in silent
        if there >= set(topic.reads)
    }
    alike: dict[str, list[str]] = {}
    for heading, names in keys.items():
        alike.setdefault(", ".join(names), []).append(heading)
    asked = [f"{'; '.join(headings)} ({names})" for names, headings in alike.items() if names]
    others = [topic.heading for topic in silent if not keys.get(topic.heading)]
    return [
        *([f"Not requested: {'; '.join(asked)}."] if asked else []),
        *([f"No data in this run: {', '.join(others)}."] if others else []),
    ]


def _scores(store: Store, manifests: Sequence[Manifest], topic: Topic[Any]) -> list[Score]:
    scores = []
    for manifest in manifests:
        if manifest.partition == topic.name and "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores")
            columns = [table[name].tolist() for name in COLUMNS]
            scores += [Score(**dict(zip(COLUMNS, row, strict=True))) for row in zip(*columns, strict=True)]
    return scores


def _section(
    store: Store,
    manifests: Sequence[Manifest],
    topic: Topic[Any],
    scores: ScoresOf,
    summary: Summary,
    drawn: tuple[bytes, str] | None,
) -> Section | None:
    """Return a topic's section: what it compares first, then pictures of its worst part, its best, and the others."""
    parts = [manifest for manifest in manifests if manifest.partition == topic.name]
    if not parts:
        return None
    topic_scores, stage = scores[topic.name], _STAGES.get(topic.name, topic.name)
    means = mean_table(topic_scores, caption=f"{topic.heading}: means") if topic.has_means_first else None
    figures = [score_table(topic_scores, caption=f"{topic.heading}: figures")] if topic_scores else []
    known = meanings({name for score in topic_scores for name in (score.method, score.metric)})
    names = (
        [TextTable(f"{topic.heading}: what the names mean", ("name", "in words", "which is"), known)] if known else []
    )
    pictures = [Picture(f"{topic.name}-compared.svg", drawn[1], drawn[0])] if drawn else []
    for part in _worst_and_best_first(parts):
        pictures += [
            Picture(name=name, caption=TopicFacts.of(part).captions[name], content=store.attachment(part.ref, name))
            for name in sorted(part.attachments, key=lambda name: (not name.endswith(PLAYER), name))
        ]
    return Section(
        heading=topic.heading,
        paragraphs=(
            topic.introduction,
            *_of_stage(stage, summary),
            *_shortened(folded(note for part in parts for note in TopicFacts.of(part).notes)),
        ),
        tables=(*topic.tabulate(scores), *([] if means is None else [means]), *figures, *names),
        pictures=tuple(pictures),
        verdicts={
            name: verdict
            for name, verdict in summary.verdicts.items()
            if f"{name} ".startswith(f"{part_name(EVALUATION.name, topic.name)} ")
        },
        stage=stage,
    )


def _of_stage(stage: str, summary: Summary) -> list[str]:
    """Return a sentence with the verdict of a stage on its own results; none where it passes or has no verdict."""
    verdict = summary.verdicts.get(stage)
    return [] if verdict is None or verdict.level is Level.PASS else [f"Stage {stage}: {verdict_words(verdict)}."]


def _shortened(notes: Sequence[str]) -> list[str]:
    rest = len(notes) - _MAX_NOTES
    return [*notes[:_MAX_NOTES], *([f"And {rest} more."] if rest > 0 else [])]


def _worst_and_best_first(parts: Sequence[Manifest]) -> list[Manifest]:
    """Return the parts of a topic with the worst first and the best second, by the lead over the baseline."""
    leads = {
        number: abs(verdict.value - verdict.baseline) * (1.0 if verdict.level is Level.PASS else -1.0)
        for number, part in enumerate(parts)
        if (verdict := verdict_of(part)) is not None and math.isfinite(verdict.value + verdict.baseline)
    }
    if len(leads) < 3:
        return list(parts)
    ends = [min(leads, key=lambda number: leads[number]), max(leads, key=lambda number: leads[number])]
    return [parts[number] for number in (*ends, *(other for other in range(len(parts)) if other not in ends))]


@dataclass(frozen=True)
class DatasetCard:
    """The content of the card: the study, its products, rows by table, held-out takes, known limits."""

    title: str
    description: str
    summary: Summary
    rows: Mapping[str, int]
    is_held_out: Mapping[str, bool]
    cautions: Sequence[str]


def _card(
    settings: PageSettings, topics: Sequence[Topic[Any]], inputs: Sequence[Manifest], summary: Summary
) -> DatasetCard:
    rows = Counter[str]()
    for manifest in inputs:
        rows.update({table: part.rows for table, part in manifest.tables.items()})
    takes = [TakeFacts.of(manifest) for manifest in inputs if "poses" in manifest.tables]
    return DatasetCard(
        title=settings.title,
        description=settings.description,
        summary=summary,
        rows=rows,
        is_held_out=dict(sorted((take.take_id, take.is_held_out) for take in takes)),
        cautions=tuple(sentence for topic in topics for table, sentence in topic.cautions if table in rows),
    )


def card_tables(card: DatasetCard) -> list[TextTable]:
    """Return the card as tables for the report, without skipped data, which have a section of their own there."""
    sources = [(source.name, source.licence, source.credit) for source in card.summary.sources]
    takes = [(take, "held out for evaluation" * is_held_out) for take, is_held_out in card.is_held_out.items()]
    contents = [(name, f"{count:,}") for name, count in sorted(card.rows.items())]
    cautions = [(sentence,) for sentence in card.cautions]
    return [
        TextTable("Dataset card: sources, licences and credits", ("source", "licence", "credit"), tuple(sources)),
        TextTable("Dataset card: takes", ("take", "use"), tuple(takes)),
        TextTable("Dataset card: contents", ("table", "rows"), tuple(contents)),
        TextTable("Dataset card: know before you use it", ("caution",), tuple(cautions)),
    ]
