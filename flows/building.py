"""A run at work: a driver that plans stages as what they read is committed, and gives their shards to tasks.

A task is a partition of a stage, done in a thread: it submits the shards that it is given, the longest way first, and
collects them.  Only the driver plans and records.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from graphlib import TopologicalSorter
from itertools import chain
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
_LOOK_UP_S = 0.2
_NAMED = 5
"""Of what was not run, so many are named."""

Carry = Callable[[str, str, Callable[[], None]], Any]
"""Has a task done in a thread of its own: its stage, its name, and what it does; gives a future."""


@dataclass(eq=False)
class _Task:
    """Partitions of a stage in work.

    Args:
        stage: The stage.
        inbox: Gets shards to submit with their priorities, each shard again when it has ended, and None: no more.
        queue: Shards that wait for those of other tasks, in an order in which they can be computed.
        given: Keys of those that were handed over.
        num_left: Shards that have not ended.
    """

    stage: Stage
    inbox: SimpleQueue[list[tuple[Shard, int]] | Shard | None] = field(default_factory=SimpleQueue)
    queue: list[tuple[Shard, int]] = field(default_factory=list)
    given: set[str] = field(default_factory=set)
    num_left: int = 0
    is_begun: bool = False


@dataclass
class _StageInWork:
    """A stage that is planned, and those of its shards that have not ended."""

    plan: StagePlan
    left: set[str]
    started: float = field(default_factory=time.perf_counter)


class Build:
    """Brings the stages of a plan up to date.

    Args:
        run: What is to be built.
        run_id: Name of the run, for the record.
        plan: The plan made beforehand.
        pool: Computes shards.
        carry: Does tasks.
    """

    def __init__(self, run: Run, run_id: str, plan: Plan, pool: Pool, carry: Carry) -> None:
        self._run, self._run_id, self._pool, self._carry = run, run_id, pool, carry
        self._first = {stage.stage.name: stage for stage in plan.stages}
        self._writer = {table: stage.name for stage in run.graph.stages for table in stage.writes}
        self._urgency = stages_behind(run.graph)
        self._waiting = [name for name, stage in self._first.items() if stage.is_selected]
        self._in_work: dict[str, _StageInWork] = {}
        self._failures: dict[str, ShardError | InputError] = {}
        self._left_out: list[str] = []
        self._outcomes: dict[str, StageOutcome] = {}
        self._whole = {name: first.manifests for name, first in self._first.items() if not first.is_selected}
        self._made: dict[str, Manifest] = {}
        self._news: dict[tuple[str, int], list[Manifest]] = {
            (name, at): [] for name in self._waiting for at, _ in enumerate(self._first[name].stage.early)
        }
        self._tasks: dict[str, list[_Task]] = {name: [] for name in self._first}
        self._task_of: dict[tuple[str, str], _Task] = {}
        self._held: list[_Task] = []
        self._flying: set[str] = set()
        self._ended: dict[str, ShardDone | ShardFailed] = {}
        self._tally = Tally(run.store, run.study.name)
        self._is_over = False
        self._told: SimpleQueue[ShardDone | ShardFailed | Exception | None] = SimpleQueue()

    @property
    def outcomes(self) -> tuple[StageOutcome, ...]:
        """Return what was done for the stages that are whole, in the order of the graph."""
        return tuple(self._outcomes[name] for name in self._first if name in self._outcomes)

    def bring_up_to_date(self, heed: Callable[[], None]) -> None:
        """Work until nothing is left that can be done.

        Args:
            heed: Is called now and then, and may raise to end the work.

        Raises:
            ShardError, InputError: Something failed.
            ClusterError: There is nobody left to compute.
        """
        self._advance()
        self._show_progress()
        while self._flying:
            heed()
            if (ended := self._next()) is not None:
                self._settle(ended)
                self._release()
                self._advance()
                self._show_progress()
        self._raise_failures()

    def _show_progress(self) -> None:
        waiting = [self._first[name] for name in self._waiting]
        self._run.listener.progressed(self._tally.progress(waiting, self._pool.num_workers))

    def end_tasks(self) -> None:
        """Tell the tasks that nothing more comes, and drop what has not ended."""
        self._is_over = True
        for task in chain.from_iterable(self._tasks.values()):
            task.inbox.put(None)
        self._pool.give_up()

    def _do_task(self, task: _Task) -> None:
        """Be a task."""
        task.is_begun = True
        num_left, failures = 0, []
        try:
            while (message := task.inbox.get()) is not None:
                if isinstance(message, list):
                    num_left += len(message)
                    for shard, priority in message:
                        self._pool.submit(task.stage.run_shard, shard, priority, task.inbox.put)
                    self._told.put(None)
                elif (ended := self._pool.ended(message)) is None:
                    task.inbox.put(message)
                else:
                    num_left -= 1
                    failures += [ended.error] if isinstance(ended, ShardFailed) and not ended.is_behind else []
                    self._told.put(ended)
        except Exception as error:
            self._told.put(error)
            raise
        if failures:
            raise joined(failures)
        if num_left:
            raise Stopped("given up")

    def _next(self) -> ShardDone | ShardFailed | None:
        """Return what ended, None where nothing has for a moment; an error after which none can do better is raised."""
        is_computed = self._pool.work()
        while True:
            try:
                told = self._told.get(timeout=_LOOK_UP_S)
            except Empty:
                return None
            if isinstance(told, Exception):
                raise told
            if told is not None or not is_computed:
                return told

    def _settle(self, ended: ShardDone | ShardFailed) -> None:
        """Take note of a shard that has ended."""
        shard, name = ended.shard, ended.shard.stage
        self._flying.discard(shard.key)
        self._ended[shard.key] = ended
        self._tally.end(ended)
        if isinstance(ended, ShardDone):
            self._tell(self._run.store.manifest(ended.ref))
            self._run.listener.shard_done(ended)
        elif ended.error.is_fatal:
            raise ended.error
        self._task_of[name, shard.partition].num_left -= 1
        if (work := self._in_work.get(name)) is not None:
            self._end_done_tasks(name)
            work.left.discard(shard.key)
            if not work.left:
                self._finish(name)

    def _advance(self) -> None:
        """Begin with every stage that can be planned, and with what can be begun with of those that cannot."""
        for name in list(self._waiting):
            upstream = self._upstream(name)
            if {*self._failures, *self._left_out}.intersection(upstream):
                self._waiting.remove(name)
                self._left_out.append(name)
            elif all(other in self._whole for other in upstream):
                self._waiting.remove(name)
                try:
                    self._begin(name)
                except InputError as error:
                    self._failures[name] = error
        for name in (*self._waiting, *self._left_out):
            if name not in self._run.selection.force:
                for at, early in enumerate(self._first[name].stage.early):
                    self._begin_early(self._first[name].stage, at, early)

    def _begin(self, name: str) -> None:
        """Plan a stage of which all that it reads is there, and have it computed."""
        first, run = self._first[name], self._run
        # What this run began is its work, also where it is committed and that was not heard of yet.
        begun = self._flying | {key for key, ended in self._ended.items() if isinstance(ended, ShardDone)}
        stage, plan, is_forced = first.stage, first, name in run.selection.force
        if first.is_pending:
            inputs = stage_inputs(stage, run.study.head.seed, {n: self._whole[n] for n in self._upstream(name)})
            plan = plan_stage(stage, run.study, inputs, run.store, is_forced=is_forced)
            shards = tuple(replace(i, state=State.MISSING) if i.shard.key in begun else i for i in plan.shards)
            plan = replace(plan, is_asked=first.is_asked, shards=shards)
        for item in plan.shards:
            if item.manifest is not None and not item.shard.replaces and item.shard.key not in begun:
                self._tell(item.manifest)
        run.listener.stage_started(plan)
        self._take(plan.todo)
        left = {shard.key for shard in plan.todo if shard.key in self._flying}
        self._in_work[name] = _StageInWork(plan, left)
        self._end_done_tasks(name)
        if not left:
            self._finish(name)

    def _begin_early(self, stage: Stage, at: int, early: EarlyPlan) -> None:
        """Have computed what is sure of a stage that cannot be planned yet."""
        news = self._news.get((stage.name, at))
        if news is None or (early.each and not news) or not all(self._is_whole(table) for table in early.reads):
            return
        held = {table: tuple(one for one in self._there(table) if table in one.tables) for table in early.reads}
        held |= {table: tuple(one for one in news if table in one.tables) for table in early.each}
        if early.each:
            news.clear()
        else:
            del self._news[stage.name, at]
        with suppress(InputError):  # said when the stage is planned
            inputs = StageInputs(manifests=held, seed=self._run.study.head.seed)
            shards = early.plan(inputs, self._run.study.parameters[stage.name])
            self._take([shard for shard in shards if self._run.store.find(stage.name, shard.key) is None])

    def _take(self, shards: Iterable[Shard]) -> None:
        """Have shards of a stage computed, but those that were taken before, with the priority of how many follow."""
        new = {one.key: one for one in shards if one.key not in self._flying and one.key not in self._ended}
        order = list(
            TopologicalSorter({key: [k for k in one.after if k in new] for key, one in new.items()}).static_order()
        )
        followers = dict.fromkeys(order, 0)
        for key in reversed(order):
            for before in new[key].after:
                followers[before] = max(followers.get(before, 0), followers[key] + 1)
        for key in order:
            shard = new[key]
            priority = self._urgency[shard.stage] * _STAGE_FIRST + followers[key]
            self._flying.add(key)
            self._tally.add(shard, priority)
            task = self._task_of.get((shard.stage, shard.partition)) or self._new_task(shard)
            task.num_left += 1
            task.queue.append((shard, priority))
            self._held += [] if task in self._held else [task]
        self._release()

    def _new_task(self, shard: Shard) -> _Task:
        """Return the task of a partition that had none: its own, or where there are many one that others have too."""
        tasks = self._tasks[shard.stage]
        is_more = len(tasks) < MAX_TASKS
        tasks += [_Task(self._first[shard.stage].stage)] if is_more else []
        task = self._task_of[shard.stage, shard.partition] = tasks[-1 if is_more else len(self._task_of) % MAX_TASKS]
        return task

    def _release(self) -> None:
        """Hand over what waits for no shard of another task any more."""
        for task in self._held:
            ready = []
            for shard, priority in task.queue:
                if all(key in task.given or key not in self._flying for key in shard.after):
                    task.given.add(shard.key)
                    ready.append((shard, priority))
            is_new = len(task.given) == len(ready)
            task.queue = [item for item in task.queue if item[0].key not in task.given]
            if ready:
                task.inbox.put(ready)
            if ready and is_new:
                first, *more = dict.fromkeys(shard.partition for shard, _ in ready)
                name = f"{first} and {len(more)} more" if more else first
                future = self._carry(task.stage.name, name, partial(self._do_task, task))
                future.add_done_callback(partial(self._do_if_left, task))
        self._held = [task for task in self._held if task.queue]

    def _do_if_left(self, task: _Task, _: object) -> None:
        """Do a task that could not be begun: Prefect shows less then, and is not needed."""
        if not (task.is_begun or self._is_over):
            Thread(target=self._do_task, args=[task], daemon=True).start()

    def _end_done_tasks(self, name: str) -> None:
        """Let the tasks of a stage that is planned end of which nothing is left."""
        for task in self._tasks[name]:
            if not task.num_left:
                task.inbox.put(None)

    def _upstream(self, name: str) -> tuple[str, ...]:
        return self._run.graph.needed(name, self._run.study.parameters[name])

    def _is_whole(self, table: str) -> bool:
        return table not in self._writer or self._writer[table] in self._whole

    def _there(self, table: str) -> Sequence[Manifest]:
        """Return what the stage that writes a table has made; nothing where none of the graph does."""
        return self._whole[self._writer[table]] if table in self._writer else ()

    def _tell(self, manifest: Manifest) -> None:
        """Offer an artifact to the stages that can begin with it."""
        self._made[manifest.ref.key] = manifest
        for (name, at), news in self._news.items():
            if any(table in manifest.tables for table in self._first[name].stage.early[at].each):
                news.append(manifest)

    def _finish(self, name: str) -> None:
        """Record a stage of which all is there, or that it failed."""
        work, run = self._in_work.pop(name), self._run
        if failed := self._errors_of(work.plan.todo):
            self._failures[name] = joined(failed)
            return
        found = tuple(self._made[item.shard.key] for item in work.plan.shards)
        record_stage(run.store, run.study.name, self._run_id, name, found)
        seconds = time.perf_counter() - work.started
        self._whole[name] = found
        outcome = self._outcomes[name] = StageOutcome.of(work.plan, found, seconds)
        run.listener.stage_finished(work.plan, seconds, outcome.verdict)

    def _errors_of(self, shards: Iterable[Shard]) -> list[ShardError]:
        """Return the errors of those that failed, in this order."""
        ends = (self._ended.get(shard.key) for shard in shards)
        return [end.error for end in ends if isinstance(end, ShardFailed) and not end.is_behind]

    def _raise_failures(self) -> None:
        """Raise one error for all that failed, stage by stage, and say what was not run because of it."""
        early = sorted((one.shard for one in self._ended.values()), key=lambda shard: (shard.partition, shard.name))
        for name in self._left_out:
            if failed := self._errors_of(shard for shard in early if shard.stage == name):
                self._failures[name] = joined(failed)
        failures = {name: self._failures[name] for name in self._first if name in self._failures}
        if not failures:
            return
        behind = [one.shard for one in self._ended.values() if isinstance(one, ShardFailed) and one.is_behind]
        shards = [f"{one.stage} {one.partition} {one.name}" for one in behind]
        if unseen := len(shards) - _NAMED:
            shards = shards if unseen < 0 else [*shards[:_NAMED], f"{unseen} more shards"]
        if self._left_out or shards:
            self._run.listener.note(f"not run, as they need what failed: {', '.join([*self._left_out, *shards])}")
        raise _as_one(failures)


def stages_behind(graph: Graph) -> dict[str, int]:
    """Return for each stage how many stages, one after the other, wait for it: what is urgent waits for no branch."""
    behind: dict[str, int] = {}
    for name in reversed(graph.names):
        below = [behind[other] for other in behind if name in graph.upstream[other]]
        behind[name] = 1 + max(below, default=0)
    return behind


def _as_one(failures: Mapping[str, ShardError | InputError]) -> Exception:
    """Return one error for what failed, stage by stage."""
    if len(failures) == 1:
        return next(iter(failures.values()))
    return joined(
        [
            error if isinstance(error, ShardError) else ShardError(f"stage {name}", type(error).__name__, str(error))
            for name, error in failures.items()
        ]
    )
