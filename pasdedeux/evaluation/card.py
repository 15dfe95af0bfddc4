"""The dataset card: what is in a dataset, where it came from, under which licence, and what it is not fit for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import verdict_words


@dataclass(frozen=True)
class DatasetCard:
    """Everything the card says.

    Args:
        title: Title of the study.
        description: What the study makes.
        summary: What was built, from which sources, and how good it is.
        rows: Rows by table.
        takes: Takes shown or learned from.
        held_out: Takes kept for evaluation.
        skipped: What was left out and why, a sentence each.
        cautions: Known limits, a sentence each.
    """

    title: str
    description: str
    summary: Summary
    rows: Mapping[str, int]
    takes: Sequence[str]
    held_out: Sequence[str]
    cautions: Sequence[str]


def render_card(card: DatasetCard) -> str:
    """Return the card as Markdown; the same card always gives the same text."""
    lines = [f"# {card.title}", "", card.description]
    lines += ["", f"- built: {card.summary.built}", f"- from: {card.summary.origin}"]
    if card.summary.verdicts:
        judged = card.summary.verdicts.items()
        lines += ["", "## Is it good?", "", *(f"- {name}: {verdict_words(verdict)}" for name, verdict in judged)]
    lines += ["", "## Contents", "", "| table | rows |", "|---|---|"]
    lines += [f"| {name} | {count:,} |" for name, count in sorted(card.rows.items())]
    lines += ["", "## Takes", ""]
    lines += [f"- {take}{' (held out for evaluation)' if take in card.held_out else ''}" for take in card.takes]
    lines += ["", "## Sources, licences and credits", ""]
    lines += [f"- **{source.name}** - {source.licence}. {source.credit}" for source in card.summary.sources]
    lines += ["", "## Left out", ""]
    lines += [f"- {sentence}" for sentence in card.summary.left_out] or ["- Nothing."]
    lines += ["", "## Know before you use it", ""]
    lines += [f"- {sentence}" for sentence in card.cautions]
    return "\n".join(lines) + "\n"


def card_tables(card: DatasetCard) -> tuple[TextTable, ...]:
    """Return card as tables for the report: sources, takes, contents, cautions; what was left out is not repeated."""
    return (
        TextTable(
            caption="Dataset card: sources, licences and credits",
            headings=("source", "licence", "credit"),
            rows=tuple((source.name, source.licence, source.credit) for source in card.summary.sources),
        ),
        TextTable(
            caption="Dataset card: takes",
            headings=("take", "use"),
            rows=tuple((take, "held out for evaluation" if take in card.held_out else "") for take in card.takes),
        ),
        TextTable(
            caption="Dataset card: contents",
            headings=("table", "rows"),
            rows=tuple((name, f"{count:,}") for name, count in sorted(card.rows.items())),
        ),
        TextTable(
            caption="Dataset card: know before you use it",
            headings=("caution",),
            rows=tuple((sentence,) for sentence in card.cautions),
        ),
    )
