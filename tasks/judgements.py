"""Verdicts of shards and of their parts, as they stand among the facts of an artifact."""

from __future__ import annotations

from pasdedeux.verdict import Verdict
from storage_schema import Manifest

VERDICT_FACT, PARTS_FACT = "verdict", "verdicts_of_parts"
"""Names under which a shard's verdict, and those of its parts, stand among its facts."""


def verdict_of(manifest: Manifest) -> Verdict | None:
    """Return what a shard thinks of its result; None where it judged nothing."""
    values = manifest.facts.get(VERDICT_FACT)
    return None if values is None else Verdict.from_json(values)


def verdicts_of_parts(manifest: Manifest) -> dict[str, Verdict]:
    """Return what a shard thinks of the parts of its result, by name; empty where it judged none."""
    return {name: Verdict.from_json(values) for name, values in manifest.facts.get(PARTS_FACT, {}).items()}
