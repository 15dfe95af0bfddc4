"""The report: one self-contained HTML page made of sections with text, tables and pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING

from markupsafe import Markup

from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import figure_words
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Verdict

if TYPE_CHECKING:
    from jinja2 import Environment

__all__ = ["PLAYER", "Picture", "Report", "Section", "fit_pictures", "fit_rows", "render_report"]

PLAYER = ".player.json"
"""Ending of what a player shows."""


@dataclass(frozen=True)
class Picture:
    """A figure (.svg) or moving people (.player.json), told by its file name, with a caption.

    Of a section with many the first are shown, and others folded away.
    """

    name: str
    caption: str
    content: bytes

    @property
    def is_player(self) -> bool:
        """It is made of moving people."""
        return self.name.endswith(PLAYER)

    @property
    def num_bytes(self) -> int:
        """Bytes that it takes within the page."""
        return len(self.content) if self.is_player else len(self.content) * 4 // 3

    @property
    def is_broad(self) -> bool:
        """Its panels need the page's width."""
        return self.content.count(b'"title":') > 1

    @property
    def scene(self) -> str:
        """What a player shows, as JSON that can stand within a page: nothing in it ends a script."""
        return self.content.decode().replace("<", "\\u003c").replace("&", "\\u0026")

    @property
    def data_uri(self) -> str:
        """The figure as a data URI, so that the page needs no other file."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True)
class Section:
    """A section of the report: a heading with its verdicts by name, paragraphs, pictures, and tables that are folded.

    Paragraphs after the first `num_read` and pictures after the first `num_shown` are folded too.
    """

    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    pictures: tuple[Picture, ...] = ()
    num_shown: int = 4
    num_read: int = 6
    verdicts: Mapping[str, Verdict] = field(default_factory=dict)

    @property
    def anchor(self) -> str:
        """Name of the section within the page."""
        return "".join(c if c.isalnum() else "-" for c in self.heading.lower())


@dataclass(frozen=True)
class Report:
    """The whole page: its title, what the study makes, the answers on top, the sections."""

    title: str
    description: str
    summary: Summary
    sections: Sequence[Section] = field(default_factory=tuple)


def fit_pictures(sections: Sequence[Section], max_bytes: int) -> tuple[list[Section], int]:
    """Leave out pictures until all fit; gives how many went, which lie beside the page all the same.

    The first ones of every section are taken in turn, then others, evenly in every section.
    """
    left = max_bytes
    kept: list[set[int]] = [set() for _ in sections]

    def take(number: int, at: int) -> None:
        nonlocal left
        size = sections[number].pictures[at].num_bytes
        if size <= left:
            left -= size
            kept[number].add(at)

    first = [min(section.num_shown, len(section.pictures)) for section in sections]
    for rank in range(max(first, default=0)):
        for number, count in enumerate(first):
            if rank < count:
                take(number, rank)
    more = sum(one.num_bytes for section in sections for one in section.pictures[section.num_shown :])
    share = min(1.0, left / max(more, 1))
    for number, section in enumerate(sections):
        count = len(section.pictures) - first[number]
        for at in evenly_spread(count, int(share * count)):
            take(number, first[number] + int(at))
    fitted = [
        replace(section, pictures=tuple(section.pictures[at] for at in sorted(chosen)))
        for section, chosen in zip(sections, kept, strict=True)
    ]
    return fitted, sum(len(section.pictures) for section in sections) - sum(map(len, kept))


def fit_rows(sections: Sequence[Section], max_rows: int) -> tuple[list[Section], int]:
    """Leave out the rows of each table after so many; gives how many went."""
    fitted = [
        replace(section, tables=tuple(replace(table, rows=table.rows[:max_rows]) for table in section.tables))
        for section in sections
    ]
    return fitted, sum(max(0, len(table.rows) - max_rows) for section in sections for table in section.tables)


def _coded(text: str) -> Markup:
    """Return text with what stands between backticks as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return Markup.escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if at % 2 else Markup.escape(part) for at, part in enumerate(parts)
    )


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, select_autoescape  # here: planning need not wait for it

    environment = Environment(
        loader=PackageLoader("pasdedeux.evaluation"),
        autoescape=select_autoescape(("html",)),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure_words": figure_words, "coded": _coded}
    return environment


def render_report(report: Report) -> str:
    """Return the report as one HTML page; the same report always gives the same text."""
    return _environment().get_template("report.html").render(report=report)
