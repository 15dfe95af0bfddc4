"""Which shard comes next: any whose inputs are there, whatever its stage, those first that most waits for."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from storage_schema import ArtifactRef, Store
from tasks.graph import Graph
from tasks.shards import Pool, ShardDone, ShardError, ShardFailed, joined
from tasks.stage import Shard

__all__ = ["Schedule", "stages_behind"]

RunShard = Callable[[Shard, Store], ArtifactRef]


class Schedule:
    """Hands shards to a pool, each when those it comes after are committed, and remembers how they ended.

    Args:
        pool: Who computes.
        urgency: Of each stage, by name; the more urgent stage's shards are started first.
    """

    def __init__(self, pool: Pool, urgency: Mapping[str, int]) -> None:
        self._pool = pool
        self._urgency = urgency
        self._ready: list[tuple[int, int, int, Shard]] = []
        self._waits_for: dict[str, set[str]] = {}
        self._followers: dict[str, list[Shard]] = {}
        self._runs: dict[str, Callable[[Shard, Store], ArtifactRef]] = {}
        self._depth: dict[str, int] = {}
        self._num_added = 0
        self.added: set[str] = set()
        self.running: dict[str, Shard] = {}
        self.done: set[str] = set()
        self.failed: dict[str, ShardError] = {}
        self._num_measured: Counter[str] = Counter()
        self._failed_shards: dict[str, Shard] = {}
        self.behind: dict[str, Shard] = {}
        self.num_left: Counter[str] = Counter()
        self.num_ended: Counter[str] = Counter()
        self._seconds: dict[str, float] = {}

    @property
    def is_idle(self) -> bool:
        """Tell whether nothing runs or could."""
        return not self.running and not self._ready

    def add(self, run_shard: RunShard, shards: Sequence[Shard]) -> list[Shard]:
        """Take shards that are to be computed, each after those of the list that it reads; gives those that are new."""
        new = [shard for shard in shards if shard.key not in self.added]
        self.added.update(shard.key for shard in new)
        here = {shard.key for shard in new}
        for shard in reversed(new):  # how many come one after the other from here on; a plan has followers later
            depth = self._depth[shard.key] = 1 + self._depth.get(shard.key, 0)
            for key in shard.after:
                self._depth[key] = max(self._depth.get(key, 0), depth)
        for shard in new:
            self.num_left[shard.stage] += 1
            self._runs[shard.stage] = run_shard
            waits = {key for key in shard.after if key in here or (key in self.added and key not in self.done)}
            if any(key in self.failed or key in self.behind for key in waits):
                self._leave_out(shard)
            elif waits:
                self._waits_for[shard.key] = waits
                for key in waits:
                    self._followers.setdefault(key, []).append(shard)
            else:
                self._make_ready(shard)
        return new

    def start(self) -> None:
        """Hand over what the pool has room for."""
        while self._ready and self._pool.has_room(self._ready[0][-1]):
            shard = heapq.heappop(self._ready)[-1]
            self.running[shard.key] = shard
            self._pool.start(self._runs[shard.stage], shard)

    def next(self) -> ShardDone | ShardFailed | None:
        """Return what ended, None when nothing did for a moment; a failure after which none can do better is raised."""
        ended = self._pool.next()
        if ended is None:
            return None
        shard = ended.shard
        del self.running[shard.key]
        self.num_left[shard.stage] -= 1
        self.num_ended[shard.stage] += 1
        followers = self._followers.pop(shard.key, [])
        if isinstance(ended, ShardFailed):
            self.failed[shard.key] = ended.error
            self._failed_shards[shard.key] = shard
            if ended.error.is_fatal:
                raise ended.error
            for follower in followers:
                self._leave_out(follower)
            return ended
        self.done.add(shard.key)
        self._seconds[shard.stage] = self._seconds.get(shard.stage, 0.0) + ended.seconds
        self._num_measured[shard.stage] += 1
        for follower in followers:
            if (waits := self._waits_for.get(follower.key)) is not None:
                waits.discard(shard.key)
                if not waits:
                    del self._waits_for[follower.key]
                    self._make_ready(follower)
        return ended

    def mean_seconds(self, stage: str) -> float | None:
        """Return what a shard of a stage took, in the mean of those done; None before one is."""
        count = self._num_measured[stage]
        return self._seconds[stage] / count if count else None

    def has_ended(self, shard: Shard) -> bool:
        """Tell whether a shard is committed, failed, or comes after one that failed."""
        return shard.key in self.done or shard.key in self.failed or shard.key in self.behind

    def error_of(self, shards: Iterable[Shard]) -> ShardError | None:
        """Return one error for all of these that failed, in this order; None where none did."""
        errors = [self.failed[shard.key] for shard in shards if shard.key in self.failed]
        return joined(errors) if errors else None

    def errors_of_stage(self, name: str) -> ShardError | None:
        """Return one error for all shards of a stage that failed; None where none did."""
        failed = [one for one in self._failed_shards.values() if one.stage == name]
        return self.error_of(sorted(failed, key=lambda shard: (shard.partition, shard.name)))

    def _make_ready(self, shard: Shard) -> None:
        self._num_added += 1
        place = (-self._urgency.get(shard.stage, 0), -self._depth[shard.key], self._num_added)
        heapq.heappush(self._ready, (*place, shard))

    def _leave_out(self, shard: Shard) -> None:
        if shard.key not in self.behind:
            self.behind[shard.key] = shard
            self.num_left[shard.stage] -= 1
            self._waits_for.pop(shard.key, None)
            for follower in self._followers.pop(shard.key, []):
                self._leave_out(follower)


def stages_behind(graph: Graph) -> dict[str, int]:
    """Return for each stage how many stages, one after the other, wait for it: what is urgent waits for no branch."""
    behind: dict[str, int] = {}
    for name in reversed(graph.names):
        below = [behind[other] for other in behind if name in graph.upstream[other]]
        behind[name] = 1 + max(below, default=0)
    return behind
