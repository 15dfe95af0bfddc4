"""Runs shards: one in a worker, and the pools that take many: a Dask cluster, or this process alone."""

from __future__ import annotations

import queue
import sys
import threading
import time
import traceback
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from threadpoolctl import ThreadpoolController

from storage_schema import ArtifactRef, CorruptArtifact, StorageError, Store, lineage
from tasks.shards.cluster import DEATHS_ALLOWED, is_refused, peak_memory_bytes, refusals
from tasks.shards.errors import ClusterError, ShardError, in_one_line
from tasks.stage import Shard, artifact_fields

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["ClusterPool", "HerePool", "Pool", "ShardDone", "ShardFailed", "run"]

RunShard = Callable[[Shard, Store], ArtifactRef]

_LOOK_UP_S = 0.2  # how long a pool waits for a shard to end before it says that none has
_FETCH_S = 2.0  # and for a result, which is a moment's work unless its worker is gone
_SHORT_S = 0.3  # a worker has a second shard of this length waiting, so that it need not wait for the next
_COUNT_AGAIN_S = 5.0  # how often the workers of somebody's cluster are counted: they come and go
_NO_WORKER_S = 60.0  # how long it may have none after one had to leave
_ONE_AT_A_TIME = threading.RLock()
_GIVE_BACK_S = 0.1  # before a worker that leaves gives a shard back: the scheduler learns meanwhile that it does


@dataclass(frozen=True)
class ShardDone:
    """What a finished shard leaves: its artifact and how long it took in the worker."""

    shard: Shard
    ref: ArtifactRef
    seconds: float


@dataclass(frozen=True)
class ShardFailed:
    """What a shard leaves that failed."""

    shard: Shard
    error: ShardError


def run(run_shard: RunShard, shard: Shard, store_root: str) -> tuple[ArtifactRef, float]:
    """Compute one shard in this process: the only function that workers are sent.

    Returns the artifact and the seconds it took. Whatever goes wrong is raised as a ShardError, which survives the way
    back from the worker even where the original error would not.

    The linear algebra has one thread, also where the process was started with more: sums of several threads are
    rounded otherwise, and the bytes would differ. A process computes one shard at a time, whatever threads it has: that
    limit holds for the whole process, and what shards share (evidence of annotations) has room for one search alone.

    A worker that is not fit for the run gives the shard back to the scheduler: another one computes it.
    """
    if is_refused:
        from distributed import Reschedule

        time.sleep(_GIVE_BACK_S)
        raise Reschedule
    started = time.perf_counter()
    try:
        store = Store(store_root)
        store.measure()
        with _ONE_AT_A_TIME, _libraries(len(sys.modules)).limit(limits=1):
            ref = run_shard(shard, store)
    except Exception as error:  # noqa: BLE001 - every error of a shard is passed on as one that can be pickled
        reason, trace = in_one_line(error), traceback.format_exc()
        if isinstance(error, CorruptArtifact) and (dropped := _drop_damaged(shard, Store(store_root))):
            reason += f"; {dropped} is damaged and was removed, the same command computes it again"
        failure = ShardError(_where(shard), type(error).__name__, reason, trace)
    else:
        return ref, time.perf_counter() - started
    raise failure  # out here it drags no original error along, which may not be picklable


def _drop_damaged(shard: Shard, store: Store) -> str:
    """Remove what is damaged of all that a shard comes from, the nearest alone; gives its name, empty where none is."""
    with suppress(StorageError, OSError):
        for step in lineage(store, *artifact_fields(shard, store)["inputs"]):
            if step.manifest is not None and store.drop_damaged(step.manifest):
                return f"{step.ref.stage}@{step.ref.key[:12]}"
    return ""


class Pool(ABC):
    """Takes shards whose inputs are all there, computes and commits them, and gives them back as they end."""

    num_workers: int = 1

    @abstractmethod
    def has_room(self, shard: Shard) -> bool:
        """Tell whether a shard may be started now: where no worker would come to it soon, a better one may come up."""

    @abstractmethod
    def start(self, run_shard: RunShard, shard: Shard) -> None:
        """Take a shard."""

    @abstractmethod
    def next(self) -> ShardDone | ShardFailed | None:
        """Return a shard that has ended; None when none has for a moment.

        Raises:
            ClusterError: There is nobody left to compute.
        """

    @abstractmethod
    def give_up(self) -> None:
        """Drop what was started and has not ended."""

    def peak_memory_bytes(self) -> int:
        """Return the most memory that this process, or any that computes, has held."""
        return peak_memory_bytes(None)


class HerePool(Pool):
    """Computes in this process, one shard after the other."""

    def __init__(self, store_root: str) -> None:
        self._store_root = store_root
        self._waiting: list[tuple[RunShard, Shard]] = []

    def has_room(self, shard: Shard) -> bool:
        """Tell whether nothing waits."""
        return not self._waiting

    def start(self, run_shard: RunShard, shard: Shard) -> None:
        """Take a shard, to be computed when the next one is asked for."""
        self._waiting.append((run_shard, shard))

    def next(self) -> ShardDone | ShardFailed | None:
        """Compute the shard that waits."""
        if not self._waiting:
            return None
        run_shard, shard = self._waiting.pop()
        try:
            return ShardDone(shard, *run(run_shard, shard, self._store_root))
        except ShardError as error:
            return ShardFailed(shard, error)

    def give_up(self) -> None:
        """Drop the shard that waits."""
        self._waiting.clear()


class ClusterPool(Pool):
    """Computes on a client's workers, somebody's (`is_shared`) or the run's own.

    A shard whose worker dies is sent again by the scheduler; one that kills several workers fails, and is named.
    """

    def __init__(self, client: Client, store_root: str, *, is_shared: bool = False) -> None:
        self.client = client
        self._store_root = store_root
        self._is_shared = is_shared
        self._flying: dict[Any, Shard] = {}
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._seconds: dict[str, float] = {}
        self._num_refused_before = len(refusals(client)) if is_shared else 0
        self._seen_at = time.monotonic()
        self._count_workers()

    def has_room(self, shard: Shard) -> bool:
        """Tell whether a worker is free; one shard more for each where it is a short one, or others wait as well."""
        ahead = self._is_shared or self._seconds.get(shard.stage, _SHORT_S) < _SHORT_S
        return len(self._flying) < self.num_workers * (2 if ahead else 1)

    def start(self, run_shard: RunShard, shard: Shard) -> None:
        """Submit a shard."""
        name = f"{shard.stage}-{shard.key[:16]}-{uuid.uuid4().hex[:8]}"
        future = self.client.submit(run, run_shard, shard, self._store_root, key=name, pure=False)
        self._flying[future] = shard
        future.add_done_callback(self._arrived.put)

    def next(self) -> ShardDone | ShardFailed | None:
        """Wait a moment for a shard to end."""
        if self._is_shared and time.monotonic() - self._counted_at > _COUNT_AGAIN_S:
            self._count_workers()
        try:
            future = self._arrived.get(timeout=_LOOK_UP_S)
        except queue.Empty:
            return None
        shard = self._flying[future]
        try:
            ref, seconds = self._result(future, shard)
        except TimeoutError:
            # Lost on its way, with the worker that held it: the scheduler computes the shard again.
            self._arrived.put(future)
            return None
        except ShardError as error:
            ended: ShardDone | ShardFailed = ShardFailed(shard, error)
        else:
            ended = ShardDone(shard, ref, seconds)
            self._seconds[shard.stage] = 0.5 * (seconds + self._seconds.get(shard.stage, seconds))
        del self._flying[future]
        future.release()
        return ended

    def give_up(self) -> None:
        """Cancel what is on its way."""
        if self._flying:
            with suppress(ClusterError), _scheduler_is_there():
                self.client.cancel(list(self._flying), force=True)
            self._flying.clear()

    def peak_memory_bytes(self) -> int:
        """Return the most memory that this process or any worker alive has held."""
        with _scheduler_is_there():
            return peak_memory_bytes(self.client)

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

    def _result(self, future: Any, shard: Shard) -> tuple[ArtifactRef, float]:
        """Return a finished future's result; only `.result()` tells of a dead worker."""
        from distributed import KilledWorker

        try:
            with _scheduler_is_there():
                result: tuple[ArtifactRef, float] = future.result(timeout=_FETCH_S)
        except KilledWorker:
            reason = (
                f"its worker process died {DEATHS_ALLOWED + 1} times; it was killed from outside or needed more memory "
                "than a worker may have"
            )
            raise ShardError(_where(shard), "KilledWorker", reason) from None
        return result


@contextmanager
def _scheduler_is_there() -> Iterator[None]:
    """Say of what a scheduler did not answer that it is gone: ClusterError."""
    from distributed import CancelledError
    from distributed.comm.core import CommClosedError

    try:
        yield
    except (CancelledError, CommClosedError):
        raise ClusterError("the Dask scheduler is gone; the same command continues the work") from None


@lru_cache(maxsize=1)
def _libraries(num_modules: int) -> ThreadpoolController:
    """Return the libraries with threads of their own; looked for again only where modules were imported since."""
    return ThreadpoolController()


def _where(shard: Shard) -> str:
    return f"stage {shard.stage}, {shard.partition}, shard {shard.name}"
