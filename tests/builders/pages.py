"""A report page read back: its links, headings, pictures and tables."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

_VOID = {"meta", "img", "input", "br", "hr", "link"}


@dataclass
class Page(HTMLParser):
    """A page by its parts; `problems` are tags that do not match and ids that are there twice."""

    text: str
    ids: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    headings: list[tuple[int, str]] = field(default_factory=list)
    unnamed: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    figures: list[bytes] = field(default_factory=list)
    cells: list[str] = field(default_factory=list)
    framed: str = ""
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Read the page."""
        super().__init__()
        self._open: list[tuple[str, dict[str, str | None]]] = []
        self.feed(self.text)
        self.close()
        self.problems += [f"<{tag}> is not closed" for tag, _ in self._open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take a tag."""
        named = dict(attrs)
        if tag not in _VOID:
            self._open.append((tag, named))
        if (name := named.get("id")) is not None:
            self.problems += [f"id {name} twice"] if name in self.ids else []
            self.ids.add(name)
        if tag == "a":
            self.links.append(named["href"] or "")
        if tag in ("h1", "h2", "h3"):
            self.headings.append((int(tag[1]), ""))
        if tag == "img":
            self.figures.append(base64.b64decode((named["src"] or "").partition("base64,")[2], validate=True))
        if tag == "iframe":
            self.framed = named["srcdoc"] or ""
        if tag == "td":
            self.cells.append("")
        needs = {"img": "alt", "canvas": "aria-label", "input": "aria-label", "select": "aria-label"}.get(tag)
        if needs and not named.get(needs):
            self.unnamed.append(tag)
        named_files = [named.get(key) or "#" for key in ("src", "href")]
        self.outside += [name for name in named_files if not name.startswith(("#", "data:"))]

    def handle_endtag(self, tag: str) -> None:
        """Take the end of a tag."""
        if not self._open or self._open[-1][0] != tag:
            self.problems.append(f"</{tag}> in {[name for name, _ in self._open]}")
        else:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        """Take text."""
        tag, named = self._open[-1] if self._open else ("", {})
        if tag in ("h1", "h2", "h3"):
            self.headings[-1] = (self.headings[-1][0], self.headings[-1][1] + data)
        elif tag == "td":
            self.cells[-1] += data
        elif tag == "script" and named.get("type") == "application/json":
            self.scenes.append(json.loads(data))
