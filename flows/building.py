"""The driver of a run: plans a stage when what it reads is committed, and gives its shards to tasks.

A task is a partition of a stage, done in a thread: it submits the shards that it is given, and collects them.  Only the
driver plans and records.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from graphlib import TopologicalSorter
from itertools import islice
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
        waiting: Shards that wait for those of other tasks, with their priorities, each after those that it follows.
        given: Keys of shards that were handed over.
        num_left: Shards that have not ended.
        is_begun: A thread does it.
    """

    stage: Stage
    inbox: SimpleQueue[tuple[Shard, int] | Shard | None] = field(default_factory=SimpleQueue)
    waiting: list[tuple[Shard, int]] = field(default_factory=list)
    given: set[str] = field(default_factory=set)
    num_left: int = 0
    is_begun: bool = False


@dataclass(eq=False)
class _StageWork:
    """A stage of the run, from its first plan to its record.

    Args:
        plan: The plan made beforehand; when all that it reads is there, what the stage consists of (`is_planned`).
        urgency: Its place among the stages, the least urgent is 0.
        early: Its early plans, each with the number of artifacts of the run that it has seen.
        partitions: Numbers of its partitions.
        tasks: Tasks that can still get shards or have some left, by number.
        failed: Its shards that failed, or were not tried because one before them failed.
        refusal: Why it cannot be planned.
        is_skipped: A stage that it needs failed.
        made: Its artifacts; None before all are there.
    """

    plan: StagePlan
    urgency: int
    early: dict[EarlyPlan, int]
    made: tuple[Manifest, ...] | None
    partitions: dict[str, int] = field(default_factory=dict)
    tasks: dict[int, _Task] = field(default_factory=dict)
    failed: list[ShardFailed] = field(default_factory=list)
    refusal: InputError | None = None
    is_planned: bool = False
    is_skipped: bool = False
    started: float = 0.0
    outcome: StageOutcome | None = None

    @property
    def error(self) -> ShardError | InputError | None:
        """Return why it failed; None where it did not, or only as a stage that it needs did."""
        tried = sorted((end.error for end in self.failed if not end.is_behind), key=lambda error: error.where)
        return self.refusal or (joined(tried) if tried else None)

    @property
    def is_lost(self) -> bool:
        """Return whether nothing that needs it can be planned any more."""
        return bool(self.failed) or self.refusal is not None or self.is_skipped

    @property
    def is_waiting(self) -> bool:
        """Return whether it waits for what it reads."""
        return self.made is None and self.refusal is None and not (self.is_planned or self.is_skipped)

    def task_of(self, partition: str) -> _Task:
        """Return the task of a partition: its own, or where there are many one that others have too."""
        number = self.partitions.setdefault(partition, len(self.partitions)) % MAX_TASKS
        return self.tasks.setdefault(number, _Task(self.plan.stage))


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
        urgency = {name: place for place, name in enumerate(by_urgency(run.graph))}
        self._work: dict[str, _StageWork] = {}
        for first in plan.stages:
            name, made = first.stage.name, None if first.is_selected else first.manifests
            early = () if made is not None or name in run.selection.force else first.stage.early
            self._work[name] = _StageWork(first, urgency[name], dict.fromkeys(early, 0), made)
        self._begun, self._flying = set[str](), set[str]()
        self._made: dict[str, Manifest] = {}
        self.done: list[ShardDone] = []
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
                self._advance()
        self._raise_failures()

    def end_tasks(self) -> None:
        """End the tasks, and cancel shards that have not ended."""
        self._is_over = True
        for task in self._tasks():
            task.inbox.put(None)
        self._pool.give_up()

    def _tasks(self) -> list[_Task]:
        return [task for work in self._work.values() for task in work.tasks.values()]

    def _do_task(self, task: _Task) -> None:
        """Run a task: submit its shards, collect them."""
        task.is_begun = True
        failures: list[ShardError] = []
        try:
            while (message := task.inbox.get()) is not None:
                if isinstance(message, tuple):
                    self._pool.submit(task.stage.run_shard, *message, task.inbox.put)
                    self._messages.put(None)
                elif (ended := self._pool.ended(message)) is None:
                    task.inbox.put(message)
                else:
                    failures += [ended.error] if isinstance(ended, ShardFailed) and not ended.is_behind else []
                    self._messages.put(ended)
        except Exception as error:
            self._messages.put(error)
            raise
        if failures:
            raise joined(failures)
        if task.num_left:
            raise Stopped("given up")

    def _next(self) -> ShardDone | ShardFailed | None:
        """Return a shard that ended, None where none has within a moment; raise errors of tasks and pool."""
        is_computed = self._pool.work()
        with suppress(Empty):
            while (message := self._messages.get(timeout=_POLL_S)) is None and is_computed:
                pass
            if isinstance(message, Exception):
                raise message
            return message
        return None

    def _settle(self, ended: ShardDone | ShardFailed) -> None:
        """Note the end of a shard."""
        shard, work = ended.shard, self._work[ended.shard.stage]
        self._flying.discard(shard.key)
        self._tally.end(ended)
        if isinstance(ended, ShardDone):
            self._made[shard.key] = self._run.store.manifest(ended.ref)
            self.done.append(ended)
            self._run.listener.shard_done(ended)
        elif ended.error.is_fatal:
            raise ended.error
        else:
            work.failed.append(ended)
        work.task_of(shard.partition).num_left -= 1
        self._release()
        self._close(work)

    def _advance(self) -> None:
        """Begin every stage that can be planned, early plans of others, and report progress."""
        for name, work in self._work.items():
            if work.is_waiting:
                needed = self._run.graph.needed(name, self._run.study.parameters[name])
                above = {other: self._work[other] for other in needed}
                work.is_skipped = any(one.is_lost for one in above.values())
                made = {other: one.made for other, one in above.items() if one.made is not None}
                if len(made) == len(above):
                    self._begin(work, made)
            for early in list(work.early):
                self._begin_early(work, early)
        waiting = [work.plan for work in self._work.values() if work.is_waiting]
        self._run.listener.progressed(self._tally.progress(waiting, self._pool.num_workers))

    def _begin(self, work: _StageWork, made: dict[str, tuple[Manifest, ...]]) -> None:
        """Plan a stage of which all that it reads is there, by stage, and have it computed."""
        plan, stage, run = work.plan, work.plan.stage, self._run
        work.early = {}
        if plan.is_pending:
            try:
                inputs = stage_inputs(stage, run.study.head.seed, made)
                plan = plan_stage(stage, run.study, inputs, run.store, is_forced=stage.name in run.selection.force)
            except InputError as error:
                work.refusal = error
                return
            # What this run began is its work, also where it is committed and no message of that was read yet.
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
        """Have the shards of an early plan computed: those certain before the stage can be planned."""
        stage, run = work.plan.stage, self._run
        above = [self._work[name] for name in run.graph.upstream[stage.name]]
        above = [other for other in above if set(early.reads).intersection(other.plan.stage.tables)]
        unseen = islice(self._made.values(), work.early[early], None)
        new = [one for one in unseen if set(early.each).intersection(one.tables)]
        if (early.each and not new) or any(other.made is None for other in above):
            return
        work.early[early] = len(self._made)
        if not early.each:
            del work.early[early]
        there = [one for other in above for one in other.made or ()]
        held = {table: tuple(one for one in there if table in one.tables) for table in early.reads}
        held |= {table: tuple(one for one in new if table in one.tables) for table in early.each}
        with suppress(InputError):  # said when the stage is planned
            shards = early.plan(StageInputs(manifests=held, seed=run.study.head.seed), run.study.parameters[stage.name])
            self._take(work, [shard for shard in shards if run.store.find(stage.name, shard.key) is None])

    def _take(self, work: _StageWork, shards: Iterable[Shard]) -> None:
        """Submit shards that were not submitted before, those with the longest chain of dependants first."""
        new = {one.key: one for one in shards if one.key not in self._begun}
        before = {key: [other for other in one.after if other in new] for key, one in new.items()}
        order = list(TopologicalSorter(before).static_order())
        behind = dict.fromkeys(order, 0)
        for key in reversed(order):
            for other in before[key]:
                behind[other] = max(behind[other], behind[key] + 1)
        self._begun.update(order)
        self._flying.update(order)
        for key in order:
            item = new[key], work.urgency * _STAGE_FIRST + behind[key]
            self._tally.add(*item)
            task = work.task_of(new[key].partition)
            task.num_left += 1
            task.waiting.append(item)
        self._release()

    def _release(self) -> None:
        """Hand over shards that wait for no other task; begin tasks with their first ones."""
        for task in self._tasks():
            is_new, waiting, task.waiting = not task.given, task.waiting, []
            for item in waiting:
                if any(key in self._flying and key not in task.given for key in item[0].after):
                    task.waiting.append(item)
                else:
                    task.given.add(item[0].key)
                    task.inbox.put(item)
            if is_new and task.given:
                first, *more = dict.fromkeys(shard.partition for shard, _ in waiting if shard.key in task.given)
                name = f"{first} and {len(more)} more" if more else first
                future = self._start_task(task.stage.name, name, partial(self._do_task, task))
                future.add_done_callback(partial(self._do_if_left, task))

    def _do_if_left(self, task: _Task, _: object) -> None:
        """Run a task that Prefect could not start: Prefect shows less then, and is not needed."""
        if not (task.is_begun or self._is_over):
            Thread(target=self._do_task, args=[task], daemon=True).start()

    def _close(self, work: _StageWork) -> None:
        """End tasks of a planned stage that have nothing left; record the stage when it is complete."""
        if not work.is_planned:
            return
        for number, task in list(work.tasks.items()):
            if not task.num_left:
                work.tasks.pop(number).inbox.put(None)
        if work.tasks or work.failed:
            return
        run, stage = self._run, work.plan.stage
        found = tuple(self._made[item.shard.key] for item in work.plan.shards)
        record_stage(run.store, run.study.name, self._run_id, stage.name, found)
        seconds = time.perf_counter() - work.started
        work.made, work.outcome = found, StageOutcome.of(work.plan, found, seconds)
        run.listener.stage_finished(work.plan, seconds, work.outcome.verdict)

    def _raise_failures(self) -> None:
        """Raise one error for all failures, stage by stage, and note what was skipped because of them."""
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
            raise joined(
                [
                    one if isinstance(one, ShardError) else ShardError(f"stage {name}", type(one).__name__, str(one))
                    for name, one in errors.items()
                ]
            )


def by_urgency(graph: Graph) -> list[str]:
    """Return the stages, the least urgent first.

    Of two that as many wait for one is done before the other: shards of a stage share what they make ready.
    """
    behind = stages_behind(graph)  # the last stage first
    return sorted(behind, key=behind.__getitem__)


def stages_behind(graph: Graph) -> dict[str, int]:
    """Return for each stage how many stages, one after the other, wait for it: what is urgent waits for no branch."""
    behind: dict[str, int] = {}
    for name in reversed(graph.names):
        below = [behind[other] for other in behind if name in graph.upstream[other]]
        behind[name] = 1 + max(below, default=0)
    return behind
