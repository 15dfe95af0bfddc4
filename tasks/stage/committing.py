"""Commit the results of a shard, with its facts and the artifacts that it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactFields, ArtifactRef, Manifest, SourceCredit, Store
from tasks.stage import Shard
from tasks.stage.facts import Facts
from tasks.stage.judgements import PARTS_FACT, VERDICT_FACT


def artifact_fields(shard: Shard, store: Store) -> ArtifactFields:
    """Return the arguments of `Store.commit` and `Store.writer` for a shard: its name, its key, and its inputs."""
    places = {ref: at for at, ref in enumerate(shard.all_inputs)}
    return {
        "stage": shard.stage,
        "key": shard.key,
        "partition": shard.partition,
        "name": shard.name,
        "version": shard.version,
        "parameters": shard.values,
        "seed": shard.seed,
        "inputs": (*shard.all_inputs, *(manifest.ref for manifest in followed(shard, store))),
        "files": [(Path(file.path).name, file.sha256) for file in shard.files],
        "reads": {what: [places[ref] for ref in refs] for what, refs in shard.inputs.items()},
        "after": shard.after,
        "replaces": shard.replaces,
    }


def commit(
    shard: Shard,
    store: Store,
    *,
    tables: Mapping[str, Mapping[str, Any]],
    facts: Facts,
    attachments: Mapping[str, bytes] | None = None,
    sources: Sequence[SourceCredit] = (),
    verdict: Verdict | None = None,
    parts: Mapping[str, Verdict] | None = None,
) -> ArtifactRef:
    """Commit a shard's tables under its key, and the facts that later planning reads.

    The verdict is stored with the facts for the console and the report, as are the named verdicts of parts, such as
    each person of a sequence, for the report and the table of verdicts.  The manifest names the shard's inputs and the
    artifacts of the shards it follows.
    """
    return store.commit(
        **artifact_fields(shard, store),
        tables=tables,
        attachments=attachments or {},
        facts={
            **facts.to_json(),
            **({} if verdict is None else {VERDICT_FACT: verdict.to_json()}),
            **({PARTS_FACT: {name: part.to_json() for name, part in parts.items()}} if parts else {}),
        },
        sources=sources,
    )


def join_columns(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Concatenate the rows of several parts of a table; lists stay lists, arrays stay arrays."""
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if isinstance(parts[0][name], list)
        else np.concatenate([part[name] for part in parts])
        for name in (parts[0] if parts else ())
    }


def followed(shard: Shard, store: Store) -> list[Manifest]:
    """Return the artifacts of the shards that this one comes after.

    Raises:
        InputError: One is not there.
    """
    manifests = []
    for key in shard.after:
        if (manifest := store.find(shard.stage, key)) is None:
            raise InputError(
                f"{shard.stage}@{key[:12]}, which {shard.partition} {shard.name} continues, is not in the store"
            )
        manifests.append(manifest)
    return manifests
