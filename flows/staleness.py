"""Explains why a shard is stale, by comparing it with the shard of the last run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage_schema import InputRecord, Manifest, ShardRecord, canonical_json
from storage_schema.keys import plain_json
from tasks.stage import Shard, Stage
from tasks.stage.facts import TakeFacts, facts_of

_MAX_NAMED = 3  # differences that are named; more are counted
MAX_CHARACTERS = 40  # of a displayed value


@dataclass(frozen=True)
class StageRecord:
    """The last run's record of a stage: its shards (None if it never ran), and the sections of its study."""

    shards: Sequence[ShardRecord] | None
    sections: Mapping[str, Any]


class Reasons:
    """Explains why shards of a stage have to be computed; common settings are compared once.

    Args:
        stage: The stage.
        sections: The current settings of the stage, as JSON values by section: its own and shared ones.
        inputs: Everything the stage may read.
        last: The stage in the last run.
    """

    def __init__(
        self, stage: Stage, sections: Mapping[str, Mapping[str, Any]], inputs: Sequence[Manifest], last: StageRecord
    ) -> None:
        self._stage, self._is_new = stage, last.shards is None
        self._old = {(record.partition, record.name): record for record in last.shards or ()}
        self._inputs = _described(inputs)
        self._names = {_label(place): label for place, label in self._inputs.values()}
        known = {name: values for name, values in sections.items() if last.sections.get(name)}
        self._settings = [w for name, values in known.items() for w in _changes(last.sections[name], values, name)]

    def why_not_fresh(self, shard: Shard) -> tuple[bool, str]:
        """Return whether a shard without a valid artifact is stale (else missing), and the reason."""
        if self._is_new:
            return False, "never built"
        old = self._old.get((shard.partition, shard.name))
        if old is None:
            return False, f"new: {_listed(self._settings)}" if self._settings else "new"
        if old.key == shard.key:
            return False, "its files are missing or incomplete"
        words = []
        if old.version != shard.version:
            words.append(f"stage version {old.version} -> {shard.version}")
        if old.seed != shard.seed:
            words.append(f"study.seed {old.seed} -> {shard.seed}")
        changes = _changes(old.parameters, shard.values, self._stage.name)
        if changes:
            words.extend(self._settings or changes)
        before = {f"file {name}": sha256 for name, sha256 in old.files}
        now = {f"file {Path(file.path).name}": file.sha256 for file in shard.files}
        words.extend(_changes(before, now, has_values=False))
        words.extend(self._input_changes(old, shard))
        if not words and shard.after:
            words.append("a shard before it changed")
        return True, _listed(words) if words else "store schema or program changed"

    def _input_changes(self, old: ShardRecord, shard: Shard) -> list[str]:
        """Return the changed inputs in words; many of them by stage only.

        Artifacts of the shard's own stage are left out: manifests record them, but a plan has only their keys.
        """
        names, inputs = self._names, self._inputs
        read = [record for record in old.inputs if record.stage != shard.stage]
        before = {names.get(_label(record), _label(record)): record.content_digest for record in read}
        now: dict[str, str] = {}
        for ref in shard.all_inputs:
            now[inputs[ref.key][1] if ref.key in inputs else ref.stage] = ref.content_digest
        words = _changes(before, now, has_values=False)
        if len(words) <= _MAX_NAMED:
            return words
        digests = {record.content_digest for record in read}
        stages = dict.fromkeys(ref.stage for ref in shard.all_inputs if ref.content_digest not in digests)
        return [f"input {name} changed" for name in stages] or ["inputs are gone"]


def changed_leaves(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[str, str]]:
    """Return the leaves that differ between two JSON objects, as JSON text by path; an absent leaf is empty."""
    before, after = (_leaves(prefix, plain_json(dict(values))) if values else {} for values in (old, new))
    pairs = {name: (_text(before, name), _text(after, name)) for name in dict.fromkeys([*after, *before])}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def shorten_text(text: str) -> str:
    """Return a text, cut for display."""
    return text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 3] + "..."


def _described(manifests: Sequence[Manifest]) -> dict[str, tuple[InputRecord, str]]:
    """Return the record and the name of each input artifact, by key: `take 60_03`, else stage and partition."""
    described = {}
    for manifest in manifests:
        place = InputRecord(manifest.ref.stage, manifest.partition, manifest.name, manifest.ref.content_digest)
        facts = facts_of(manifest)
        name = f"take {facts.take_id}" if isinstance(facts, TakeFacts) else _label(place)
        described[manifest.ref.key] = (place, name)
    return described


def _changes(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "", *, has_values: bool = True) -> list[str]:
    """Return the leaves that differ in words: `chains.num_chains 2 -> 4`, without values `file a.bvh changed`."""
    return [
        f"{name} is {'gone' if before else 'new'}"
        if not (before and after)
        else f"{name} {shorten_text(before)} -> {shorten_text(after)}"
        if has_values
        else f"{name} changed"
        for name, (before, after) in changed_leaves(old, new, prefix).items()
    ]


def _label(place: InputRecord) -> str:
    return f"{place.stage} {place.partition}" + ("" if place.name == place.partition else f" {place.name}")


def _leaves(prefix: str, value: Any) -> dict[str, Any]:
    if isinstance(value, dict) and value:
        leaves: dict[str, Any] = {}
        for name, item in value.items():
            leaves.update(_leaves(f"{prefix}.{name}" if prefix else name, item))
        return leaves
    return {prefix: value}


def _text(leaves: Mapping[str, Any], name: str) -> str:
    return canonical_json(leaves[name]).decode() if name in leaves else ""


def _listed(words: Sequence[str]) -> str:
    shown = ", ".join(words[:_MAX_NAMED])
    return shown if len(words) <= _MAX_NAMED else f"{shown} and {len(words) - _MAX_NAMED} more"
