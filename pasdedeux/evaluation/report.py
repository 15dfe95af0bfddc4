"""The report: one self-contained HTML page made of sections with text, tables and pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from jinja2 import Environment, PackageLoader, select_autoescape

from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import figure_words
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Verdict

__all__ = ["PLAYER", "Picture", "Report", "Section", "fit_pictures", "render_report"]

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
    """A section of the report: a heading with its verdict, paragraphs, pictures, and tables that are folded."""

    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    pictures: tuple[Picture, ...] = ()
    num_shown: int = 4
    verdict: Verdict | None = None

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
    """Leave out pictures, evenly in every section but never its first ones, until all fit; gives how many went.

    They lie beside the page all the same.
    """
    sizes = [picture.num_bytes for section in sections for picture in section.pictures]
    if sum(sizes) <= max_bytes:
        return list(sections), 0
    share, kept = max_bytes / sum(sizes), []
    for section in sections:
        more = section.pictures[section.num_shown :]
        chosen = evenly_spread(len(more), int(share * len(more)))
        kept.append(replace(section, pictures=(*section.pictures[: section.num_shown], *(more[at] for at in chosen))))
    return kept, len(sizes) - sum(len(section.pictures) for section in kept)


def render_report(report: Report) -> str:
    """Return the report as one HTML page; the same report always gives the same text."""
    environment = Environment(
        loader=PackageLoader("pasdedeux.evaluation"),
        autoescape=select_autoescape(("html",)),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure_words": figure_words}
    return environment.get_template("report.html").render(report=report)
