"""The report: one self-contained HTML page made of sections with text, tables and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import figure_words, verdict_words
from pasdedeux.plain_text import markdown_value
from pasdedeux.verdict import Verdict

if TYPE_CHECKING:
    from jinja2 import Environment


_SKINS = "__SKINS__"
"""Placeholder in the page for the bodies of its players."""


@dataclass(frozen=True)
class Section:
    """A section of the report: a heading with its verdicts by name, paragraphs, pictures, and tables that are folded.

    Paragraphs after the first six and pictures after the first four are folded too.  The verdict of the stage, whose
    results it shows, links to it.
    """

    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    pictures: tuple[Picture, ...] = ()
    verdicts: Mapping[str, Verdict] = field(default_factory=dict)
    stage: str = ""

    @property
    def anchor(self) -> str:
        """Name of the section within the page."""
        return "".join(c if c.isalnum() else "-" for c in self.heading.lower())


@dataclass(frozen=True)
class Report:
    """The whole page: title, description of the study, answers, sections, and the first moving picture."""

    title: str
    description: str
    summary: Summary
    sections: Sequence[Section] = field(default_factory=tuple)
    hero: Picture | None = None


def _coded(text: str) -> Markup:
    """Return text with parts in backticks as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return Markup.escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if at % 2 else Markup.escape(part) for at, part in enumerate(parts)
    )


@cache
def _environment(is_markdown: bool) -> Environment:
    from jinja2 import Environment, PackageLoader, select_autoescape  # here: planning need not wait for it

    environment = Environment(
        loader=PackageLoader("pasdedeux.evaluation"),
        autoescape=select_autoescape(("html",)),
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=markdown_value if is_markdown else None,
    )
    environment.filters |= {"figure_words": figure_words, "verdict_words": verdict_words, "coded": _coded}
    return environment


def render(template: str, **values: Any) -> str:
    """Return a template with its gaps filled; the same values always give the same text."""
    text = _environment(template.endswith(".md")).get_template(template).render(**values)
    if _SKINS not in text:
        return text
    from pasdedeux.evaluation.skins import SKINNED, skins_json  # here: a card needs none

    return text.replace(_SKINS, skins_json(name for name in SKINNED if f'"body":"{name}"' in text))
