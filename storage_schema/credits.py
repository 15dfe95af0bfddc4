"""Licence and credit of a source: an artifact has those of what came in with it, `source_credits` finds the others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, order=True)
class SourceCredit:
    """Where data came from: the source's name, its licence, and the credit line it asks for."""

    name: str
    licence: str
    credit: str


def merge_credits(*groups: Iterable[SourceCredit]) -> tuple[SourceCredit, ...]:
    """Return every source of these groups once, sorted by name; sources that differ in any field stay apart."""
    return tuple(sorted({credit for group in groups for credit in group}))
