"""What a stage is: what it reads and writes, its parameters, how it is planned and run."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from pydantic import create_model

from pasdedeux.errors import InputError
from pasdedeux.settings import Settings
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactFields, ArtifactRef, Manifest, SourceCredit, Store, shard_key
from tasks.facts import Facts

VERDICT_FACT, PARTS_FACT = "verdict", "verdicts_of_parts"
"""Names under which a shard's verdict, and those of its parts, stand among its facts."""


S = TypeVar("S", bound=Settings)
F = TypeVar("F", bound=Callable[..., Any])
P = TypeVar("P", bound="Parameters")


class Parameters(Settings):
    """Base of every stage's section in a study, and of the parameters of its shards."""

    def part(self, kind: type[S], **more: Any) -> S:
        """Return the parameters of a kind of shard: the settings that `kind` has too, and what only the plan knows."""
        shared = {name: getattr(self, name) for name in kind.model_fields if name in type(self).model_fields}
        return kind(**shared, **more)


def with_fields(fields: Mapping[str, Any]) -> Callable[[type[P]], type[P]]:
    """Return a decorator that adds fields, each as its type and `Field`, to parameters, but those that they have."""

    def extended(parameters: type[P]) -> type[P]:
        new = {name: field for name, field in fields.items() if name not in parameters.model_fields}
        made = create_model(parameters.__name__, __base__=parameters, __module__=parameters.__module__, **new)
        made.__doc__ = parameters.__doc__
        return made

    return extended


@dataclass(frozen=True)
class SourceFile:
    """A source file: its bytes enter the key, its path never does."""

    path: str
    sha256: str


@dataclass(frozen=True)
class StageInputs:
    """The artifacts a stage may read, as manifests by table name, in a stable order.

    `empty` are those that hold no table: they say what was skipped, and why.
    """

    manifests: Mapping[str, Sequence[Manifest]]
    seed: int
    empty: Sequence[Manifest] = ()

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
        parameters: Everything of the study and of the plan that decides the result.  A stage with several kinds of
            shards has a model for each kind.
        inputs: Artifacts read, by what they are to the shard ("seed", "views", ...); names and content digests enter
            the key.
        files: Outside files read; their digests enter the key.
        after: Keys of other shards of the same plan that this one reads; they enter the key.
        seed: Seed of the study.
        replaces: Whether its artifact takes the place of the one that is there; no part of the key.
        notes: What a user should know of it before it runs, a sentence each; no part of the key.
    """

    stage: str
    version: int
    partition: str
    name: str
    parameters: Parameters
    inputs: Mapping[str, tuple[ArtifactRef, ...]] = field(default_factory=dict)
    files: tuple[SourceFile, ...] = ()
    after: tuple[str, ...] = ()
    seed: int = 0
    replaces: bool = False
    notes: tuple[str, ...] = field(default=(), compare=False)

    @property
    def values(self) -> Mapping[str, Any]:
        """The parameters as JSON values, as the key and the manifest have them."""
        return self.parameters.model_dump(mode="json")

    @cached_property
    def key(self) -> str:
        """Return the sha256 that names the shard's artifact."""
        return shard_key(
            stage=self.stage,
            version=self.version,
            partition=self.partition,
            name=self.name,
            parameters=self.values,
            reads={what: [ref.content_digest for ref in refs] for what, refs in self.inputs.items()},
            files=[file.sha256 for file in self.files],
            after=self.after,
            seed=self.seed,
        )

    @property
    def all_inputs(self) -> tuple[ArtifactRef, ...]:
        """Every artifact that the shard reads, once each, in the order in which they are named."""
        return tuple(dict.fromkeys(ref for refs in self.inputs.values() for ref in refs))

    def options(self, kind: type[P]) -> P:
        """Return the parameters, which are of this model."""
        assert isinstance(self.parameters, kind)
        return self.parameters

    def refs(self, name: str) -> tuple[ArtifactRef, ...]:
        """Return the inputs of this name; none where the shard has none."""
        return self.inputs.get(name, ())

    def ref(self, name: str) -> ArtifactRef:
        """Return the one input of this name."""
        (ref,) = self.inputs[name]
        return ref


class StageName(NamedTuple):
    """A stage by its name, and the version of its results, which enters every key."""

    name: str
    version: int

    def shard(
        self,
        inputs: StageInputs,
        partition: str,
        name: str,
        parameters: Parameters,
        read: Mapping[str, Sequence[Manifest]] | None = None,
        *,
        files: Sequence[SourceFile] = (),
        after: tuple[str, ...] = (),
        notes: Iterable[str] = (),
    ) -> Shard:
        """Return a shard of the stage; `read` are the artifacts that it reads, by what they are to it."""
        refs = {use: tuple(manifest.ref for manifest in found) for use, found in (read or {}).items() if found}
        return Shard(*self, partition, name, parameters, refs, tuple(files), after, inputs.seed, notes=tuple(notes))


@dataclass(frozen=True)
class EarlyPlan:
    """Shards of a stage that are known before all that the stage reads is there; they may start at once.

    What a stage consists of is always what its own plan says when all is there: this only says what to begin with.

    Args:
        plan: Gives shards that the stage's own plan gives too, whatever else comes; none where it raises InputError.
        reads: Tables that must be there as a whole before.
        each: Tables of which some artifacts are given, those that are new: each has shards of its own.
    """

    plan: Callable[[StageInputs, Any], list[Shard]] = field(repr=False)
    reads: tuple[str, ...] = ()
    each: tuple[str, ...] = ()


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
        needs: What it makes something of, with the keys that give it: the message where it made nothing.
        check_study: Refuses what is wrong whatever the inputs, such as files that cannot be used, from the sections of
            all stages by name: called before anything runs.
        early: What can be begun with before all that it reads is there.
        unread: Gives the tables among `reads` that are left alone with these parameters: nothing waits for them.
        adds_to: Tables of another stage that it writes more of; stages that it rests on read those of the other alone.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    parameters: type[Parameters]
    plan: Callable[[StageInputs, Any], list[Shard]] = field(repr=False)
    run_shard: Callable[[Shard, Store], ArtifactRef] = field(repr=False)
    meaning: str = ""
    needs: str = ""
    check_study: Callable[[Mapping[str, Any]], None] | None = field(default=None, repr=False)
    early: tuple[EarlyPlan, ...] = field(default=(), repr=False)
    unread: Callable[[Any], tuple[str, ...]] | None = field(default=None, repr=False)
    adds_to: tuple[str, ...] = ()

    @property
    def tables(self) -> tuple[str, ...]:
        """Every table that it writes a part of."""
        return (*self.writes, *self.adds_to)


_KEPT: list[Callable[[], None]] = []


def kept(count: int = 1) -> Callable[[F], F]:
    """Return a decorator: a worker keeps what the last `count` calls that differ gave, from shard to shard of a stage.

    For what many shards make ready alike; until `forget_kept`.
    """

    def decorated(function: F) -> F:
        cached = lru_cache(maxsize=count)(function)
        _KEPT.append(cached.cache_clear)
        return cast(F, cached)

    return decorated


def forget_kept() -> None:
    """Give back the memory of all that is kept."""
    for forget in _KEPT:
        forget()
    with suppress(AttributeError, OSError):  # another C library gives it back by itself, or has no name for that
        ctypes.CDLL(None).malloc_trim(0)


def merge_takes(*manifests: Manifest) -> tuple[str, ...]:
    """Return the takes that any of these artifacts learned from or shows, sorted."""
    return tuple(sorted({take for manifest in manifests for take in Facts.of(manifest).takes}))


def shares_takes(one: Manifest, other: Manifest) -> bool:
    """Tell whether two artifacts rest on a common take."""
    return not set(Facts.of(one).takes).isdisjoint(Facts.of(other).takes)


def artifact_fields(shard: Shard, store: Store) -> ArtifactFields:
    """Return what `Store.commit` and `Store.writer` must know of a shard: its name, its key, and what it reads."""
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

    A verdict is kept with the facts, for the console and the report; so are those of its parts by name, such as each
    person of a sequence, for the report and the table of verdicts.  The manifest names the shard's inputs and the
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
    """Return the rows of several parts of a table as one, lists as lists and arrays as arrays; no column of no part."""
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if isinstance(parts[0][name], list)
        else np.concatenate([part[name] for part in parts])
        for name in (parts[0] if parts else ())
    }


def verdict_of(manifest: Manifest) -> Verdict | None:
    """Return what a shard thinks of its result; None where it judged nothing."""
    values = manifest.facts.get(VERDICT_FACT)
    return None if values is None else Verdict.from_json(values)


def verdicts_of_parts(manifest: Manifest) -> dict[str, Verdict]:
    """Return what a shard thinks of the parts of its result, by name; empty where it judged none."""
    return {name: Verdict.from_json(values) for name, values in manifest.facts.get(PARTS_FACT, {}).items()}


def followed(shard: Shard, store: Store) -> list[Manifest]:
    """Return the artifacts of the shards that this one comes after.

    Raises:
        InputError: One is not there.
    """
    found = []
    for key in shard.after:
        if (manifest := store.find(shard.stage, key)) is None:
            raise InputError(
                f"{shard.stage}@{key[:12]}, which {shard.partition} {shard.name} continues, is not in the store"
            )
        found.append(manifest)
    return found


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
