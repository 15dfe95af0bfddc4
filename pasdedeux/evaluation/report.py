"""The report: one self-contained HTML page made of sections with text, tables and pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field

from jinja2 import Environment, PackageLoader, select_autoescape

__all__ = ["Picture", "Report", "Section", "TextTable", "render_report"]

_MEDIA_TYPES = {".png": "image/png", ".svg": "image/svg+xml", ".webp": "image/webp"}


@dataclass(frozen=True)
class TextTable:
    """A table of text: a caption, column headings and rows; rows with levels (pass, warn, fail) are marked."""

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    levels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Picture:
    """A picture or animated clip: its file name tells the kind (.png, .svg, .webp)."""

    name: str
    caption: str
    content: bytes

    @property
    def data_uri(self) -> str:
        """The picture as a data URI, so that the page needs no other file."""
        media_type = next(kind for ending, kind in _MEDIA_TYPES.items() if self.name.endswith(ending))
        return f"data:{media_type};base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True)
class Section:
    """A section of the report: a heading, paragraphs, tables and pictures, in this order."""

    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @property
    def anchor(self) -> str:
        """Name of the section within the page."""
        return "".join(c if c.isalnum() else "-" for c in self.heading.lower())


@dataclass(frozen=True)
class Report:
    """The whole page."""

    title: str
    summary: tuple[str, ...]
    sections: Sequence[Section] = field(default_factory=tuple)


def render_report(report: Report) -> str:
    """Return the report as one HTML page; the same report always gives the same text."""
    environment = Environment(
        loader=PackageLoader("pasdedeux.evaluation"),
        autoescape=select_autoescape(("html",)),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(report=report)
