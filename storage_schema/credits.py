"""Licence and credit of a source. An artifact has those of its own sources; `source_credits` finds all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, order=True)
class SourceCredit:
    """A source of data: its name, its licence, and the credit line that it requires."""

    name: str
    licence: str
    credit: str


def merge_credits(*groups: Iterable[SourceCredit]) -> tuple[SourceCredit, ...]:
    """Return every source of these groups once, sorted by name; sources that differ in any field are different."""
    return tuple(sorted({credit for group in groups for credit in group}))
