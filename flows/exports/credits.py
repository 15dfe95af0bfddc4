"""Licence and credit lines of exports: one text for all files of a folder, also over several exports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from flows.exports.export_format import write_text
from pasdedeux.plain_text import visible
from storage_schema import ArtifactRef, SourceCredit

CREDITS_NAME = "CREDITS.txt"
_SOURCES = "Sources, their licences and credits:"
_ARTIFACTS = "Artifacts (stage, key, content digest):"
_OURS = re.compile(
    rf"(?P<exports>(Exported from .*\n)+)\n{re.escape(_SOURCES)}\n\n"
    r"(?P<sources>(\S.*\n  licence: .*\n  credit: .*\n\n)*)"
    rf"{re.escape(_ARTIFACTS)}\n(?P<artifacts>(  .*\n)*)"
)
_ENDS = {"exports": "\n", "sources": "\n\n", "artifacts": "\n"}


def write_credits(credited: Sequence[SourceCredit], refs: Sequence[ArtifactRef], text: str, out: Path) -> Path:
    """Add the licence and credit lines of an export's sources to those of a folder."""
    path = out / CREDITS_NAME
    before = _read(path)
    ours = list(_OURS.finditer(before))  # several if the texts of two folders were joined
    exports, sources, artifacts = (
        {part for our in ours for part in our[name].split(end)} for name, end in _ENDS.items()
    )
    exports.add(f"Exported from {text} by pasdedeux.")
    artifacts |= {f"  {ref.stage} {ref.key} {ref.content_digest}" for ref in refs}
    for source in credited:
        name, licence, credit = (
            visible(" ".join(said.split())) for said in (source.name, source.licence, source.credit)
        )
        sources.add(f"{name}\n  licence: {licence}\n  credit:  {credit}")
    parts = (_lines(exports), f"\n{_SOURCES}\n\n", _lines(sources, "\n\n"), f"{_ARTIFACTS}\n", _lines(artifacts))
    return _write(path, _with_notice(_OURS.sub("", before), "".join(parts)))


def add_notice(path: Path, notice: str) -> None:
    """Put a notice on top of a text of credits, unless the text has it."""
    before = _read(path)
    if notice.strip() not in before:
        _write(path, _with_notice(notice, before))


def _lines(said: set[str], end: str = "\n") -> str:
    return "".join(paragraph + end for paragraph in sorted(said - {""}))


def _with_notice(notice: str, text: str) -> str:
    """Join a notice of others and our text."""
    return "\n\n".join(part.strip("\n") for part in (notice, text) if part.strip()) + "\n"


def _write(path: Path, text: str) -> Path:
    """Replace a text; the old one stays if there is no room for the new one."""
    return write_text(path.with_name(f".{path.name}.part"), text).replace(path)


def _read(path: Path) -> str:
    return path.read_text("utf-8", errors="replace") if path.is_file() else ""
