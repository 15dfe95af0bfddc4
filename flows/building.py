"""The driver of a run: plans a stage when what it reads is committed, and gives its shards to tasks.

A task is a partition of a stage, done in a thread: it submits the shards that it is given, the longest chain first, and
collects them.  Only the driver plans and records.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from graphlib import TopologicalSorter
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

from flows.outcomes import Run, StageOutcome
from flows.planning import Plan, StagePlan, State, plan_stage, stage_inputs
from flows.progress import Tally
from flows.records import record_stage
from pasdedeux.errors import InputError
from storage_schema import Manifest
from tasks.graph import Graph
from tasks.shards import Pool, ShardDone, ShardError, ShardFailed, Stopped, joined
from tasks.stage import EarlyPlan, Shard, Stage, StageInputs

MAX_TASKS = 200
"""Of a stage; where it has more partitions, a task has several."""
_STAGE_FIRST = 1_000_000
"""By which the priority of a stage counts more than that of a shard that has as many shards after it."""
_POLL_S = 0.2
_NAMED = 5
"""Of what was not run, so many are named."""

StartTask = Callable[[str, str, Callable[[], None]], Any]
"""Starts a task in a thread: its stage, its name, and what it does; returns a future."""


@dataclass(eq=False)
class _Task:
    """Partitions of a stage in work.

    Args:
        stage: The stage.
        inbox: Gets shards to submit with their priorities, each shard again when it has ended, and None: no more.
        waiting: Shards that wait for those of other tasks, in an order in which they can be computed.
        given: Keys of those that were handed over.
        num_left: Shards that have not ended.
    """

    stage: Stage
    inbox: SimpleQueue[list[tuple[Shard, int]] | Shard | None] = field(default_factory=SimpleQueue)
    waiting: list[tuple[Shard, int]] = field(default_factory=list)
    given: set[str] = field(default_factory=set)
    num_left: int = 0
    is_begun: bool = False


@dataclass(eq=False)
class _StageWork:
    """A stage of the run, from its first plan to its record.

    Args:
        first: The plan made beforehand.
        urgency: Stages, one after the other, that wait for it.
        arrived: For each early plan that can still give shards, the artifacts that it has not seen.
        plan: What it consists of; None before all that it reads is there.
        left: Keys of its shards that have not ended.
        made: Its artifacts; None before all are there.
        error: Why it failed.
        is_skipped: A stage that it needs failed.
    """

    first: StagePlan
    urgency: int
    arrived: dict[EarlyPlan, list[Manifest]]
    tasks: list[_Task] = field(default_factory=list)
    plan: StagePlan | None = None
    left: set[str] = field(default_factory=set)
    started: float = field(default_factory=time.perf_counter)
    made: tuple[Manifest, ...] | None = None
    outcome: StageOutcome | None = None
    error: ShardError | InputError | None = None
    is_skipped: bool = False

    @property
    def is_unplanned(self) -> bool:
        """Return whether it waits for what it reads."""
        return self.plan is None and self.made is None and self.error is None and not self.is_skipped


class Build:
    """Brings the stages of a plan up to date.

    Args:
        run: What is to be built.
        run_id: Name of the run, for the record.
        plan: The plan made beforehand.
        pool: Computes shards.
        start_task: Starts tasks.
    """

    def __init__(self, run: Run, run_id: str, plan: Plan, pool: Pool, start_task: StartTask) -> None:
        self._run, self._run_id, self._pool, self._start_task = run, run_id, pool, start_task
        urgency = stages_behind(run.graph)
        self._work: dict[str, _StageWork] = {}
        for first in plan.stages:
            arrived: dict[EarlyPlan, list[Manifest]] = {early: [] for early in first.stage.early if first.is_selected}
            made = None if first.is_selected else first.manifests
            self._work[first.stage.name] = _StageWork(first, urgency[first.stage.name], arrived, made=made)
        self._task_of: dict[tuple[str, str], _Task] = {}
        self._flying: set[str] = set()
        self._ended: dict[str, ShardDone | ShardFailed] = {}
        self._made: dict[str, Manifest] = {}
        self._tally = Tally(run.store, run.study.name)
        self._messages: SimpleQueue[ShardDone | ShardFailed | Exception | None] = SimpleQueue()
        self._is_over = False

    @property
    def outcomes(self) -> tuple[StageOutcome, ...]:
        """Return what was done for the stages that are whole, in the order of the graph."""
        return tuple(work.outcome for work in self._work.values() if work.outcome is not None)

    def bring_up_to_date(self, is_interrupted: Callable[[], bool]) -> None:
        """Work until nothing is left that can be done.

        Raises:
            ShardError, InputError: Something failed.
            ClusterError: There is nobody left to compute.
            KeyboardInterrupt: `is_interrupted` said so.
        """
        self._advance()
        while self._flying:
            if is_interrupted():
                raise KeyboardInterrupt
            if (ended := self._next()) is not None:
                self._settle(ended)
                self._release()
                self._advance()
        self._raise_failures()

    def end_tasks(self) -> None:
        """End the tasks, and cancel shards that have not ended."""
        self._is_over = True
        for work in self._work.values():
            for task in work.tasks:
                task.inbox.put(None)
        self._pool.give_up()

    def _do_task(self, task: _Task) -> None:
        """Run a task: submit its shards, collect them."""
        task.is_begun = True
        num_left, failures = 0, []
        try:
            while (message := task.inbox.get()) is not None:
                if isinstance(message, list):
                    num_left += len(message)
                    for shard, priority in message:
                        self._pool.submit(task.stage.run_shard, shard, priority, task.inbox.put)
                    self._messages.put(None)
                elif (ended := self._pool.ended(message)) is None:
                    task.inbox.put(message)
                else:
                    num_left -= 1
                    failures += [ended.error] if isinstance(ended, ShardFailed) and not ended.is_behind else []
                    self._messages.put(ended)
        except Exception as error:
            self._messages.put(error)
            raise
        if failures:
            raise joined(failures)
        if num_left:
            raise Stopped("given up")

    def _next(self) -> ShardDone | ShardFailed | None:
        """Return a shard that ended, None where none has within a moment; raise errors of tasks and pool."""
        is_computed = self._pool.work()
        while True:
            try:
                message = self._messages.get(timeout=_POLL_S)
            except Empty:
                return None
            if isinstance(message, Exception):
                raise message
            if message is not None or not is_computed:
                return message

    def _settle(self, ended: ShardDone | ShardFailed) -> None:
        """Record the end of a shard."""
        shard, work = ended.shard, self._work[ended.shard.stage]
        self._flying.discard(shard.key)
        self._ended[shard.key] = ended
        self._tally.end(ended)
        if isinstance(ended, ShardDone):
            self._announce(self._run.store.manifest(ended.ref))
            self._run.listener.shard_done(ended)
        elif ended.error.is_fatal:
            raise ended.error
        self._task_of[shard.stage, shard.partition].num_left -= 1
        work.left.discard(shard.key)
        self._close(work)

    def _advance(self) -> None:
        """Begin every stage that can be planned, early plans of others, and report progress."""
        for name, work in self._work.items():
            if work.is_unplanned:
                upstream = self._run.graph.needed(name, self._run.study.parameters[name])
                above = {other: self._work[other] for other in upstream}
                work.is_skipped = any(one.error or one.is_skipped for one in above.values())
                made = {other: one.made for other, one in above.items() if one.made is not None}
                if len(made) == len(above):
                    self._begin(work, made)
        for name, work in self._work.items():
            if (work.is_unplanned or work.is_skipped) and name not in self._run.selection.force:
                for early in list(work.arrived):
                    self._begin_early(work, early)
        waiting = [work.first for work in self._work.values() if work.is_unplanned]
        self._run.listener.progressed(self._tally.progress(waiting, self._pool.num_workers))

    def _begin(self, work: _StageWork, made: dict[str, tuple[Manifest, ...]]) -> None:
        """Plan a stage of which all that it reads is there, by stage, and have it computed."""
        plan, stage, run = work.first, work.first.stage, self._run
        # What this run began is its work, also where it is committed and no message of that was read yet.
        begun = self._flying | {key for key, ended in self._ended.items() if isinstance(ended, ShardDone)}
        if plan.is_pending:
            is_forced = stage.name in run.selection.force
            try:
                inputs = stage_inputs(stage, run.study.head.seed, made)
                plan = plan_stage(stage, run.study, inputs, run.store, is_forced=is_forced)
            except InputError as error:
                work.error = error
                return
            shards = tuple(replace(i, state=State.MISSING) if i.shard.key in begun else i for i in plan.shards)
            plan = replace(plan, is_asked=work.first.is_asked, shards=shards)
        for item in plan.shards:
            if item.manifest is not None and not item.shard.replaces and item.shard.key not in begun:
                self._announce(item.manifest)
        run.listener.stage_started(plan)
        work.plan, work.started = plan, time.perf_counter()
        self._take(work, plan.todo)
        work.left = self._flying.intersection(shard.key for shard in plan.todo)
        self._close(work)

    def _begin_early(self, work: _StageWork, early: EarlyPlan) -> None:
        """Submit the shards of an early plan: those certain before the stage can be planned."""
        arrived = work.arrived[early]
        graph = self._run.graph
        above = [self._work[name] for name in graph.upstream[work.first.stage.name]]
        above = [other for other in above if set(early.reads).intersection(other.first.stage.tables)]
        if (early.each and not arrived) or any(other.made is None for other in above):
            return
        there = [manifest for other in above for manifest in other.made or ()]
        held = {table: tuple(one for one in there if table in one.tables) for table in early.reads}
        held |= {table: tuple(one for one in arrived if table in one.tables) for table in early.each}
        if early.each:
            work.arrived[early] = []
        else:
            del work.arrived[early]
        stage, study = work.first.stage, self._run.study
        with suppress(InputError):  # said when the stage is planned
            shards = early.plan(StageInputs(manifests=held, seed=study.head.seed), study.parameters[stage.name])
            self._take(work, [shard for shard in shards if self._run.store.find(stage.name, shard.key) is None])

    def _take(self, work: _StageWork, shards: Iterable[Shard]) -> None:
        """Submit shards of a stage that were not submitted before, those with the longest chain behind them first."""
        new = {one.key: one for one in shards if one.key not in self._flying and one.key not in self._ended}
        before = {key: [other for other in one.after if other in new] for key, one in new.items()}
        order = list(TopologicalSorter(before).static_order())
        followers = dict.fromkeys(order, 0)
        for key in reversed(order):
            for other in before[key]:
                followers[other] = max(followers[other], followers[key] + 1)
        for key in order:
            shard, priority = new[key], work.urgency * _STAGE_FIRST + followers[key]
            self._flying.add(key)
            self._tally.add(shard, priority)
            task = self._task_of.get((shard.stage, shard.partition)) or self._new_task(work, shard)
            task.num_left += 1
            task.waiting.append((shard, priority))
        self._release()

    def _new_task(self, work: _StageWork, shard: Shard) -> _Task:
        """Return the task of a partition that had none: its own, or where there are many one that others have too."""
        is_more = len(work.tasks) < MAX_TASKS
        work.tasks += [_Task(work.first.stage)] if is_more else []
        task = work.tasks[-1 if is_more else len(self._task_of) % MAX_TASKS]
        self._task_of[shard.stage, shard.partition] = task
        return task

    def _release(self) -> None:
        """Hand over shards that wait for no other task."""
        for task in (task for work in self._work.values() for task in work.tasks if task.waiting):
            ready: list[tuple[Shard, int]] = []
            for shard, priority in task.waiting:
                if all(key in task.given or key not in self._flying for key in shard.after):
                    task.given.add(shard.key)
                    ready.append((shard, priority))
            is_new = len(task.given) == len(ready)
            task.waiting = [item for item in task.waiting if item[0].key not in task.given]
            if ready:
                task.inbox.put(ready)
            if ready and is_new:
                first, *more = dict.fromkeys(shard.partition for shard, _ in ready)
                name = f"{first} and {len(more)} more" if more else first
                future = self._start_task(task.stage.name, name, partial(self._do_task, task))
                future.add_done_callback(partial(self._do_if_left, task))

    def _do_if_left(self, task: _Task, _: object) -> None:
        """Run a task that Prefect could not start: Prefect shows less then, and is not needed."""
        if not (task.is_begun or self._is_over):
            Thread(target=self._do_task, args=[task], daemon=True).start()

    def _announce(self, manifest: Manifest) -> None:
        """Offer an artifact to the early plans of other stages."""
        self._made[manifest.ref.key] = manifest
        for work in self._work.values():
            for early, arrived in work.arrived.items():
                if any(table in manifest.tables for table in early.each):
                    arrived.append(manifest)

    def _close(self, work: _StageWork) -> None:
        """End tasks of a planned stage that have nothing left; record the stage when it is complete or has failed."""
        if work.plan is None or work.made is not None or work.error is not None:
            return
        for task in work.tasks:
            if not task.num_left:
                task.inbox.put(None)
        if work.left:
            return
        if failed := self._errors_of(work.plan.stage.name):
            work.error = joined(failed)
            return
        run, stage = self._run, work.plan.stage
        found = tuple(self._made[item.shard.key] for item in work.plan.shards)
        record_stage(run.store, run.study.name, self._run_id, stage.name, found)
        seconds = time.perf_counter() - work.started
        work.made, work.outcome = found, StageOutcome.of(work.plan, found, seconds)
        run.listener.stage_finished(work.plan, seconds, work.outcome.verdict)

    def _errors_of(self, name: str) -> list[ShardError]:
        """Return the errors of a stage's shards that failed, by partition and name."""
        ends = [end for end in self._ended.values() if isinstance(end, ShardFailed) and end.shard.stage == name]
        ends.sort(key=lambda end: (end.shard.partition, end.shard.name))
        return [end.error for end in ends if not end.is_behind]

    def _raise_failures(self) -> None:
        """Raise one error for all failures, stage by stage, and note what was skipped because of them."""
        errors: dict[str, ShardError | InputError] = {}
        for name, work in self._work.items():
            if work.is_skipped and (failed := self._errors_of(name)):
                work.error = joined(failed)
            errors |= {name: work.error} if work.error is not None else {}
        if not errors:
            return
        behind = [one.shard for one in self._ended.values() if isinstance(one, ShardFailed) and one.is_behind]
        not_run = [f"{one.stage} {one.partition} {one.name}" for one in behind]
        if len(not_run) > _NAMED:
            not_run[_NAMED:] = [f"{len(not_run) - _NAMED} more shards"]
        not_run = [name for name, work in self._work.items() if work.is_skipped] + not_run
        if not_run:
            self._run.listener.note(f"not run, as they need what failed: {', '.join(not_run)}")
        if len(errors) == 1:
            raise next(iter(errors.values()))
        raise joined(
            [
                error
                if isinstance(error, ShardError)
                else ShardError(f"stage {name}", type(error).__name__, str(error))
                for name, error in errors.items()
            ]
        )


def stages_behind(graph: Graph) -> dict[str, int]:
    """Return for each stage how many stages, one after the other, wait for it: what is urgent waits for no branch."""
    behind: dict[str, int] = {}
    for name in reversed(graph.names):
        below = [behind[other] for other in behind if name in graph.upstream[other]]
        behind[name] = 1 + max(below, default=0)
    return behind
