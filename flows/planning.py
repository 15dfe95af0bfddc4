"""The rerun rule: which shards of a study are fresh, missing, stale or pending, and why. Nothing is started for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from typing import Any

from flows.records import last_sections, read_last_run
from flows.staleness import Reasons, StageRecord
from flows.study import Study
from pasdedeux.garbage import uncollected
from pasdedeux.verdict import Verdict
from storage_schema import Manifest, ShardRecord, Store
from storage_schema.ancestry import has_lineage
from storage_schema.provenance import source_digest
from tasks.graph import Graph, GraphError
from tasks.stage import Shard, Stage, StageInputs
from tasks.summary import stage_verdict

LastRecords = Callable[[str], StageRecord]
"""Returns the last run's record of a stage, by name."""


class PlanError(Exception):
    """A study cannot be planned as asked; the message is one clear sentence."""


class NothingMadeError(Exception):
    """A requested stage made nothing; the message names what it needs, a stage a line."""


class State(StrEnum):
    """State of a shard: `fresh` needs no work, `pending` is unknown until its inputs exist."""

    FRESH = "fresh"
    MISSING = "missing"
    STALE = "stale"
    PENDING = "pending"


@dataclass(frozen=True)
class StageSelection:
    """The stages that a run may work on; all by default.

    Args:
        only: These stages alone.
        start: This stage and everything that follows from it.
        until: This stage and everything it needs, and the report on these if it needs nothing else (`Graph.only`).
        force: These stages are computed again even if they are fresh.
    """

    only: tuple[str, ...] = ()
    start: str | None = None
    until: str | None = None
    force: tuple[str, ...] = ()

    @property
    def words(self) -> list[str]:
        """Return the options of the command line that select the same."""
        lists, singles = {"only": self.only, "force": self.force}, {"from": self.start, "until": self.until}
        named = {**lists, **{name: (stage,) for name, stage in singles.items() if stage is not None}}
        return [word for name, stages in named.items() for stage in stages for word in (f"--{name}", stage)]

    @property
    def targets(self) -> frozenset[str]:
        """Return the requested stages."""
        return frozenset([*self.only, *self.force, *filter(None, (self.start, self.until))])

    def stages(self, graph: Graph) -> frozenset[str]:
        """Return the names of the selected stages; PlanError for a name that is not in the graph."""
        try:
            for name in sorted(self.targets):
                graph.stage(name)
        except GraphError as error:
            raise PlanError(str(error)) from None
        names = set(graph.names)
        if self.only:
            names &= set(self.only)
        if self.start is not None:
            names &= {self.start, *graph.below(self.start)}
        if self.until is not None:
            wanted = {self.until, *graph.above(self.until)}
            names &= wanted | {stage for stage in graph.reporting if wanted.issuperset(graph.upstream[stage])}
        return frozenset(names)


@dataclass(frozen=True)
class ShardPlan:
    """A shard and its state; `manifest` is its artifact, if it exists."""

    shard: Shard
    state: State
    reason: str = ""
    manifest: Manifest | None = None


@dataclass(frozen=True)
class StagePlan:
    """A stage and the states of its shards; a pending stage has no shards yet, only its last partitions.

    `absent_tables` are inputs that nothing wrote; `is_asked`: the study or the command names the stage.
    """

    stage: Stage
    is_selected: bool
    is_asked: bool = False
    shards: tuple[ShardPlan, ...] = ()
    pending_on: tuple[str, ...] = ()
    last_partitions: tuple[tuple[str, int], ...] = ()
    absent_tables: tuple[str, ...] = ()

    @property
    def is_pending(self) -> bool:
        """Return whether the stage must wait for its inputs to be planned."""
        return bool(self.pending_on)

    @property
    def is_fresh(self) -> bool:
        """Return whether nothing of the stage has to be computed."""
        return not self.is_pending and all(item.state is State.FRESH for item in self.shards)

    @property
    def pending_reason(self) -> str:
        """Return the reason for waiting, in words."""
        when = "rebuilt only if its bytes change" if self.last_partitions else "never built"
        return f"depends on {', '.join(self.pending_on)}; {when}"

    @property
    def empty_reason(self) -> str:
        """Return why a planned stage has no shards, if known; empty if it has some."""
        if self.is_pending or self.shards:
            return ""
        return "nothing to do" + (f" (there are no {', no '.join(self.absent_tables)})" if self.absent_tables else "")

    @property
    def verdict(self) -> Verdict | None:
        """Merge the verdicts of the stage's finished shards."""
        return stage_verdict(self.manifests)

    @property
    def todo(self) -> tuple[Shard, ...]:
        """Return the shards that have to be computed."""
        return tuple(item.shard for item in self.shards if item.state is not State.FRESH)

    @property
    def manifests(self) -> tuple[Manifest, ...]:
        """Return the existing artifacts, in the order of the plan."""
        return tuple(item.manifest for item in self.shards if item.manifest is not None)

    def count(self, state: State) -> int:
        """Return the number of shards in a state."""
        return sum(item.state is state for item in self.shards)

    def to_json(self) -> dict[str, Any]:
        """Return the stage's plan as JSON values."""
        described: dict[str, Any] = {"stage": self.stage.name, "is_selected": self.is_selected}
        if self.is_pending:
            partitions = [{"partition": name, "num_shards": count} for name, count in self.last_partitions]
            return {
                **described,
                "state": State.PENDING.value,
                "reason": self.pending_reason,
                "last_partitions": partitions,
            }
        shards = [
            {
                "partition": item.shard.partition,
                "shard": item.shard.name,
                "key": item.shard.key,
                "state": item.state.value,
                "reason": item.reason,
            }
            for item in self.shards
        ]
        state = "fresh" if self.is_fresh else "unfinished"
        verdict = None if self.verdict is None else self.verdict.to_json()
        return {**described, "state": state, "reason": self.empty_reason, "verdict": verdict, "shards": shards}

    def partitions(self) -> dict[str, list[ShardPlan]]:
        """Return the shards by partition, both in the order of the plan."""
        by_partition: dict[str, list[ShardPlan]] = {}
        for item in self.shards:
            by_partition.setdefault(item.shard.partition, []).append(item)
        return by_partition


@dataclass(frozen=True)
class Plan:
    """The stages of a study in the order they run, with their states."""

    study: str
    stages: tuple[StagePlan, ...]

    @property
    def is_fresh(self) -> bool:
        """Return whether a run would have nothing to do."""
        return all(stage.is_fresh for stage in self.stages if stage.is_selected)

    @property
    def manifests(self) -> tuple[Manifest, ...]:
        """Return the existing artifacts by stage."""
        return tuple(manifest for stage in self.stages for manifest in stage.manifests)

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the missing inputs of requested stages that made nothing, a sentence each."""
        return tuple(text for stage in self.stages if (text := what_is_missing(stage, stage.manifests)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings about fresh stages that were computed by other sources under the same version."""
        now = source_digest()
        names = [s.stage.name for s in self.stages if any(m.source_digest != now for m in s.manifests)]
        if not names:
            return ()
        shown = ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more stages"
        since = f"since {shown} {'was' if len(names) == 1 else 'were'} computed"
        advice = (
            "if results change, raise the stage's version in its `Stage(...)`; --force STAGE computes again in place, "
            "and leaves what a dataset needs as it is"
        )
        return (f"the program's sources have changed {since}, the stage versions have not; {advice}",)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes of the shards for the user, one sentence each."""
        shards = (item.shard for stage in self.stages for item in stage.shards)
        return tuple(dict.fromkeys(f"{shard.partition}: {note}" for shard in shards for note in shard.notes))

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON values, for programs and for the record."""
        return {
            "study": self.study,
            "is_fresh": self.is_fresh,
            "notes": list(self.notes),
            "warnings": list(self.warnings),
            "stages": [stage.to_json() for stage in self.stages],
        }

    def stage(self, name: str) -> StagePlan:
        """Return the plan of one stage."""
        return next(item for item in self.stages if item.stage.name == name)


@uncollected()
def make_plan(study: Study, graph: Graph, store: Store, selection: StageSelection | None = None) -> Plan:
    """Return the state of every stage, from manifests and headers of source files.

    Raises:
        PlanError: An unknown stage is selected, or a selected stage needs one that is neither fresh nor selected.
        InputError, StorageError, OSError: Sources or parameters of a stage cannot be used.
    """
    selection = selection or StageSelection()
    selected = selection.stages(graph)
    asked = (study.asked | selection.targets) & selected
    for stage in graph.stages:
        if stage.check_study is not None and stage.name in selected:
            stage.check_study(study.parameters)
    last = _last_records(store, study.name)
    plans: dict[str, StagePlan] = {}
    for stage in graph.stages:
        needed = graph.needed(stage.name, study.parameters[stage.name])
        waiting = tuple(name for name in needed if not plans[name].is_fresh)
        unselected = [name for name in waiting if name not in selected]
        if unselected and stage.name in selected:
            raise PlanError(
                f"stage {stage.name} needs {unselected[0]}, which is not finished and not selected; "
                f"run without --only and --from, or build it first with --until {unselected[0]}"
            )
        if waiting:
            plans[stage.name] = StagePlan(
                stage=stage,
                is_selected=stage.name in selected,
                is_asked=stage.name in asked,
                pending_on=waiting,
                last_partitions=tuple(Counter(r.partition for r in last(stage.name).shards or ()).items()),
            )
            continue
        inputs = stage_inputs(stage, study.head.seed, {name: plans[name].manifests for name in needed})
        plan = plan_stage(stage, study, inputs, store, last, is_forced=stage.name in selection.force)
        plans[stage.name] = replace(plan, is_selected=stage.name in selected, is_asked=stage.name in asked)
    return Plan(study=study.name, stages=tuple(plans.values()))


def what_is_missing(plan: StagePlan, manifests: Sequence[Manifest]) -> str:
    """Return the needs of a requested stage that made nothing; else empty.

    Args:
        plan: The planned stage.
        manifests: The artifacts of its shards.
    """
    if (
        plan.is_pending
        or not plan.is_selected
        or any(part.rows for manifest in manifests for part in manifest.tables.values())
    ):
        return ""
    if (plan.shards and len(manifests) < len(plan.shards)) or not plan.is_asked:
        return ""
    verdict = stage_verdict(manifests)
    reason = f"{verdict.reason}; " if verdict is not None and verdict.reason else ""
    return f"nothing was made by {plan.stage.name}: {reason}it needs {plan.stage.needs}"


def refuse_nothing(missing: Sequence[str]) -> None:
    """Fail if a requested stage made nothing; results of others are in the store.

    Raises:
        NothingMadeError: Names the stages and their needs.
    """
    if missing:
        raise NothingMadeError("\n       ".join(missing))


def stage_inputs(stage: Stage, seed: int, manifests: Mapping[str, Sequence[Manifest]]) -> StageInputs:
    """Return the inputs of a stage: for each table that it declares, the upstream artifacts with a part of it."""
    return StageInputs(
        manifests={
            table: tuple(m for artifacts in manifests.values() for m in artifacts if table in m.tables)
            for table in stage.reads
        },
        seed=seed,
        empty=tuple(m for artifacts in manifests.values() for m in artifacts if not m.tables),
    )


def plan_stage(
    stage: Stage,
    study: Study,
    inputs: StageInputs,
    store: Store,
    last: LastRecords | None = None,
    *,
    is_forced: bool = False,
) -> StagePlan:
    """Plan a stage's shards and compare each with the store and the last run."""
    last = last or _last_records(store, study.name)
    parameters = study.parameters[stage.name]

    @cache
    def reasons() -> Reasons:
        read = [m for artifacts in inputs.manifests.values() for m in artifacts]
        return Reasons(stage, study.sections_of(stage.name), read, last(stage.name))

    there = {artifact.ref.place for artifacts in (*inputs.manifests.values(), inputs.empty) for artifact in artifacts}
    shards: list[ShardPlan] = []
    seen: dict[str, Shard] = {}
    digests: dict[str, str] = {}
    behind: set[str] = set()
    for shard in stage.plan(inputs, parameters):
        twin = seen.setdefault(shard.key, shard)
        if twin is not shard:
            raise PlanError(
                f"stage {stage.name} plans {shard.partition} {shard.name} twice (also as {twin.partition} {twin.name})"
            )
        manifest = store.find(stage.name, shard.key)
        if manifest is not None:
            # A killed forced run has computed the shards before this one again, and not this one.
            digests[shard.key] = manifest.ref.content_digest
            if shard.after and (
                behind.intersection(shard.after)
                or any(digests.get(ref.key, ref.content_digest) != ref.content_digest for ref in manifest.inputs)
            ):
                behind.add(shard.key)
            # A recomputed artifact of the same content has another key, and the old one may be gone.
            after = frozenset(shard.after)  # a summary waits for all segments
            is_lost = not has_lineage(store, (ref for ref in manifest.inputs if ref.key not in after), there)
            if is_forced or is_lost or shard.key in behind:
                reason = "a shard before it was computed again with other bytes"
                reason = "forced" if is_forced else "what it was computed from is gone" if is_lost else reason
                shards.append(ShardPlan(replace(shard, replaces=True), State.STALE, reason, manifest))
            else:
                shards.append(ShardPlan(shard, State.FRESH, manifest=manifest))
        else:
            is_stale, reason = reasons().why_not_fresh(shard)
            shards.append(ShardPlan(shard, State.STALE if is_stale else State.MISSING, reason))
    unread = () if stage.unread is None else stage.unread(parameters)
    absent = tuple(table for table in stage.reads if not inputs.of(table) and table not in unread)
    return StagePlan(stage=stage, is_selected=True, shards=tuple(shards), absent_tables=absent)


def _last_records(store: Store, study: str) -> LastRecords:
    """Return a function that returns the last run's record of a stage, read on first use."""

    @cache
    def record() -> tuple[Mapping[str, Sequence[ShardRecord]], Mapping[str, Any]]:
        last = read_last_run(store, study)
        return last.stages if last else {}, last_sections(store, last)

    def last(stage: str) -> StageRecord:
        stages, sections = record()
        return StageRecord(stages.get(stage), sections)

    return last
