"""A run at work: stages that wait, are in work, are whole, failed, or were left out for what failed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from graphlib import TopologicalSorter

from flows.listener import Progress
from flows.outcomes import Run, StageOutcome
from flows.planning import Plan, StagePlan, State, plan_stage, stage_inputs
from flows.records import read_last_run, record_stage
from flows.scheduling import Schedule, stages_behind
from pasdedeux.errors import InputError
from storage_schema import Manifest
from storage_schema.store import SHARD_S
from tasks.shards import Pool, ShardDone, ShardError, Stopped, joined
from tasks.stage import EarlyPlan, Shard, Stage, StageInputs

__all__ = ["Build", "Partition", "Watch", "partitions_to_run"]

_SOME = 20
"""Shards of a stage of the last run that are asked what they took."""

_NAMED = 5
"""Of what was not run, so many are named."""

Watch = Callable[[Run, StagePlan, Mapping[str, "Future[None]"]], None]
"""Is told of a stage that has work, with what ends when a partition of it does; must not wait for that."""


@dataclass(frozen=True)
class Partition:
    """Shards of one stage that a person sees as one step; `needs` are partitions that must be there before."""

    name: str
    shards: tuple[Shard, ...]
    needs: tuple[str, ...] = ()


@dataclass
class _StageInWork:
    """A stage whose shards are being computed: those that have not ended, and what ends with each partition."""

    plan: StagePlan
    left: dict[str, Shard] = field(init=False)
    partitions: dict[str, Future[None]] = field(init=False)
    started: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        """Count what is to be done."""
        self.left = {shard.key: shard for shard in self.plan.todo}
        self._shards_of: dict[str, list[Shard]] = {}
        for shard in self.plan.todo:
            self._shards_of.setdefault(shard.partition, []).append(shard)
        self.partitions = {name: Future() for name in self._shards_of}
        self._num_left = {name: len(shards) for name, shards in self._shards_of.items()}

    def settle(self, schedule: Schedule) -> None:
        """Take note of the shards that have ended."""
        for shard in [shard for shard in self.left.values() if schedule.has_ended(shard)]:
            self.end(shard, schedule)

    def end(self, shard: Shard, schedule: Schedule) -> None:
        """Take note of one that has."""
        del self.left[shard.key]
        self._num_left[shard.partition] -= 1
        if not self._num_left[shard.partition]:
            everybody = self._shards_of[shard.partition]
            error: Exception | None = schedule.error_of(everybody)
            if error is None and any(one.key in schedule.behind for one in everybody):
                error = Stopped("it needs what failed")
            future = self.partitions[shard.partition]
            future.set_result(None) if error is None else future.set_exception(error)

    def give_up(self) -> None:
        """End the partitions that have not ended."""
        for future in self.partitions.values():
            if not future.done():
                future.set_exception(Stopped("given up"))


class Build:
    """Brings the stages of a plan up to date.

    Args:
        run: What is to be built.
        run_id: Name of the run, for the record.
        plan: The plan made beforehand.
        pool: Computes shards.
        watch: Is told of every stage that has work.
    """

    def __init__(self, run: Run, run_id: str, plan: Plan, pool: Pool, watch: Watch | None) -> None:
        self._run, self._run_id, self._pool, self._watch = run, run_id, pool, watch
        self._first = {stage.stage.name: stage for stage in plan.stages}
        self._writer = {table: stage.name for stage in run.graph.stages for table in stage.writes}
        self._schedule = Schedule(pool, stages_behind(run.graph))
        self._waiting = [name for name, stage in self._first.items() if stage.is_selected]
        self._in_work: dict[str, _StageInWork] = {}
        self._failures: dict[str, ShardError | InputError] = {}
        self._left_out: list[str] = []
        self._outcomes: dict[str, StageOutcome] = {}
        self._whole = {name: first.manifests for name, first in self._first.items() if not first.is_selected}
        self._made: dict[str, Manifest] = {}
        self._last_means: dict[str, float | None] = {}
        self._news: dict[tuple[str, int], list[Manifest]] = {
            (name, at): [] for name in self._waiting for at, _ in enumerate(self._first[name].stage.early)
        }

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
        """
        self._advance()
        while not self._schedule.is_idle:
            heed()
            self._schedule.start()
            self._run.listener.progressed(self._progress())
            ended = self._schedule.next()
            if ended is None:
                continue
            name = ended.shard.stage
            if isinstance(ended, ShardDone):
                self._keep(ended)
            if name in self._in_work:
                work = self._in_work[name]
                if not isinstance(ended, ShardDone):
                    work.settle(self._schedule)
                elif ended.shard.key in work.left:
                    work.end(ended.shard, self._schedule)
                if not work.left:
                    self._finish(name)
            self._advance()
        self._run.listener.progressed(self._progress())
        self._raise_failures()

    def give_up(self) -> None:
        """Drop what is not done."""
        self._pool.give_up()
        for work in self._in_work.values():
            work.give_up()

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
        begun = self._schedule.done | self._schedule.running.keys()
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
        work = self._in_work[name] = _StageInWork(plan)
        self._schedule.add(stage.run_shard, plan.todo)
        if plan.todo and self._watch is not None:
            self._watch(run, plan, work.partitions)
        work.settle(self._schedule)
        if not work.left:
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
            missing = [shard for shard in shards if self._run.store.find(stage.name, shard.key) is None]
            self._schedule.add(stage.run_shard, missing)

    def _upstream(self, name: str) -> tuple[str, ...]:
        return self._run.graph.needed(name, self._run.study.parameters[name])

    def _is_whole(self, table: str) -> bool:
        return table not in self._writer or self._writer[table] in self._whole

    def _there(self, table: str) -> Sequence[Manifest]:
        """Return what the stage that writes a table has made; nothing where none of the graph does."""
        return self._whole[self._writer[table]] if table in self._writer else ()

    def _keep(self, done: ShardDone) -> None:
        """Take a committed shard to those that may be read."""
        self._tell(self._run.store.manifest(done.ref))
        self._run.listener.shard_done(done)

    def _tell(self, manifest: Manifest) -> None:
        """Offer an artifact to the stages that can begin with it."""
        self._made[manifest.ref.key] = manifest
        for (name, at), news in self._news.items():
            if any(table in manifest.tables for table in self._first[name].stage.early[at].each):
                news.append(manifest)

    def _finish(self, name: str) -> None:
        """Record a stage of which all is there, or that it failed."""
        work, run = self._in_work.pop(name), self._run
        error = self._schedule.error_of(work.plan.todo)
        if error is not None:
            self._failures[name] = error
            return
        found = tuple(self._made[item.shard.key] for item in work.plan.shards)
        record_stage(run.store, run.study.name, self._run_id, name, found)
        seconds = time.perf_counter() - work.started
        self._whole[name] = found
        outcome = self._outcomes[name] = StageOutcome.of(work.plan, found, seconds)
        run.listener.stage_finished(work.plan, seconds, outcome.verdict)

    def _progress(self) -> Progress:
        """Return how far the run is."""
        schedule = self._schedule
        num_left = dict(schedule.num_left)
        for name in self._waiting:
            had = sum(count for _, count in self._first[name].last_partitions)
            num_left[name] = max(num_left.get(name, 0), had - schedule.num_ended[name])
        means = {name: schedule.mean_seconds(name) or self._last_mean_s(name) for name in num_left}
        return Progress(
            num_done=sum(schedule.num_ended.values()),
            num_shards=sum(schedule.num_ended.values()) + sum(num_left.values()),
            running=tuple(schedule.running.values()),
            left_s=sum(count * (means[name] or 0.0) for name, count in num_left.items()) / self._pool.num_workers,
            is_all=all(means.values()),
        )

    def _last_mean_s(self, name: str) -> float | None:
        """Return what a shard of a stage took in the last run, in the mean of some; None where that is not known."""
        if name not in self._last_means:
            run = self._run
            last = read_last_run(run.store, run.study.name)
            refs = last.refs(name) if last is not None else []
            some = refs[:: max(1, len(refs) // _SOME)]
            found = (run.store.find(ref.stage, ref.key) for ref in some)
            took = [one.timings[SHARD_S] for one in found if one is not None and SHARD_S in one.timings]
            self._last_means[name] = sum(took) / len(took) if took else None
        return self._last_means[name]

    def _raise_failures(self) -> None:
        """Raise one error for all that failed, stage by stage, and say what was not run because of it."""
        begun = {name: self._schedule.errors_of_stage(name) for name in self._left_out}
        failures = {
            name: error for name in self._first if (error := self._failures.get(name) or begun.get(name)) is not None
        }
        if not failures:
            return
        shards = [f"{one.stage} {one.partition} {one.name}" for one in self._schedule.behind.values()]
        if unseen := len(shards) - _NAMED:
            shards = shards if unseen < 0 else [*shards[:_NAMED], f"{unseen} more shards"]
        if self._left_out or shards:
            self._run.listener.note(f"not run, as they need what failed: {', '.join([*self._left_out, *shards])}")
        raise _as_one(failures)


def partitions_to_run(plan: StagePlan) -> list[Partition]:
    """Return the shards that are not fresh by partition, each partition after those whose shards it reads."""
    home = {shard.key: shard.partition for shard in plan.todo}
    shards: dict[str, list[Shard]] = {}
    needs: dict[str, set[str]] = {}
    for shard in plan.todo:
        shards.setdefault(shard.partition, []).append(shard)
        needs.setdefault(shard.partition, set()).update(
            home[key] for key in shard.after if home.get(key, shard.partition) != shard.partition
        )
    # Sorted: sets of names have another order in every process, and partitions would have.
    order = TopologicalSorter({name: sorted(before) for name, before in needs.items()}).static_order()
    return [Partition(name, tuple(shards[name]), tuple(sorted(needs[name]))) for name in order]


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
