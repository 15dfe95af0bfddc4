"""Topic `report`: everything that was found as one page, and the dataset card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pasdedeux.evaluation.card import CardSource, DatasetCard, card_tables, render_card
from pasdedeux.evaluation.exploration import exploration_table
from pasdedeux.evaluation.report import Picture, Report, Section, TextTable, render_report
from pasdedeux.evaluation.score_tables import mean_table, score_table
from pasdedeux.evaluation.scores import Score
from storage_schema import Manifest, Store
from tasks.evaluation.topic import STAGE_NAME, TopicResult
from tasks.stage import Shard, StageInputs

__all__ = ["TOPIC", "run", "shard"]

TOPIC = "report"

_SECTIONS = {
    "takes": ("Takes", "The 3D motion that came in, at the study's rate, in body22."),
    "clips": ("Sequences", "The 2D poses of each sequence as its camera saw them."),
    "views": ("Views", "Estimated views against the true cameras of virtual video; the mean view is the baseline."),
    "chains": (
        "Chains",
        "How the Markov chains went: acceptance, effective sample size, R-hat per seed.",
    ),
    "coverage": (
        "Coverage",
        "Mean distance from real pairs to their nearest draw as draws increase, beside chains that know the physical "
        "prior only, and beside sets of real frames.",
    ),
    "density": (
        "Density",
        "How well terms of the density tell real pairs of held-out takes from corrupted ones (area under the curve), "
        "and how they go with the distance of lifted pairs from real ones.",
    ),
    "lifting": (
        "Lifting",
        "Annotations lifted to 3D by the draws that look like them; joints hidden in real pairs and completed from "
        "draws; frames filled in between. Pair errors keep distance and depth between the people, person errors are "
        "about each root, both in camera axes.",
    ),
    "reconstruction": (
        "Reconstruction",
        "Motions reconstructed from 2D against the truth, by each frame's nearest projection (the baseline), by the "
        "published window rule, by Viterbi over the candidates, and by Viterbi and a fit to the image; `_clean` is the "
        "method with the clean-up after it. Errors are means over op14, centred on the mid-hip: as they are, with the "
        "root's rotation taken away, and after one scale for the whole motion, for one camera does not see how large a "
        "person is; jitter is the mean second difference from frame to frame. Of two people: how far their distance, "
        "the depth between them and their place to each other are off. `nearest` leaves both where their own size puts "
        "them, the others place them by pairs that look like both; `equal_depth` takes both to be equally far away.",
    ),
    "parallel_views": (
        "Unseen motion, parallel rays",
        "Held-out motion on the body of the projection database, seen by parallel rays: errors of every method, and "
        "how far reconstructions from two views differ (root rotation removed), as in the paper on such databases. "
        "`_clean` is the method with the clean-up after it; `live` leaves frame by frame, six frames after its image.",
    ),
    "pinhole_views": (
        "Unseen motion, pinhole",
        "The same motion on its own body before a pinhole at 4 m; proportions and scale are estimated from the track, "
        "and the lens is assumed, as it is with video of one's own. Where the height of the camera over the floor is "
        "known, the floor says how large the person is.",
    ),
    "left_out_clips": (
        "Clips left out",
        "Each take of the projection database on the database's body by parallel rays, reconstructed from the rest.",
    ),
    "people": (
        "People kept apart",
        "Virtual video of the takes of two people from random views, people in random order in every frame: how often "
        "those who are followed by pose and motion are taken for each other, and what the repair does with injected "
        "faults of detectors. Noise is at 1080 lines.",
    ),
    "augmentation": (
        "Augmentation",
        "Variants for other body sizes: contacts kept, bones exact; plain forward kinematics is the baseline.",
    ),
    "models": (
        "Models",
        "Models that predict a variant from the source and its bone scales; copy and naive forward kinematics are the "
        "baselines.",
    ),
}
"""Heading and introduction of each topic, in the order of the page."""

_CAUTIONS = (
    ("draws", "Draws are a mixture over the chains of the study's seeds, not independent samples of one distribution."),
    (
        "draws",
        "The density knows nothing of ground contact, and one view does not see the relative depth of the two people.",
    ),
    ("cameras", "Virtual video is made from motion capture: its 2D noise is simulated."),
    (
        "models",
        "Models are scored on takes that they saw at other scales (cross-scale split) unless the split says otherwise.",
    ),
)
"""What to know of a dataset that has a table."""
_MEANS = ("reconstruction", "left_out_clips")
"""Topics of many items, whose means are shown first."""


def shard(inputs: StageInputs, topics: Sequence[Shard], *, title: str, description: str) -> Shard:
    """Return the shard that assembles what all other topics found."""
    counted = {manifest.ref.key: manifest for table in inputs.manifests for manifest in inputs.of(table)}
    return Shard(
        stage=STAGE_NAME,
        version=topics[0].version,
        partition=TOPIC,
        name=TOPIC,
        parameters={"topic": TOPIC, "title": title, "description": description},
        inputs=tuple(manifest.ref for manifest in counted.values()),
        after=tuple(topic.key for topic in topics),
        seed=inputs.seed,
    )


def run(shard: Shard, store: Store) -> TopicResult:
    """Assemble the page and the card; the table of scores is what the other topics wrote, taken together."""
    found = [manifest for key in shard.after if (manifest := store.find(STAGE_NAME, key)) is not None]
    assert len(found) == len(shard.after), "a topic that the report reads is not in the store"
    inputs = [store.manifest(ref) for ref in shard.inputs]
    scores = {topic: _scores(store, found, topic) for topic in _SECTIONS}
    skipped = sorted({note for manifest in [*inputs, *found] for note in _skipped(manifest)})
    card = _card(shard, inputs, skipped)
    explored = exploration_table(scores["coverage"], scores["chains"])
    beside = {"coverage": () if explored is None else (explored,)}
    sections = [_section(store, found, topic, scores[topic], beside.get(topic, ())) for topic in _SECTIONS]
    closing = Section(heading="Left out, and why", paragraphs=tuple(skipped) or ("Nothing was left out.",))
    sources = Section(heading="Sources and licences", tables=card_tables(card))
    page = render_report(
        Report(
            title=shard.parameters["title"],
            summary=(shard.parameters["description"],),
            sections=[section for section in sections if section is not None] + [closing, sources],
        )
    )
    return TopicResult(
        pictures={"report.html": page.encode(), "card.md": render_card(card).encode()},
        captions={"report.html": "The report", "card.md": "The dataset card"},
    )


def _scores(store: Store, found: Sequence[Manifest], topic: str) -> list[Score]:
    names = ("topic", "metric", "method", "is_baseline", "split", "item", "at", "value", "unit", "count")
    scores = []
    for manifest in found:
        if manifest.facts["topic"] == topic and "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores")
            columns = [table[name].tolist() for name in names]
            scores += [Score(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]
    return scores


def _section(
    store: Store, found: Sequence[Manifest], topic: str, scores: Sequence[Score], tables: tuple[TextTable, ...]
) -> Section | None:
    """Return a topic's section, with tables before its figures, or None when nothing was found."""
    heading, introduction = _SECTIONS[topic]
    parts = [manifest for manifest in found if manifest.facts["topic"] == topic]
    if not parts:
        return None
    pictures = tuple(
        Picture(name=name, caption=manifest.facts["captions"][name], content=store.attachment(manifest.ref, name))
        for manifest in parts
        for name in sorted(manifest.attachments)
    )
    notes = tuple(dict.fromkeys(note for manifest in parts for note in manifest.facts["notes"]))
    means = mean_table(scores, caption=f"{heading}: means") if topic in _MEANS else None
    if means is not None:
        tables = (*tables, means)
    if scores:
        tables = (*tables, score_table(scores, caption=f"{heading}: figures"))
    return Section(heading=heading, paragraphs=(introduction, *notes), tables=tables, pictures=pictures)


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


def _sources(inputs: Sequence[Manifest]) -> list[CardSource]:
    named = {(s.name, s.licence, s.credit) for manifest in inputs for s in manifest.sources}
    return [CardSource(*source) for source in sorted(named)]


def _card(shard: Shard, inputs: Sequence[Manifest], skipped: Sequence[str]) -> DatasetCard:
    rows: dict[str, int] = {}
    for manifest in inputs:
        for table, part in manifest.tables.items():
            rows[table] = rows.get(table, 0) + part.rows
    takes = [manifest.facts for manifest in inputs if "poses" in manifest.tables]
    return DatasetCard(
        title=shard.parameters["title"],
        description=shard.parameters["description"],
        rows=_without(rows, "scores"),
        takes=sorted(facts["take_id"] for facts in takes),
        held_out=sorted(facts["take_id"] for facts in takes if facts["is_held_out"]),
        sources=_sources(inputs),
        skipped=skipped,
        cautions=tuple(sentence for table, sentence in _CAUTIONS if table in rows),
    )


def _without(rows: Mapping[str, int], name: str) -> dict[str, int]:
    return {table: count for table, count in rows.items() if table != name}
