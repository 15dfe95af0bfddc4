"""Why a shard has to be computed again, in words: the shard as it is now against the shard of the last run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage_schema import InputRecord, Manifest, ShardRecord, canonical_json
from storage_schema.keys import plain_json
from tasks.stage import Shard, Stage

__all__ = ["StageRecord", "changed_leaves", "describe_inputs", "shorten", "why_not_fresh"]

_MAX_NAMED = 3  # differences named one by one; more are counted
_MAX_CHARACTERS = 40  # of a value that is shown


@dataclass(frozen=True)
class StageRecord:
    """A stage as the last run recorded it: its shards (None when it never ran), and the sections of the study then."""

    shards: Sequence[ShardRecord] | None
    sections: Mapping[str, Any]


def describe_inputs(manifests: Sequence[Manifest]) -> dict[str, tuple[InputRecord, str]]:
    """Return for each input artifact, by key, its record and its name: `take 60_03`, else stage and partition."""
    described = {}
    for manifest in manifests:
        place = InputRecord(manifest.ref.stage, manifest.partition, manifest.name, manifest.ref.content_digest)
        is_take = manifest.facts.get("kind") == "take"
        described[manifest.ref.key] = (place, f"take {manifest.facts['take_id']}" if is_take else _label(place))
    return described


def why_not_fresh(
    stage: Stage,
    sections: Mapping[str, Mapping[str, Any]],
    shard: Shard,
    inputs: Mapping[str, tuple[InputRecord, str]],
    last: StageRecord,
) -> tuple[bool, str]:
    """Tell whether a shard without an artifact is stale (else it is missing), and why, in words.

    Args:
        stage: The shard's stage.
        sections: What the study says of the stage now, as JSON values, by section: its own and those it shares.
        shard: The shard that has no valid artifact.
        inputs: What `describe_inputs` says of everything the stage may read.
        last: The stage in the last run.
    """
    if last.shards is None:
        return False, "never built"
    known = {name: values for name, values in sections.items() if last.sections.get(name)}
    settings = [word for name, values in known.items() for word in _changes(name, last.sections[name], values)]
    old = next((r for r in last.shards if (r.partition, r.name) == (shard.partition, shard.name)), None)
    if old is None:
        return False, f"new: {_listed(settings)}" if settings else "new"
    if old.key == shard.key:
        return False, "its files are missing or incomplete"
    words = []
    if old.version != shard.version:
        words.append(f"stage version {old.version} -> {shard.version}")
    if old.seed != shard.seed:
        words.append(f"study.seed {old.seed} -> {shard.seed}")
    own = _changes(stage.name, old.parameters, shard.values)
    if own:
        words.extend(settings or own)
    words.extend(_file_changes(old, shard))
    words.extend(_input_changes(old, shard, inputs))
    if not words and shard.after:
        words.append("a shard before it changed")
    return True, _listed(words) if words else "store schema or program changed"


def changed_leaves(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[str, str]]:
    """Return the leaves of two JSON objects that differ, as JSON texts by path; a leaf that is not there is empty."""
    before, after = (_leaves(prefix, plain_json(dict(values))) if values else {} for values in (old, new))
    pairs = {name: (_text(before, name), _text(after, name)) for name in dict.fromkeys([*after, *before])}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def shorten(text: str) -> str:
    """Return a text as it is shown: the beginning of a long one."""
    return text if len(text) <= _MAX_CHARACTERS else text[: _MAX_CHARACTERS - 3] + "..."


def _changes(prefix: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Name the leaves that differ: `chains.num_chains 2 -> 4`."""
    return [
        f"{name} {shorten(before)} -> {shorten(after)}"
        if before and after
        else f"{name} is {'gone' if before else 'new'}"
        for name, (before, after) in changed_leaves(old, new, prefix).items()
    ]


def _file_changes(old: ShardRecord, shard: Shard) -> list[str]:
    before = dict(old.files)
    now = {Path(file.path).name: file.sha256 for file in shard.files}
    return _differences({f"file {n}": d for n, d in before.items()}, {f"file {n}": d for n, d in now.items()})


def _input_changes(old: ShardRecord, shard: Shard, inputs: Mapping[str, tuple[InputRecord, str]]) -> list[str]:
    """Name the inputs that changed; many of them by stage only.

    Artifacts of the shard's own stage are those it comes after: manifests record them, a plan has only their keys.
    """
    names = {_label(place): label for place, label in inputs.values()}
    read = [record for record in old.inputs if record.stage != shard.stage]
    before = {names.get(_label(record), _label(record)): record.content_digest for record in read}
    now: dict[str, str] = {}
    for ref in shard.all_inputs:
        now[inputs[ref.key][1] if ref.key in inputs else ref.stage] = ref.content_digest
    words = _differences(before, now)
    if len(words) <= _MAX_NAMED:
        return words
    digests = {record.content_digest for record in read}
    stages = dict.fromkeys(ref.stage for ref in shard.all_inputs if ref.content_digest not in digests)
    return [f"input {name} changed" for name in stages] or ["inputs are gone"]


def _differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    return [
        *(f"{name} changed" for name in now if name in before and before[name] != now[name]),
        *(f"{name} is new" for name in now if name not in before),
        *(f"{name} is gone" for name in before if name not in now),
    ]


def _label(place: InputRecord) -> str:
    return f"{place.stage} {place.partition}" + ("" if place.name == place.partition else f" {place.name}")


def _leaves(prefix: str, value: Any) -> dict[str, Any]:
    if isinstance(value, dict) and value:
        found: dict[str, Any] = {}
        for name, item in value.items():
            found.update(_leaves(f"{prefix}.{name}" if prefix else name, item))
        return found
    return {prefix: value}


def _text(leaves: Mapping[str, Any], name: str) -> str:
    return canonical_json(leaves[name]).decode() if name in leaves else ""


def _listed(words: Sequence[str]) -> str:
    shown = ", ".join(words[:_MAX_NAMED])
    return shown if len(words) <= _MAX_NAMED else f"{shown} and {len(words) - _MAX_NAMED} more"
