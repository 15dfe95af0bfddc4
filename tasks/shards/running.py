"""Running of shards: one in a worker, and pools for many: a Dask cluster, or this process alone."""

from __future__ import annotations

import itertools
import os
import platform
import queue
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from threadpoolctl import ThreadpoolController

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, CorruptArtifact, StorageError, Store, lineage
from storage_schema.store import SHARD_S
from tasks.shards.cluster import DEATHS_ALLOWED, is_refused, peak_memory_bytes, refusals
from tasks.shards.errors import ClusterError, ShardError, in_one_line
from tasks.stage import Shard
from tasks.stage.committing import artifact_fields
from tasks.stage.kept import forget_kept

if TYPE_CHECKING:
    from distributed import Client

RunShard = Callable[[Shard, Store], ArtifactRef]

_FETCH_S = 2.0  # and for a result, which arrives at once unless its worker is gone
_COUNT_AGAIN_S = 5.0  # how often the workers of a shared cluster are counted, because they join and leave
_NO_WORKER_S = 60.0  # how long it may have no worker after one had to leave
_ONE_AT_A_TIME = threading.RLock()
_BEGUN = set[str]()
"""Stages of which this process has computed a shard."""
_GIVE_BACK_S = 0.1  # wait before a leaving worker returns a shard, until the scheduler knows that it leaves


@dataclass(frozen=True)
class WhereComputed:
    """Place, time and cost of a shard's computation.

    Args:
        process: Machine and number of the process.
        began_s: Seconds since 1970 when it began.
        processor_s: Seconds of processor time of its thread.
        memory_bytes: The most memory that the process had held by the end.
    """

    process: str
    began_s: float
    processor_s: float
    memory_bytes: int


class Result(NamedTuple):
    """A worker's answer for a shard: its artifact, the seconds it took, and where; the latter None if it existed."""

    ref: ArtifactRef
    seconds: float
    place: WhereComputed | None


@dataclass(frozen=True)
class ShardDone:
    """Result of a finished shard: its artifact, the seconds in the worker, and where; the latter None if it existed."""

    shard: Shard
    ref: ArtifactRef
    seconds: float
    place: WhereComputed | None = None


@dataclass(frozen=True)
class ShardFailed:
    """Result of a shard that failed, or was not tried because one before it failed; the error names the failed one."""

    shard: Shard
    error: ShardError

    @property
    def is_behind(self) -> bool:
        """Tell whether it was not tried."""
        return self.error.where != _where(self.shard)


def run(run_shard: RunShard, shard: Shard, store_root: str, *_: object) -> Result:
    """Compute one shard in this process, after those before it. Workers are sent only this function.

    Returns the artifact, the seconds it took, and where: an existing artifact is not computed again, unless it is to be
    replaced. Every error is raised as a ShardError, which can be pickled even if the original error cannot.

    Linear algebra uses one thread even if the process was started with more: sums over several threads round
    differently, so the bytes would differ. A process computes one shard at a time, whatever its threads: the limit
    applies to the whole process, and data shared by shards (evidence of annotations) serves one search at a time.

    Caches of shards are emptied when a process begins another stage, because the previous one is mostly done.

    A worker that is not fit for the run gives the shard back to the scheduler: another one computes it.
    """
    if is_refused:
        from distributed import Reschedule

        time.sleep(_GIVE_BACK_S)
        raise Reschedule
    began_s, started, spent_s = time.time(), time.perf_counter(), time.thread_time()
    try:
        store = Store(store_root)
        if not shard.replaces and (manifest := store.find(shard.stage, shard.key)) is not None:
            return Result(manifest.ref, manifest.timings.get(SHARD_S, 0.0), None)
        store.measure()
        with _ONE_AT_A_TIME, _libraries(len(sys.modules)).limit(limits=1):
            if shard.stage not in _BEGUN:
                _BEGUN.add(shard.stage)
                forget_kept()
            ref = run_shard(shard, store)
    except Exception as error:  # noqa: BLE001 - every error of a shard is passed on as one that can be pickled
        reason, trace = in_one_line(error), traceback.format_exc()
        if isinstance(error, CorruptArtifact) and (dropped := _drop_damaged(shard, Store(store_root))):
            reason += f"; {dropped} is damaged and was removed, the same command computes it again"
        failure = ShardError(_where(shard), type(error).__name__, reason, trace)
    else:
        spent_s = time.thread_time() - spent_s
        place = WhereComputed(f"{platform.node()} {os.getpid()}", began_s, spent_s, peak_memory_bytes(None))
        return Result(ref, time.perf_counter() - started, place)
    raise failure  # out here it drags no original error along, which may not be picklable


def _drop_damaged(shard: Shard, store: Store) -> str:
    """Remove the nearest damaged artifact that a shard depends on, and return its name; empty if none is damaged."""
    with suppress(StorageError, InputError, OSError):
        for step in lineage(store, *artifact_fields(shard, store)["inputs"]):
            if step.manifest is not None and store.drop_damaged(step.manifest):
                return f"{step.ref.stage}@{step.ref.key[:12]}"
    return ""


class Pool:
    """Submits shards to a Dask client or a similar one, and reports their results.

    Args:
        client: Computes what has the highest priority first.
        store_root: Where shards commit.
    """

    num_workers: int = 1

    def __init__(self, client: Any, store_root: str) -> None:
        self.client = client
        self._store_root = store_root
        self._run_id = f"shards-{uuid.uuid4().hex[:8]}"
        self._futures: dict[str, Any] = {}

    def submit(self, run_shard: RunShard, shard: Shard, priority: int, tell: Callable[[Shard], None]) -> None:
        """Submit a shard with the futures of those that it comes after; `tell` is called, in any thread, at its end.

        Shards before it have a higher priority, and were submitted earlier or are committed.
        """
        before = [future for key in shard.after if (future := self._futures.get(key)) is not None]
        # One group for all: the scheduler then keeps every shard in the queue of its priorities until a worker is free.
        name = (self._run_id, f"{_where(shard)}, {shard.key[:12]}")
        future = self.client.submit(
            run, run_shard, shard, self._store_root, *before, key=name, priority=priority, pure=False
        )
        self._futures[shard.key] = future
        future.add_done_callback(lambda _: tell(shard))

    def ended(self, shard: Shard) -> ShardDone | ShardFailed | None:
        """Return the result of a shard; None if it was lost with a worker and is computed again.

        Raises:
            ClusterError: No worker is left.
        """
        future = self._futures[shard.key]
        try:
            ended = ShardDone(shard, *self._result(future, shard))
        except TimeoutError:
            return None
        except ShardError as error:
            return ShardFailed(shard, error)  # its future stays, so that shards after it fail with it
        del self._futures[shard.key]
        return ended

    def work(self) -> bool:
        """Do periodic work; returns whether a shard was computed here."""
        return False

    def give_up(self) -> None:
        """Cancel submitted shards that have not ended."""
        if self._futures:
            self.client.cancel(list(self._futures.values()), force=True)
            self._futures.clear()

    def peak_memory_bytes(self) -> int:
        """Return the most memory that this process, or any that computes, has used."""
        return peak_memory_bytes(None)

    def _result(self, future: Any, shard: Shard) -> Result:
        result: Result = future.result()
        return result


@dataclass(order=True)
class Call:
    """A pending call of `HereClient`."""

    place: tuple[int, int]
    future: Future[Any] = field(compare=False)
    function: Callable[..., Any] = field(compare=False)
    arguments: tuple[Any, ...] = field(compare=False)

    def make(self) -> Result:
        """Make the call; raise the error of any failed future among its arguments."""
        result: Result
        result = self.function(
            *(argument.result() if isinstance(argument, Future) else argument for argument in self.arguments)
        )
        return result


class HereClient:
    """Computes where `work` is called, one call after the other; has the part of a Dask client that pools use.

    Whatever a call waits for has a higher priority, so it has ended by then.
    """

    def __init__(self) -> None:
        self.waiting: queue.PriorityQueue[Call] = queue.PriorityQueue()
        self._count = itertools.count()

    def submit(self, function: Callable[..., Any], *arguments: Any, priority: int, **_: object) -> Future[Any]:
        """Take a call; futures among its arguments are those of calls of higher priorities."""
        call = Call((-priority, next(self._count)), Future(), function, arguments)
        self.waiting.put(call)
        return call.future

    def work(self) -> bool:
        """Make the call of the highest priority; returns whether there was one."""
        if self.waiting.empty():
            return False
        call = self.waiting.get()
        try:
            call.future.set_result(call.make())
        except ShardError as error:
            call.future.set_exception(error)
        return True

    def cancel(self, futures: Sequence[Future[Any]], *, force: bool) -> None:
        """Forget all calls that were not made."""
        self.waiting = queue.PriorityQueue()


class HerePool(Pool):
    """Computes in this process, one shard after the other, in the thread that calls `work`."""

    client: HereClient

    def __init__(self, store_root: str, client: HereClient | None = None) -> None:
        super().__init__(client or HereClient(), store_root)

    def work(self) -> bool:
        """Compute the shard of the highest priority."""
        return self.client.work()


class ClusterPool(Pool):
    """Computes on the workers of a Dask client, shared with others (`is_shared`) or the run's own.

    A shard whose worker dies is sent again by the scheduler; one that kills several workers fails, and is named.
    `note` is called with sentences on workers that join later and are refused.
    """

    def __init__(
        self, client: Client, store_root: str, *, is_shared: bool = False, note: Callable[[str], None] | None = None
    ) -> None:
        super().__init__(client, store_root)
        self._is_shared, self._note = is_shared, note
        self._num_refused_before = self._num_told = len(refusals(client)) if is_shared else 0
        self._seen_at = time.monotonic()
        self._count_workers()

    def work(self) -> bool:
        """Count the workers of a shared cluster, which join and leave; ClusterError if none is left."""
        if self._is_shared and time.monotonic() - self._counted_at > _COUNT_AGAIN_S:
            self._tell_refused()
            self._count_workers()
        return False

    def give_up(self) -> None:
        """Cancel submitted shards, if there is a scheduler."""
        with suppress(ClusterError), _scheduler_is_there():
            super().give_up()

    def peak_memory_bytes(self) -> int:
        """Return the most memory that this process or any worker alive has held."""
        with _scheduler_is_there():
            return peak_memory_bytes(self.client)

    def _tell_refused(self) -> None:
        with _scheduler_is_there():
            new = refusals(self.client)[self._num_told :]
        self._num_told += len(new)
        if new and self._note is not None:
            more = f" (and {len(new) - 1} more since)" if len(new) > 1 else ""
            self._note(f"refused: {new[-1]}{more}")

    def _count_workers(self) -> None:
        with _scheduler_is_there():
            workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        self.num_workers = max(1, len(workers))
        self._counted_at = time.monotonic()
        if workers:
            self._seen_at = self._counted_at
        elif self._counted_at - self._seen_at > _NO_WORKER_S:
            with _scheduler_is_there():
                refused = refusals(self.client)[self._num_refused_before :]
            if refused:
                raise ClusterError(f"{refused[-1]}; no other worker came for {_NO_WORKER_S:g} s")

    def _result(self, future: Any, shard: Shard) -> Result:
        """Return a finished future's result; only `.result()` reports a dead worker."""
        from distributed import KilledWorker

        try:
            with _scheduler_is_there():
                result: Result = future.result(timeout=_FETCH_S)
        except KilledWorker as error:
            reason = (
                f"its worker process died {DEATHS_ALLOWED + 1} times; it was killed from outside or needed more memory "
                "than a worker may have"
            )
            name = cast(tuple[str, str], error.task)[1]
            raise ShardError(name.rpartition(", ")[0], "KilledWorker", reason) from None
        return result


@contextmanager
def _scheduler_is_there() -> Iterator[None]:
    """Raise a ClusterError, that the scheduler is gone, for calls that it does not answer.

    A call that is cancelled on its way leaves `distributed.utils.sync` without a result: UnboundLocalError.
    """
    from distributed import CancelledError
    from distributed.comm.core import CommClosedError

    try:
        yield
    except (CancelledError, CommClosedError, UnboundLocalError):
        raise ClusterError("the Dask scheduler is gone; the same command continues the work") from None


@lru_cache(maxsize=1)
def _libraries(num_modules: int) -> ThreadpoolController:
    """Return the libraries with threads of their own, searched again only after modules were imported."""
    return ThreadpoolController()


def _where(shard: Shard) -> str:
    return f"stage {shard.stage}, {shard.partition}, shard {shard.name}"
