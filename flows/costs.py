"""What a build would cost on any number of workers: shards take what they took, the order is that of a real run."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flows.building import stages_behind
from flows.planning import Plan, PlanError, StagePlan
from flows.records import read_last_run, run_record
from storage_schema import Manifest, Store
from storage_schema.store import PROCESSOR_S, SHARD_S
from tasks.graph import Graph
from tasks.stage import Parameters, Shard, stream

__all__ = ["Cost", "Faults", "Work", "estimate_cost", "planned_work", "scaled_to_takes"]

DISPATCH_S = 0.004
"""Of the run's own process for a shard, as shards are handed out one at a time: 2.3 ms were measured in a run of 602
shards without workers, the rest is assumed for Dask."""
OVERHEAD_S = 0.004
"""Of a worker for a shard, beside what the shard takes: receiving it, and waiting for the next.  Assumed."""
_WHOLE = "whole"


@dataclass(frozen=True)
class Faults:
    """What goes wrong on a cluster.

    Args:
        slow_share: Part of all shards that take `slow_factor` times as long: a busy machine, a slow disk.
        slow_factor: How much longer.
        losses_per_hour: Of each worker; what it was computing is computed again.
        restart_s: Until another takes its place.
    """

    slow_share: float = 0.0
    slow_factor: float = 1.0
    losses_per_hour: float = 0.0
    restart_s: float = 30.0


@dataclass(frozen=True)
class Work:
    """Shards that have to be computed, as they are known: what each takes, and which come before it.

    Args:
        shards: Each after those whose keys stand in its `after`.
        seconds: Of each shard on a worker, by key.
        processor_s: Of each shard on one core, by key.
        bytes_each: What each writes, by key.
        worker_bytes: The most memory that a process of the last run held; None where that is not on record.
        num_measured: Shards that were measured themselves; others take the mean of their stage.
        unknown: Stages of which nothing is known.
    """

    shards: tuple[Shard, ...]
    seconds: Mapping[str, float]
    processor_s: Mapping[str, float]
    bytes_each: Mapping[str, float]
    worker_bytes: int | None
    num_measured: int
    unknown: tuple[str, ...]

    @property
    def num_bytes(self) -> float:
        """Return what they write."""
        return sum(self.bytes_each.values())

    @property
    def num_shards(self) -> int:
        """Return the number of shards."""
        return sum(shard.stage != _WHOLE for shard in self.shards)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values, without the shards one by one."""
        return {
            "num_shards": self.num_shards,
            "processor_s": sum(self.processor_s.values()),
            "num_bytes": self.num_bytes,
            "worker_bytes": self.worker_bytes,
            "num_measured": self.num_measured,
            "unknown": list(self.unknown),
        }


@dataclass(frozen=True)
class Cost:
    """What a build takes on a number of workers: seconds by the clock, core hours, part of these at work."""

    num_workers: int
    wall_s: float
    core_hours: float
    busy_share: float


def planned_work(plan: Plan, graph: Graph, store: Store, measured: Store | None = None) -> Work:
    """Return what a plan has to compute, as far as that was computed once, here or in the store `measured`.

    Raises:
        PlanError: Nothing of it was measured.
    """
    measured = measured or store
    last = read_last_run(measured, plan.study)
    refs = [ref for stage in plan.stages for ref in (last.refs(stage.stage.name) if last else ())]
    had = {
        ref.key: one
        for ref in refs
        if (one := measured.find(ref.stage, ref.key)) is not None and SHARD_S in one.timings
    }
    work, unknown = _Collected(had), []
    for stage in plan.stages:
        if stage.is_selected and not stage.is_fresh and not work.add_stage(stage, graph.upstream[stage.stage.name]):
            unknown.append(stage.stage.name)
    if not work.shards:
        raise PlanError(
            f"what {', '.join(unknown) or 'this'} takes was not measured: build it once, also with fewer takes or "
            "variants (--measured STORE says where)"
        )
    return Work(
        shards=tuple(work.shards),
        seconds=work.seconds,
        processor_s=work.processor_s,
        bytes_each=work.bytes_each,
        worker_bytes=run_record(measured, last.run_id).get("peak_memory_bytes") if last else None,
        num_measured=work.num_measured,
        unknown=tuple(unknown),
    )


def scaled_to_takes(work: Work, graph: Graph, num_takes: int) -> Work:
    """Return the same for so many takes, each as one of those that are there, of stages whose shards read one take.

    Stages that read many takes at once are left out: what they take for more is not known.

    Raises:
        PlanError: None of the stages reads single takes.
    """
    each = {stage.name for stage in graph.stages if any(early.each and not early.reads for early in stage.early)}
    single = {name for name in graph.names if name in each or (not graph.upstream[name] and graph.below(name) & each)}
    takes: dict[str, list[Shard]] = {}
    for shard in work.shards:
        if shard.stage in single:
            takes.setdefault(shard.partition, []).append(shard)
    if not takes:
        raise PlanError("none of the stages to be computed works on single takes")
    chosen = stream(0, "takes").choice(sorted(takes), size=num_takes)
    shards: list[Shard] = []
    seconds, processor_s, bytes_each = {}, {}, {}
    for index, name in enumerate(chosen):
        new: dict[str, str] = {}
        for shard in takes[str(name)]:
            copy = replace(
                shard, partition=f"{name} {index}", after=tuple(new[key] for key in shard.after if key in new)
            )
            new[shard.key] = copy.key
            shards.append(copy)
            seconds[copy.key], processor_s[copy.key] = work.seconds[shard.key], work.processor_s[shard.key]
            bytes_each[copy.key] = work.bytes_each[shard.key]
    left_out = {shard.stage for shard in work.shards if shard.stage not in {*single, _WHOLE}}
    return replace(
        work,
        shards=tuple(shards),
        seconds=seconds,
        processor_s=processor_s,
        bytes_each=bytes_each,
        num_measured=len(shards) if work.num_measured == work.num_shards else 0,
        unknown=(*work.unknown, *sorted(left_out)),
    )


def estimate_cost(work: Work, graph: Graph, num_workers: int, faults: Faults | None = None) -> Cost:
    """Return what the work takes on so many workers as fast as those measured, by going through it shard by shard."""
    workers = _ImaginedWorkers(num_workers, work.seconds, faults or Faults())
    urgency = {**stages_behind(graph), _WHOLE: len(graph.stages) + 1}
    followers: dict[str, list[Shard]] = {}
    way = dict.fromkeys((shard.key for shard in work.shards), 0)
    for shard in reversed(work.shards):
        for key in shard.after:
            followers.setdefault(key, []).append(shard)
            way[key] = max(way.get(key, 0), way[shard.key] + 1)
    waits = {shard.key: sum(key in work.seconds for key in shard.after) for shard in work.shards}
    place = {shard.key: (-urgency[shard.stage], -way[shard.key], at) for at, shard in enumerate(work.shards)}
    ready = [(*place[shard.key], shard) for shard in work.shards if not waits[shard.key]]
    heapq.heapify(ready)
    while ready or workers.ends:
        while ready and workers.has_room(ready[0][-1]):
            workers.start(heapq.heappop(ready)[-1])
        for shard in followers.get(workers.next().key, ()):
            waits[shard.key] -= 1
            if not waits[shard.key]:
                heapq.heappush(ready, (*place[shard.key], shard))
    at_work = workers.busy_s / (num_workers * workers.now_s) if workers.now_s else 0.0
    return Cost(num_workers, workers.now_s, workers.now_s * num_workers / 3600, at_work)


class _Collected:
    """Shards that are to be computed, by where they stand: their keys are not known before what they read is there.

    Args:
        had: What was measured, by key.
    """

    def __init__(self, had: Mapping[str, Manifest]) -> None:
        self.shards: list[Shard] = []
        self.seconds: dict[str, float] = {}
        self.processor_s: dict[str, float] = {}
        self.bytes_each: dict[str, float] = {}
        self.num_measured = 0
        self._had = had
        self._there: dict[tuple[str, str, str], str] = {}
        self._whole: dict[str, str] = {}

    def add_stage(self, stage: StagePlan, upstream: Sequence[str]) -> bool:
        """Add the shards of a stage, those planned, or where it cannot be planned yet those it had; False: unknown."""
        name = stage.stage.name
        before = {(one.partition, one.name): one for one in self._had.values() if one.ref.stage == name}
        if not before:
            return False
        took = [(one.timings[SHARD_S], one.timings[PROCESSOR_S], one.num_bytes) for one in before.values()]
        means = [float(mean) for mean in np.mean(took, axis=0)]
        waits = () if stage.stage.early else tuple(self._whole[other] for other in upstream if other in self._whole)
        planned = {(shard.partition, shard.name): shard for shard in stage.todo}
        own = {shard.key: place for place, shard in planned.items()}
        for place in planned or before if not stage.is_pending else before:
            one = before.get(place)
            if place in planned:
                reads = [(name, *own[key]) for key in planned[place].after if key in own]
            else:
                reads = [(r.stage, m.partition, m.name) for r in before[place].inputs if (m := self._had.get(r.key))]
            self._add(
                Shard(
                    name,
                    0,
                    *place,
                    Parameters(),
                    after=(*waits, *(self._there[at] for at in reads if at in self._there)),
                ),
                *((one.timings[SHARD_S], one.timings[PROCESSOR_S], one.num_bytes) if one else means),
            )
            self.num_measured += one is not None
        keys = tuple(shard.key for shard in self.shards if shard.stage == name)
        whole = Shard(_WHOLE, 0, name, _WHOLE, Parameters(), after=keys)
        self._add(whole, 0.0, 0.0, 0.0)
        self._whole[name] = whole.key
        return True

    def _add(self, shard: Shard, seconds: float, processor_s: float, num_bytes: float) -> None:
        self._there[shard.stage, shard.partition, shard.name] = shard.key
        self.seconds[shard.key], self.processor_s[shard.key] = seconds, processor_s
        self.bytes_each[shard.key] = num_bytes
        self.shards.append(shard)


class _ImaginedWorkers:
    """Workers on a clock of their own, which moves from the end of one shard to that of the next."""

    def __init__(self, num_workers: int, seconds: Mapping[str, float], faults: Faults) -> None:
        self._num_workers = num_workers
        self.now_s = self.busy_s = 0.0
        self._seconds, self._faults = seconds, faults
        self.ends: list[tuple[float, int, Shard]] = []
        self._num_started = 0
        self._handed_out_s = 0.0
        self._random = stream(0, "faults")

    def has_room(self, shard: Shard) -> bool:
        """Tell whether a worker is free; what only marks the end of a stage needs none."""
        return len(self.ends) < self._num_workers or shard.stage == _WHOLE

    def start(self, shard: Shard) -> None:
        """Give a shard to a worker."""
        takes_s = waits_s = 0.0
        if shard.stage != _WHOLE:
            self._handed_out_s = max(self._handed_out_s, self.now_s) + DISPATCH_S
            waits_s = self._handed_out_s - self.now_s
            takes_s = self._draw(self._seconds[shard.key])
            self.busy_s += self._seconds[shard.key]
            takes_s += OVERHEAD_S
        self._num_started += 1
        heapq.heappush(self.ends, (self.now_s + waits_s + takes_s, self._num_started, shard))

    def next(self) -> Shard:
        """Go to the end of the shard that ends first."""
        self.now_s, _, shard = heapq.heappop(self.ends)
        return shard

    def _draw(self, seconds: float) -> float:
        """Return how long a shard takes where things go wrong."""
        faults, lost_s = self._faults, 0.0
        if faults.slow_share and self._random.random() < faults.slow_share:
            seconds *= faults.slow_factor
        while faults.losses_per_hour and seconds:
            until_lost_s = self._random.exponential(3600 / faults.losses_per_hour)
            if until_lost_s >= seconds:
                break
            lost_s += until_lost_s + faults.restart_s
        return lost_s + seconds
