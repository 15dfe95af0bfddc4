"""The driver of a run: plans a stage once its inputs are committed, submits its shards, and records it when complete.

Each stage is a task from its first shard to its record. The task only shows progress; the driver does the work.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from graphlib import TopologicalSorter
from itertools import islice
from queue import Empty, SimpleQueue
from threading import Event

from flows.outcomes import Run, StageOutcome
from flows.planning import Plan, StagePlan, State, plan_stage, stage_inputs
from flows.progress import PartitionCount, Tally
from flows.records import record_stage
from pasdedeux.errors import InputError
from storage_schema import Manifest
from tasks.graph import Graph
from tasks.shards import Pool, ShardDone, ShardError, ShardFailed, Stopped, join_failures
from tasks.stage import EarlyPlan, Shard, StageInputs

_STAGE_FIRST = 1_000_000
"""Weight of a stage's urgency against the number of shards that wait for a shard."""
_POLL_S = 0.2
_SHOWN_S = 60.0
"""Interval at which the partitions of a running stage are shown."""
_NAMED = 5
"""Number of skipped shards that are named."""

ShowPartitions = Callable[[Sequence[PartitionCount]], None]
StartTask = Callable[[str, Callable[[ShowPartitions], None]], object]
"""Starts the task of a stage in a thread; the work receives a function that shows the partitions."""


@dataclass(eq=False)
class _StageWork:
    """A stage of the run, from its first plan to its record.

    Args:
        plan: The plan made beforehand; once its inputs are complete, the final plan (`is_planned`).
        urgency: Its rank among the stages; the least urgent is 0.
        early: Its early plans, each with the number of the run's artifacts that it has seen.
        made: Its artifacts; None until all exist.
        num_left: Its running shards.
        failed: Its shards that failed, or were skipped because an earlier one failed.
        refusal: Why it cannot be planned.
        is_skipped: A stage that it needs failed.
        is_begun: It has a task.
        ended: Nothing is left to do for it.
    """

    plan: StagePlan
    urgency: int
    early: dict[EarlyPlan, int]
    made: tuple[Manifest, ...] | None
    num_left: int = 0
    failed: list[ShardFailed] = field(default_factory=list)
    refusal: InputError | None = None
    is_planned: bool = False
    is_skipped: bool = False
    is_begun: bool = False
    ended: Event = field(default_factory=Event)
    started: float = 0.0
    outcome: StageOutcome | None = None

    @property
    def error(self) -> ShardError | InputError | None:
        """Return why it failed; None if it did not, or only because a stage that it needs failed."""
        tried = sorted((end.error for end in self.failed if not end.is_behind), key=lambda error: error.where)
        return self.refusal or (join_failures(tried) if tried else None)

    @property
    def is_lost(self) -> bool:
        """Return whether the stages that need it can no longer be planned."""
        return bool(self.failed) or self.refusal is not None or self.is_skipped

    @property
    def is_waiting(self) -> bool:
        """Return whether it waits for its inputs."""
        return self.made is None and self.refusal is None and not (self.is_planned or self.is_skipped)


class Build:
    """Brings the stages of a plan up to date.

    Args:
        run: The run to execute.
        run_id: Name of the run, for the record.
        plan: The plan made beforehand.
        pool: Computes shards.
        start_task: Starts the task of a stage; without it there are no tasks.
    """

    def __init__(self, run: Run, run_id: str, plan: Plan, pool: Pool, start_task: StartTask | None = None) -> None:
        self._run, self._run_id, self._pool, self._start_task = run, run_id, pool, start_task
        urgency = {name: place for place, name in enumerate(by_urgency(run.graph))}
        self._work: dict[str, _StageWork] = {}
        for first in plan.stages:
            name, manifests = first.stage.name, None if first.is_selected else first.manifests
            early = () if manifests is not None or name in run.selection.force else first.stage.early
            self._work[name] = _StageWork(first, urgency[name], dict.fromkeys(early, 0), manifests)
        self._begun = set[str]()
        self._priority: dict[str, int] = {}  # of shards in work
        self._made: dict[str, Manifest] = {}
        self.done: list[ShardDone] = []
        self._tally = Tally(run.store, run.study.name)
        self._ended: SimpleQueue[Shard] = SimpleQueue()

    @property
    def outcomes(self) -> tuple[StageOutcome, ...]:
        """Return the outcomes of complete stages, in the order of the graph."""
        return tuple(work.outcome for work in self._work.values() if work.outcome is not None)

    def bring_up_to_date(self, is_interrupted: Callable[[], bool]) -> None:
        """Compute everything that can be computed.

        Raises:
            ShardError, InputError: Something failed.
            ClusterError: No worker is left.
            KeyboardInterrupt: `is_interrupted` returned true.
        """
        self._advance()
        while self._priority:
            if is_interrupted():
                raise KeyboardInterrupt
            if (ended := self._next()) is not None:
                self._settle(ended)
                self._advance()
        self._raise_failures()

    def end(self) -> None:
        """End the tasks, and cancel shards that have not ended."""
        try:
            self._pool.give_up()
        finally:
            for work in self._work.values():
                work.ended.set()

    def _follow(self, work: _StageWork, show: ShowPartitions) -> None:
        """Run the task of a stage: show its partitions until it ends, and raise its error."""
        is_over = False
        while not is_over:
            is_over = work.ended.wait(_SHOWN_S)
            show(self._tally.partitions(work.plan.stage.name))
        if work.error is not None:
            raise work.error
        if work.outcome is None:
            raise Stopped("given up")

    def _next(self) -> ShardDone | ShardFailed | None:
        """Return how the next shard ended; None if none ends within a moment."""
        self._pool.work()
        with suppress(Empty):
            shard = self._ended.get(timeout=_POLL_S)
            if (ended := self._pool.ended(shard)) is None:
                self._ended.put(shard)  # it is computed again
            return ended
        return None

    def _settle(self, ended: ShardDone | ShardFailed) -> None:
        """Record the end of a shard."""
        shard, work = ended.shard, self._work[ended.shard.stage]
        del self._priority[shard.key]
        self._tally.end(ended)
        if isinstance(ended, ShardDone):
            self._made[shard.key] = self._run.store.manifest(ended.ref)
            self.done.append(ended)
            self._run.listener.shard_done(ended)
        elif ended.error.is_fatal:
            raise ended.error
        else:
            work.failed.append(ended)
        work.num_left -= 1
        self._close(work)

    def _advance(self) -> None:
        """Begin every stage that can be planned, begin early plans of the others, and report progress."""
        for name, work in self._work.items():
            if work.is_waiting:
                needed = self._run.graph.needed(name, self._run.study.parameters[name])
                above = {other: self._work[other] for other in needed}
                work.is_skipped = any(planned.is_lost for planned in above.values())
                manifests = {other: planned.made for other, planned in above.items() if planned.made is not None}
                if len(manifests) == len(above):
                    self._begin(work, manifests)
            for early in list(work.early):
                self._begin_early(work, early)
        waiting = [work.plan for work in self._work.values() if work.is_waiting]
        self._run.listener.progressed(self._tally.progress(waiting, self._pool.num_workers))

    def _begin(self, work: _StageWork, manifests: dict[str, tuple[Manifest, ...]]) -> None:
        """Plan a stage whose inputs are complete, and submit its shards."""
        plan, stage, run = work.plan, work.plan.stage, self._run
        work.early = {}
        if plan.is_pending:
            try:
                inputs = stage_inputs(stage, run.study.head.seed, manifests)
                plan = plan_stage(stage, run.study, inputs, run.store, is_forced=stage.name in run.selection.force)
            except InputError as error:
                work.refusal = error
                return
            # A shard of this run counts as its work, also if it is committed and the message was not read yet.
            shards = (replace(i, state=State.MISSING) if i.shard.key in self._begun else i for i in plan.shards)
            plan = replace(plan, is_asked=work.plan.is_asked, shards=tuple(shards))
        for item in plan.shards:
            if item.manifest is not None and not item.shard.replaces and item.shard.key not in self._begun:
                self._made[item.shard.key] = item.manifest
        run.listener.stage_started(plan)
        work.plan, work.is_planned, work.started = plan, True, time.perf_counter()
        self._take(work, plan.todo)
        self._close(work)

    def _begin_early(self, work: _StageWork, early: EarlyPlan) -> None:
        """Submit the shards of an early plan, which are certain before the stage can be planned."""
        stage, run = work.plan.stage, self._run
        above = [self._work[name] for name in run.graph.upstream[stage.name]]
        above = [other for other in above if set(early.reads).intersection(other.plan.stage.tables)]
        unseen = islice(self._made.values(), work.early[early], None)
        new = [manifest for manifest in unseen if set(early.each).intersection(manifest.tables)]
        if (early.each and not new) or any(other.made is None for other in above):
            return
        work.early[early] = len(self._made)
        if not early.each:
            del work.early[early]
        there = [manifest for other in above for manifest in other.made or ()]
        held = {table: tuple(manifest for manifest in there if table in manifest.tables) for table in early.reads}
        held |= {table: tuple(manifest for manifest in new if table in manifest.tables) for table in early.each}
        with suppress(InputError):  # reported when the stage is planned
            shards = early.plan(StageInputs(manifests=held, seed=run.study.head.seed), run.study.parameters[stage.name])
            self._take(work, [shard for shard in shards if run.store.find(stage.name, shard.key) is None])

    def _take(self, work: _StageWork, shards: Iterable[Shard]) -> None:
        """Submit new shards, those with the longest chain of dependants first."""
        new = {planned_shard.key: planned_shard for planned_shard in shards if planned_shard.key not in self._begun}
        before = {key: [other for other in planned_shard.after if other in new] for key, planned_shard in new.items()}
        order = list(TopologicalSorter(before).static_order())
        behind = dict.fromkeys(order, 0)
        for key in reversed(order):
            for other in before[key]:
                behind[other] = max(behind[other], behind[key] + 1)
        if order and not work.is_begun and self._start_task is not None:
            work.is_begun = True
            self._start_task(work.plan.stage.name, partial(self._follow, work))
        for key in order:
            shard = new[key]
            # A shard never has a higher priority than a running one that it waits for.
            ahead = (self._priority[other] for other in shard.after if other in self._priority)
            self._priority[key] = min([work.urgency * _STAGE_FIRST + behind[key], *ahead])
            self._begun.add(key)
            self._tally.add(shard, self._priority[key])
            work.num_left += 1
            self._pool.submit(work.plan.stage.run_shard, shard, self._priority[key], self._ended.put)

    def _close(self, work: _StageWork) -> None:
        """Record a planned stage when it is complete, and end its task when none of its shards is left."""
        if not work.is_planned or work.num_left:
            return
        if not work.failed:
            run, stage = self._run, work.plan.stage
            manifests = tuple(self._made[item.shard.key] for item in work.plan.shards)
            record_stage(run.store, run.study.name, self._run_id, stage.name, manifests)
            seconds = time.perf_counter() - work.started
            work.made, work.outcome = manifests, StageOutcome.of(work.plan, manifests, seconds)
            run.listener.stage_finished(work.plan, seconds, work.outcome.verdict)
        work.ended.set()

    def _raise_failures(self) -> None:
        """Raise one error for all failures, stage by stage, and note the work skipped because of them."""
        errors = {name: error for name, work in self._work.items() if (error := work.error) is not None}
        behind = [end.shard for work in self._work.values() for end in work.failed if end.is_behind]
        not_run = [name for name, work in self._work.items() if work.is_skipped]
        not_run += [f"{shard.stage} {shard.partition} {shard.name}" for shard in behind[:_NAMED]]
        not_run += [f"{len(behind) - _NAMED} more shards"] if len(behind) > _NAMED else []
        if not_run:
            self._run.listener.note(f"not run, as they need what failed: {', '.join(not_run)}")
        if len(errors) == 1:
            raise next(iter(errors.values()))
        if errors:
            raise join_failures([_as_shard_error(name, error) for name, error in errors.items()])


def _as_shard_error(stage: str, error: ShardError | InputError) -> ShardError:
    return error if isinstance(error, ShardError) else ShardError(f"stage {stage}", type(error).__name__, str(error))


def by_urgency(graph: Graph) -> list[str]:
    """Return the stages, the least urgent first.

    Ties are broken by stage, because the shards of one stage share caches.
    """
    behind = stages_behind(graph)  # the last stage first
    return sorted(behind, key=behind.__getitem__)


def stages_behind(graph: Graph) -> dict[str, int]:
    """Return for each stage the length of the longest chain of stages that wait for it."""
    behind: dict[str, int] = {}
    for name in reversed(graph.names):
        below = [behind[other] for other in behind if name in graph.upstream[other]]
        behind[name] = 1 + max(below, default=0)
    return behind
