"""Definition of a stage: what it reads and writes, its parameters, and how it is planned and run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

from pydantic import create_model

from pasdedeux.settings import Settings
from storage_schema import ArtifactRef, Manifest, Store, shard_key

S = TypeVar("S", bound=Settings)
P = TypeVar("P", bound="Parameters")


class Parameters(Settings):
    """Base of every stage's section in a study, and of the parameters of its shards."""

    def part(self, kind: type[S], **more: Any) -> S:
        """Return the parameters of a kind of shard: the settings that it has too, and values of the plan."""
        shared = {name: getattr(self, name) for name in kind.model_fields if name in type(self).model_fields}
        return kind(**shared, **more)


def with_fields(fields: Mapping[str, Any]) -> Callable[[type[P]], type[P]]:
    """Return a decorator that adds fields, given as type and `Field`, to parameters that lack them."""

    def extended(parameters: type[P]) -> type[P]:
        new = {name: field for name, field in fields.items() if name not in parameters.model_fields}
        extended_parameters = create_model(
            parameters.__name__, __base__=parameters, __module__=parameters.__module__, **new
        )
        extended_parameters.__doc__ = parameters.__doc__
        return extended_parameters

    return extended


@dataclass(frozen=True)
class SourceFile:
    """A source file: its bytes enter the key, its path never does."""

    path: str
    sha256: str


@dataclass(frozen=True)
class StageInputs:
    """The artifacts a stage may read, as manifests by table name, in a stable order.

    `empty` are artifacts without tables: they state the skipped work and the reason.
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
        partition: A step as a person sees it: a take, a seed, a split.
        name: Name of the shard, unique in its partition.
        parameters: Everything of the study and of the plan that decides the result.  A stage with several kinds of
            shards has a model for each kind.
        inputs: Artifacts read, by their roles ("seed", "views", ...); names and content digests enter the key.
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
        """Return a shard of the stage; `read` are the artifacts that it reads, by their roles."""
        refs = {
            use: tuple(manifest.ref for manifest in manifests) for use, manifests in (read or {}).items() if manifests
        }
        return Shard(*self, partition, name, parameters, refs, tuple(files), after, inputs.seed, notes=tuple(notes))


@dataclass(frozen=True)
class EarlyPlan:
    """Shards of a stage that are known before all that the stage reads is there; they may start at once.

    The stage's own plan, made when everything is there, decides what the stage consists of: this only gives a start.

    Args:
        plan: Returns shards that the stage's own plan will contain whatever is added; none if that raises InputError.
        reads: Tables that must be complete before.
        each: Tables whose new artifacts are passed alone; each artifact has its own shards.
    """

    plan: Callable[[StageInputs, Any], list[Shard]]
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
        needs: The inputs that it needs, with the keys that give them: the message if it made nothing.
        check_study: Refuses faults independent of the inputs, such as files that cannot be used, from the sections of
            all stages by name: called before anything runs.
        early: Plans of shards that can start before all inputs are there.
        unread: Gives the tables among `reads` that are left alone with these parameters: nothing waits for them.
        adds_to: Tables of another stage that it writes more of; stages that it rests on read those of the other alone.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    parameters: type[Parameters]
    plan: Callable[[StageInputs, Any], list[Shard]]
    run_shard: Callable[[Shard, Store], ArtifactRef]
    meaning: str = ""
    needs: str = ""
    check_study: Callable[[Mapping[str, Any]], None] | None = None
    early: tuple[EarlyPlan, ...] = ()
    unread: Callable[[Any], tuple[str, ...]] | None = None
    adds_to: tuple[str, ...] = ()

    @property
    def tables(self) -> tuple[str, ...]:
        """Every table that it writes a part of."""
        return (*self.writes, *self.adds_to)
