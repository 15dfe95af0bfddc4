"""What a stage is: what it reads and writes, its parameters, how it is planned and run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from storage_schema import ArtifactRef, Manifest, SourceCredit, Store, artifact_key

__all__ = [
    "Parameters",
    "Shard",
    "SourceFile",
    "Stage",
    "StageInputs",
    "artifact_fields",
    "commit",
    "merge_takes",
    "stream",
]


class Parameters(BaseModel):
    """Base of every stage's parameters: frozen, and unknown names are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class SourceFile:
    """A file from outside the store: its bytes enter the key, its path never does."""

    path: str
    sha256: str


@dataclass(frozen=True)
class StageInputs:
    """The artifacts a stage may read, as manifests by table name, in a stable order."""

    manifests: Mapping[str, Sequence[Manifest]]
    seed: int

    def of(self, table: str) -> Sequence[Manifest]:
        """Return the manifests of the artifacts that hold a part of `table`; none when no stage wrote it."""
        return self.manifests.get(table, ())


@dataclass(frozen=True)
class Shard:
    """The unit of work and of commit.

    Args:
        stage: Name of the stage.
        version: Version of the stage, raised by hand when its results change.
        partition: What a person sees as one step: a take, a seed, a split.
        name: Name of the shard, unique in its partition.
        parameters: JSON values: everything of the study and of the plan that decides the result.
        inputs: Artifacts read; their content digests enter the key.
        files: Outside files read; their digests enter the key.
        after: Keys of other shards of the same plan that this one reads; they enter the key.
        seed: Seed of the study.
    """

    stage: str
    version: int
    partition: str
    name: str
    parameters: Mapping[str, Any]
    inputs: tuple[ArtifactRef, ...] = ()
    files: tuple[SourceFile, ...] = ()
    after: tuple[str, ...] = ()
    seed: int = 0

    @cached_property
    def key(self) -> str:
        """Return the sha256 that names the shard's artifact."""
        return artifact_key(
            stage=self.stage,
            version=self.version,
            parameters={"partition": self.partition, "name": self.name, **self.parameters},
            input_digests=[ref.content_digest for ref in self.inputs] + [file.sha256 for file in self.files],
            after=self.after,
            seed=self.seed,
        )


@dataclass(frozen=True)
class Stage:
    """A stage of the graph.

    Args:
        name: Name of the stage, also its section in a study.
        version: Raised by hand when the stage's results change.
        reads: Tables it reads; the graph follows from them.
        writes: Tables it writes.
        parameters: Model of its section in a study.
        plan: Gives the shards for these inputs and parameters; reads manifests, never data.
        run_shard: Computes one shard and commits it.
        meaning: One line for people.
        check: Refuses parameters that can be told to be wrong without any input, such as files that cannot be used:
            called before anything runs, also while the stage waits for what it reads.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    parameters: type[Parameters]
    plan: Callable[[StageInputs, Any], list[Shard]] = field(repr=False)
    run_shard: Callable[[Shard, Store], ArtifactRef] = field(repr=False)
    meaning: str = ""
    check: Callable[[Any], None] | None = field(default=None, repr=False)


def merge_takes(*manifests: Manifest) -> list[str]:
    """Return the takes that any of these artifacts learned from or shows, sorted."""
    return sorted({take for manifest in manifests for take in manifest.facts.get("takes", [])})


def artifact_fields(shard: Shard, store: Store) -> dict[str, Any]:
    """Return what `Store.commit` and `Store.writer` must know of a shard: its name, its key, and what it reads."""
    return {
        "stage": shard.stage,
        "key": shard.key,
        "partition": shard.partition,
        "name": shard.name,
        "version": shard.version,
        "parameters": shard.parameters,
        "seed": shard.seed,
        "inputs": (*shard.inputs, *_committed(shard, store)),
        "files": [(Path(file.path).name, file.sha256) for file in shard.files],
    }


def commit(
    shard: Shard,
    store: Store,
    *,
    tables: Mapping[str, Mapping[str, Any]],
    facts: Mapping[str, Any],
    attachments: Mapping[str, bytes] | None = None,
    sources: Sequence[SourceCredit] = (),
) -> ArtifactRef:
    """Commit a shard's tables under its key; `facts` are the small JSON facts that later planning reads.

    The manifest names the shard's inputs and the artifacts of the shards it follows.
    """
    return store.commit(
        **artifact_fields(shard, store),
        tables=tables,
        attachments=attachments or {},
        facts=facts,
        sources=sources,
    )


def _committed(shard: Shard, store: Store) -> list[ArtifactRef]:
    """Return the artifacts of the shards that this one follows, so that lineage and credits pass through them."""
    found = [store.find(shard.stage, key) for key in shard.after]
    return [manifest.ref for manifest in found if manifest is not None]


def stream(seed: int, *labels: str | int) -> np.random.Generator:
    """Return the random generator of (seed, labels...): the labels say what it is for, never who runs it.

    Text labels enter by their sha256, so streams of different labels are independent.
    """
    words = [seed]
    for label in labels:
        if isinstance(label, int):
            words.append(label)
        else:
            digest = hashlib.sha256(label.encode()).digest()
            words.extend(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(words))
