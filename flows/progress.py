"""Progress of a run (shards done, left and running, remaining time), and the listener that receives it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import chain, islice

from flows.planning import StagePlan
from flows.records import read_last_run
from pasdedeux.verdict import Verdict
from storage_schema import Store
from storage_schema.store import SHARD_S
from tasks.shards import ShardDone, ShardFailed
from tasks.stage import Shard


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    Args:
        num_done: Shards that have ended.
        num_shards: Shards needed; stages that cannot be planned yet count as last time.
        running: Shards handed to workers.
        left_s: Estimated seconds to the end, with the mean times of each stage, now or last time.
        is_all: Whether the estimate includes all stages; else some were never measured.
        partitions: Ended shards and all shards of each stage and partition that is running.
        noun: Name of the counted things.
    """

    num_done: int
    num_shards: int
    running: Sequence[Shard]
    left_s: float
    is_all: bool
    partitions: Mapping[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    noun: str = "shard"


@dataclass
class PartitionCount:
    """Progress of a partition of a stage: its shards, those computed, those failed or not tried, and seconds."""

    partition: str
    num_shards: int = 0
    num_computed: int = 0
    num_failed: int = 0
    seconds: float = 0.0

    @property
    def num_ended(self) -> int:
        """Return the number of its shards that have ended."""
        return self.num_computed + self.num_failed


class Listener:
    """Receives the events of a run and does nothing; subclasses override what they show.

    Shards may be done before their stage starts, because their inputs may be complete before all inputs of the stage.
    """

    def note(self, text: str) -> None:
        """A message for the user."""

    def stage_started(self, plan: StagePlan) -> None:
        """A stage is about to compute the shards that are not fresh."""

    def shard_done(self, done: ShardDone) -> None:
        """A shard is committed."""

    def progressed(self, progress: Progress) -> None:
        """Shards have started or ended."""

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """A stage is complete, with its verdict."""

    def close(self) -> None:
        """The run has ended, well or not."""


_SOME = 20
"""Shards of a stage of the last run whose times are read, at most about this many."""


class Tally:
    """Counts shards by stage.

    Args:
        store: Has the times of the last run's shards.
        study: Name of the study.
    """

    def __init__(self, store: Store, study: str) -> None:
        self._by_priority: dict[int, dict[str, Shard]] = {}
        self._priority: dict[str, int] = {}
        self._num_left, self._num_ended = Counter[str](), Counter[str]()
        self._partitions: dict[tuple[str, str], PartitionCount] = {}
        self._took: dict[str, tuple[float, int]] = {}
        self._last_mean_s = cache(partial(_last_mean_s, store, study))

    def add(self, shard: Shard, priority: int) -> None:
        """Count a shard that is to be computed."""
        self._priority[shard.key] = priority
        self._by_priority.setdefault(priority, {})[shard.key] = shard
        self._num_left[shard.stage] += 1
        count = self._partitions.setdefault((shard.stage, shard.partition), PartitionCount(shard.partition))
        count.num_shards += 1

    def end(self, ended: ShardDone | ShardFailed) -> None:
        """Count a shard that has ended."""
        shard = ended.shard
        del self._by_priority[self._priority.pop(shard.key)][shard.key]
        self._num_left[shard.stage] -= 1
        self._num_ended[shard.stage] += isinstance(ended, ShardDone) or not ended.is_behind
        count = self._partitions[shard.stage, shard.partition]
        if isinstance(ended, ShardDone):
            count.num_computed += 1
            count.seconds += ended.seconds
            seconds, num = self._took.get(shard.stage, (0.0, 0))
            self._took[shard.stage] = seconds + ended.seconds, num + 1
        else:
            count.num_failed += 1

    def partitions(self, stage: str) -> list[PartitionCount]:
        """Return the partitions of a stage whose shards were begun, in that order; safe for any thread."""
        return [count for (name, _), count in list(self._partitions.items()) if name == stage]

    def progress(self, waiting: Iterable[StagePlan], num_workers: int) -> Progress:
        """Return the progress of the run; unplanned stages have their size of the last run."""
        num_left = dict(self._num_left)
        for plan in waiting:
            name, had = plan.stage.name, sum(count for _, count in plan.last_partitions)
            num_left[name] = max(num_left.get(name, 0), had - self._num_ended[name])
        means = {name: self._mean_s(name) for name in num_left}
        running = self._running(num_workers)
        named = {(shard.stage, shard.partition): self._partitions[shard.stage, shard.partition] for shard in running}
        return Progress(
            num_done=self._num_ended.total(),
            num_shards=self._num_ended.total() + sum(num_left.values()),
            running=running,
            left_s=sum(count * (means[name] or 0.0) for name, count in num_left.items()) / num_workers,
            is_all=all(means.values()),
            partitions={place: (count.num_ended, count.num_shards) for place, count in named.items()},
        )

    def _running(self, num_workers: int) -> tuple[Shard, ...]:
        """Return the running shards: for each worker, the shard of the highest priority that waits for nothing."""
        levels = (self._by_priority[priority].values() for priority in sorted(self._by_priority, reverse=True))
        ready = (
            shard for shard in chain.from_iterable(levels) if not any(key in self._priority for key in shard.after)
        )
        return tuple(islice(ready, num_workers))

    def _mean_s(self, name: str) -> float | None:
        """Return the mean time of a stage's shards, now or last time; None if it is unknown."""
        seconds, num = self._took.get(name, (0.0, 0))
        return seconds / num if num else self._last_mean_s(name)


def _last_mean_s(store: Store, study: str, stage: str) -> float | None:
    """Return the mean time of some shards of a stage in the last run."""
    last = read_last_run(store, study)
    refs = last.refs(stage) if last is not None else []
    manifests = (store.find(ref.stage, ref.key) for ref in refs[:: max(1, len(refs) // _SOME)])
    took = [manifest.timings[SHARD_S] for manifest in manifests if manifest is not None and SHARD_S in manifest.timings]
    return sum(took) / len(took) if took else None
