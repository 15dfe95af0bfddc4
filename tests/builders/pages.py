"""A report page read back: its links, headings, pictures and tables, and what a browser makes of it."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
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


def in_browser(page: str, probe: str, folder: Path, *, width: int = 1100) -> Any:
    """Return what a script answers within a page in headless Chromium, and errors of the page; a screenshot is kept.

    `probe` is the body of an async function.  Skips where no browser is installed.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no browser is installed here: one of {', '.join(BROWSERS)} on the path opens the page")
    listen = '<script>window.errors = []; addEventListener("error", (e) => errors.push(e.message));</script>'
    ask = (
        f"<script>(async () => {{ const found = await (async () => {{ {probe} }})();"
        ' const said = document.createElement("pre"); said.id = "said";'
        " said.textContent = btoa(unescape(encodeURIComponent(JSON.stringify({ found, errors }))));"
        " document.body.append(said); })().catch((e) => errors.push(e.message));</script>"
    )
    path = folder / "page.html"
    path.write_text(
        page.replace("<style>", f"{listen}<style>", 1).replace("</body>", f"{ask}</body>"), encoding="utf-8"
    )
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", f"--window-size={width},900"]
    profile = f"--user-data-dir={folder / 'profile'}"
    picture = [f"--screenshot={folder / f'page-{width}.png'}"]
    for more in (picture, ["--dump-dom"]):
        done = subprocess.run(
            [browser, *flags, profile, *more, path.as_uri()], capture_output=True, text=True, timeout=60, check=True
        )
    answer = done.stdout.split('<pre id="said">')[1].split("<")[0]
    return json.loads(base64.b64decode(answer))
