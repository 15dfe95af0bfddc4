"""Runs shards: one in a worker, many over a Dask cluster, or one after the other here."""

from __future__ import annotations

import queue
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from storage_schema import ArtifactRef, Store
from tasks.shards.cluster import DEATHS_ALLOWED
from tasks.shards.errors import ShardError, Stopped, in_one_line, joined
from tasks.stage import Shard

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["ShardDone", "run", "run_on_cluster", "run_serially"]

RunShard = Callable[[Shard, Store], ArtifactRef]

_LOOK_UP_S = 0.2  # how often a thread that waits for shards looks whether the run was given up
_FETCH_S = 2.0  # and one that waits for a result, which is a moment's work unless its worker is gone


@dataclass(frozen=True)
class ShardDone:
    """What a finished shard leaves: its artifact and how long it took in the worker."""

    shard: Shard
    ref: ArtifactRef
    seconds: float


def run(run_shard: RunShard, shard: Shard, store_root: str) -> tuple[ArtifactRef, float]:
    """Compute one shard in this process: the only function that workers are sent.

    Returns the artifact and the seconds it took. Whatever goes wrong is raised as a ShardError, which survives the way
    back from the worker even where the original error would not.

    The linear algebra has one thread, also where the process was started with more: sums of several threads are
    rounded otherwise, and the bytes would differ.
    """
    started = time.perf_counter()
    try:
        with threadpool_limits(limits=1):
            ref = run_shard(shard, Store(store_root))
    except Exception as error:  # noqa: BLE001 - every error of a shard is passed on as one that can be pickled
        failure = ShardError(_where(shard), type(error).__name__, in_one_line(error), traceback.format_exc())
    else:
        return ref, time.perf_counter() - started
    raise failure  # out here it drags no original error along, which may not be picklable


def run_serially(
    run_shard: RunShard,
    shards: Sequence[Shard],
    store_root: str,
    *,
    on_done: Callable[[ShardDone], None] | None = None,
    stop: threading.Event | None = None,
) -> list[ArtifactRef]:
    """Run shards one after the other in this process, each after those it depends on; artifacts in the order given.

    Raises:
        ShardError: Shards failed; those that need none of them are committed.
        Stopped: `stop` was set from elsewhere.
    """
    done: dict[str, ArtifactRef] = {}
    failed = _Failures(shards)
    for shard in _dependency_order(shards):
        if stop is not None and stop.is_set():
            raise Stopped("given up")
        if failed.is_behind(shard):
            continue
        try:
            ref, seconds = run(run_shard, shard, store_root)
        except ShardError as error:
            failed.add(shard, error)
            continue
        done[shard.key] = ref
        if on_done is not None:
            on_done(ShardDone(shard, ref, seconds))
    failed.raise_any()
    return [done[shard.key] for shard in shards]


def run_on_cluster(
    client: Client,
    run_shard: RunShard,
    shards: Sequence[Shard],
    store_root: str,
    *,
    max_in_flight: int = 8,
    on_done: Callable[[ShardDone], None] | None = None,
    stop: threading.Event | None = None,
) -> list[ArtifactRef]:
    """Run shards on the client's workers, at most `max_in_flight` at a time; artifacts in the order given.

    A shard with `after` keys of this list is submitted only when those are committed. A shard whose worker dies is
    sent again by the scheduler; one that kills several workers is a ShardError that names it.

    Raises:
        ShardError: Shards failed; those that need none of them are committed, unless nothing more can be written.
        Stopped: `stop` was set from elsewhere.
    """
    here = {shard.key for shard in shards}
    waiting = list(_dependency_order(shards))
    done: dict[str, ArtifactRef] = {}
    failed = _Failures(shards)
    flying: dict[Any, Shard] = {}
    arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def submit_ready() -> None:
        for shard in list(waiting):
            if len(flying) >= max_in_flight:
                return
            if failed.is_behind(shard):
                waiting.remove(shard)
                continue
            if any(key in here and key not in done for key in shard.after):
                continue
            waiting.remove(shard)
            name = f"{shard.stage}-{shard.key[:16]}-{uuid.uuid4().hex[:8]}"
            future = client.submit(run, run_shard, shard, store_root, key=name, pure=False)
            flying[future] = shard
            future.add_done_callback(arrived.put)

    try:
        submit_ready()
        while flying:
            if stop is not None and stop.is_set():
                raise Stopped("given up")
            try:
                future = arrived.get(timeout=_LOOK_UP_S)
            except queue.Empty:
                continue
            shard = flying.pop(future)
            try:
                ref, seconds = _result(future, shard, stop)
            except ShardError as error:
                failed.add(shard, error)
            else:
                done[shard.key] = ref
                if on_done is not None:
                    on_done(ShardDone(shard, ref, seconds))
            future.release()
            submit_ready()
    finally:
        if flying:
            client.cancel(list(flying), force=True)
    failed.raise_any()
    return [done[shard.key] for shard in shards]


class _Failures:
    """What failed, and so cannot be read by what comes after it.

    Args:
        shards: All shards, in the order in which those that fail are named.
    """

    def __init__(self, shards: Sequence[Shard]) -> None:
        self._order = [shard.key for shard in shards]
        self._errors: dict[str, ShardError] = {}
        self._behind: set[str] = set()

    def add(self, shard: Shard, error: ShardError) -> None:
        """Note a failure; one after which no other shard can do better is raised."""
        self._errors[shard.key] = error
        if error.is_fatal:
            self.raise_any()

    def is_behind(self, shard: Shard) -> bool:
        """Tell whether a shard comes after one that failed; what comes after it then is behind as well."""
        if not any(key in self._errors or key in self._behind for key in shard.after):
            return False
        self._behind.add(shard.key)
        return True

    def raise_any(self) -> None:
        """Raise what failed, if anything did."""
        if self._errors:
            raise joined([self._errors[key] for key in self._order if key in self._errors])


def _result(future: Any, shard: Shard, stop: threading.Event | None) -> tuple[ArtifactRef, float]:
    """Return a finished future's result, or a ShardError; only `.result()` tells of a dead worker.

    A result can be lost on its way, with the worker that holds it: the scheduler then computes the shard again, and
    where no worker is left it waits for one, for ever.  So whether the run was given up is asked in between.
    """
    from distributed import CancelledError, KilledWorker

    try:
        while True:
            try:
                return future.result(timeout=_FETCH_S)
            except TimeoutError:
                if stop is not None and stop.is_set():
                    raise Stopped("given up") from None
    except KilledWorker:
        reason = (
            f"its worker process died {DEATHS_ALLOWED + 1} times; it was killed from outside or needed more memory "
            "than a worker may have"
        )
        raise ShardError(_where(shard), "KilledWorker", reason) from None
    except CancelledError:
        raise Stopped("given up") from None


def _dependency_order(shards: Sequence[Shard]) -> list[Shard]:
    """Order shards so that each follows those of the list that it reads.

    A key contains the keys it comes after, so there are no cycles.
    """
    here = {shard.key: shard for shard in shards}
    needs = {key: [other for other in shard.after if other in here] for key, shard in here.items()}
    return [here[key] for key in TopologicalSorter(needs).static_order()]


def _where(shard: Shard) -> str:
    return f"stage {shard.stage}, {shard.partition}, shard {shard.name}"
