"""How far a run is: what has ended, what is left, what workers are at, and how long that will take."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain, islice

from flows.listener import Progress
from flows.planning import StagePlan
from flows.records import read_last_run
from storage_schema import Store
from storage_schema.store import SHARD_S
from tasks.shards import ShardDone, ShardFailed
from tasks.stage import Shard

_SOME = 20
"""Shards of a stage of the last run that are asked what they took."""


class Tally:
    """Counts shards by stage.

    Args:
        store: Has what shards of the last run took.
        study: Name of the study.
    """

    def __init__(self, store: Store, study: str) -> None:
        self._store, self._study = store, study
        self._by_priority: dict[int, dict[str, Shard]] = {}
        self._priority: dict[str, int] = {}
        self._num_left, self._num_ended = Counter[str](), Counter[str]()
        self._took: dict[str, tuple[float, int]] = {}
        self._last_means: dict[str, float | None] = {}

    def add(self, shard: Shard, priority: int) -> None:
        """Count a shard that is to be computed."""
        self._priority[shard.key] = priority
        self._by_priority.setdefault(priority, {})[shard.key] = shard
        self._num_left[shard.stage] += 1

    def end(self, ended: ShardDone | ShardFailed) -> None:
        """Count a shard that has ended."""
        shard = ended.shard
        del self._by_priority[self._priority.pop(shard.key)][shard.key]
        self._num_left[shard.stage] -= 1
        self._num_ended[shard.stage] += isinstance(ended, ShardDone) or not ended.is_behind
        if isinstance(ended, ShardDone):
            seconds, count = self._took.get(shard.stage, (0.0, 0))
            self._took[shard.stage] = seconds + ended.seconds, count + 1

    def progress(self, waiting: Iterable[StagePlan], num_workers: int) -> Progress:
        """Return how far the run is, with stages that are not planned yet as large as they were last time."""
        num_left = dict(self._num_left)
        for plan in waiting:
            name, had = plan.stage.name, sum(count for _, count in plan.last_partitions)
            num_left[name] = max(num_left.get(name, 0), had - self._num_ended[name])
        means = {name: self._mean_s(name) for name in num_left}
        return Progress(
            num_done=self._num_ended.total(),
            num_shards=self._num_ended.total() + sum(num_left.values()),
            running=self._running(num_workers),
            left_s=sum(count * (means[name] or 0.0) for name, count in num_left.items()) / num_workers,
            is_all=all(means.values()),
        )

    def _running(self, num_workers: int) -> tuple[Shard, ...]:
        """Return what workers are at: as many as there are, of the highest priority, of those that wait for nothing."""
        levels = (self._by_priority[priority].values() for priority in sorted(self._by_priority, reverse=True))
        ready = (one for one in chain.from_iterable(levels) if not any(key in self._priority for key in one.after))
        return tuple(islice(ready, num_workers))

    def _mean_s(self, name: str) -> float | None:
        """Return what a shard of a stage took, now or in some of the last run; None where that is not known."""
        if name in self._took:
            seconds, count = self._took[name]
            return seconds / count
        if name not in self._last_means:
            last = read_last_run(self._store, self._study)
            refs = last.refs(name) if last is not None else []
            found = (self._store.find(ref.stage, ref.key) for ref in refs[:: max(1, len(refs) // _SOME)])
            took = [one.timings[SHARD_S] for one in found if one is not None and SHARD_S in one.timings]
            self._last_means[name] = sum(took) / len(took) if took else None
        return self._last_means[name]
