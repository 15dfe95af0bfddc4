"""Estimates a build on any number of workers: shards take their measured times, the longest chains run first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

import numpy as np

from flows.planning import Plan, PlanError, StagePlan
from flows.records import read_last_run, run_record
from storage_schema import ArtifactRef, Manifest, Store
from storage_schema.store import PROCESSOR_S, SHARD_S
from tasks.graph import Graph

DISPATCH_S = 0.004
"""Of the run's own process for a shard, as shards are handed out one at a time: 2.3 ms were measured in a run of 602
shards without workers, the rest is assumed for Dask."""
OVERHEAD_S = 0.004
"""Of a worker for a shard, beside what the shard takes: receiving it, and waiting for the next.  Assumed."""


class Job(NamedTuple):
    """A shard with its seconds on a worker, or the end of a stage, which takes none; `after` has numbers of jobs."""

    seconds: float = 0.0
    after: tuple[int, ...] = ()
    is_shard: bool = True


@dataclass
class Work:
    """The known work of a build.

    Args:
        jobs: The jobs, each after those that it waits for.
        worker_bytes: Peak memory of a process in the last run; None if it is not on record.
        num_shards: Shards among them.
        processor_s: Their time on one core, seconds.
        num_bytes: Bytes that they write.
        num_measured: Measured shards; others count with the mean of their stage.
        unknown: Stages that were never measured.
    """

    jobs: list[Job] = field(default_factory=list)
    worker_bytes: int | None = None
    num_shards: int = 0
    processor_s: float = 0.0
    num_bytes: float = 0.0
    num_measured: int = 0
    unknown: list[str] = field(default_factory=list)

    def add(self, job: Job, processor_s: float = 0.0, num_bytes: float = 0.0, *, is_measured: bool = False) -> int:
        """Add a job and return its number."""
        self.jobs.append(job)
        self.num_shards += job.is_shard
        self.processor_s += processor_s
        self.num_bytes += num_bytes
        self.num_measured += is_measured
        return len(self.jobs) - 1

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values, without the single jobs."""
        return {name: value for name, value in vars(self).items() if name != "jobs"}


@dataclass(frozen=True)
class Cost:
    """The cost of a build on a number of workers: seconds by the clock, core hours, and the busy share of these."""

    num_workers: int
    wall_s: float
    core_hours: float
    busy_share: float


def planned_work(plan: Plan, graph: Graph, store: Store, measured: Store | None = None) -> Work:
    """Return the work of a plan, as measured when it was computed before, here or in the store `measured`.

    Stages that cannot be planned yet count as last time.

    Raises:
        PlanError: Nothing of it was measured.
    """
    measured = measured or store
    last = read_last_run(measured, plan.study)
    refs = [ref for stage in plan.stages for ref in (last.refs(stage.stage.name) if last else ())]
    manifests = {ref: measured.find(ref.stage, ref.key) for ref in refs}
    had = {ref: manifest for ref, manifest in manifests.items() if manifest is not None and SHARD_S in manifest.timings}
    work = Work(worker_bytes=run_record(measured, last.run_id).get("peak_memory_bytes") if last else None)
    numbers: dict[tuple[str, str, str], int] = {}
    ends: dict[str, int] = {}
    for stage in plan.stages:
        name = stage.stage.name
        if not stage.is_selected or stage.is_fresh:
            continue
        if not any(manifest.ref.stage == name for manifest in had.values()):
            work.unknown.append(name)
            continue
        waits = () if stage.stage.early else tuple(ends[other] for other in graph.upstream[name] if other in ends)
        first = len(work.jobs)
        _add_stage(work, stage, had, numbers, waits)
        ends[name] = work.add(Job(after=tuple(range(first, len(work.jobs))), is_shard=False))
    if not work.jobs:
        raise PlanError(
            f"what {', '.join(work.unknown) or 'this'} takes was not measured: build it once, also with fewer takes or "
            "variants (--measured STORE says where)"
        )
    return work


def _add_stage(
    work: Work,
    stage: StagePlan,
    had: Mapping[ArtifactRef, Manifest],
    numbers: dict[tuple[str, str, str], int],
    waits: tuple[int, ...],
) -> None:
    """Add the shards of a stage by their places; their keys are unknown until their inputs exist."""
    name = stage.stage.name
    before = {(manifest.partition, manifest.name): manifest for manifest in had.values() if manifest.ref.stage == name}
    took = {
        at: (manifest.timings[SHARD_S], manifest.timings[PROCESSOR_S], manifest.num_bytes)
        for at, manifest in before.items()
    }
    means = np.mean([*took.values()], axis=0).tolist()
    planned = {(shard.partition, shard.name): shard for shard in stage.todo}
    places = {shard.key: place for place, shard in planned.items()}
    for place in planned or before if not stage.is_pending else before:
        if place in planned:
            reads = [(name, *places[key]) for key in planned[place].after if key in places]
        else:
            reads = [(ref.stage, read.partition, read.name) for ref in before[place].inputs if (read := had.get(ref))]
        seconds, *spent = took.get(place, means)
        job = Job(seconds, (*waits, *(numbers[at] for at in reads if at in numbers)))
        numbers[name, *place] = work.add(job, *spent, is_measured=place in took)


def estimate_cost(work: Work, num_workers: int) -> Cost:
    """Estimate the work on this many workers of the measured speed, by simulating it shard by shard."""
    jobs, left = work.jobs, [len(job.after) for job in work.jobs]
    followers: list[list[int]] = [[] for _ in jobs]
    for number, job in enumerate(jobs):
        for before in job.after:
            followers[before].append(number)
    behind_s = [0.0] * len(jobs)
    for number in reversed(range(len(jobs))):
        behind_s[number] = jobs[number].seconds + max(
            (behind_s[follower] for follower in followers[number]), default=0.0
        )
    ready = [(-behind_s[number], number) for number, count in enumerate(left) if not count]
    heapify(ready)
    running: list[tuple[float, int]] = []
    now_s = handed_out_s = 0.0
    while ready or running:
        while ready and len(running) < num_workers:
            number = heappop(ready)[1]
            ends_s = now_s
            if jobs[number].is_shard:
                handed_out_s = max(handed_out_s, now_s) + DISPATCH_S
                ends_s = handed_out_s + OVERHEAD_S + jobs[number].seconds
            heappush(running, (ends_s, number))
        now_s, ended = heappop(running)
        for number in followers[ended]:
            left[number] -= 1
            if not left[number]:
                heappush(ready, (-behind_s[number], number))
    busy_s = sum(job.seconds for job in jobs)
    at_work = busy_s / (num_workers * now_s) if now_s else 0.0
    return Cost(num_workers, now_s, now_s * num_workers / 3600, at_work)
