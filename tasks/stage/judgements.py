"""Verdicts of shards and of their parts, as stored among the facts of an artifact."""

from __future__ import annotations

from pasdedeux.verdict import Verdict
from storage_schema import Manifest

VERDICT_FACT, PARTS_FACT = "verdict", "verdicts_of_parts"
"""Keys of a shard's verdict, and of those of its parts, among its facts."""


def verdict_of(manifest: Manifest) -> Verdict | None:
    """Return the verdict of a shard; None where it has none."""
    values = manifest.facts.get(VERDICT_FACT)
    return None if values is None else Verdict.from_json(values)


def verdicts_of_parts(manifest: Manifest) -> dict[str, Verdict]:
    """Return the verdicts of a shard's parts, by name; empty where it has none."""
    return {name: Verdict.from_json(values) for name, values in manifest.facts.get(PARTS_FACT, {}).items()}
