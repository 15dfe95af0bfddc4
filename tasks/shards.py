"""Where shards meet workers: one shard in a worker, many shards over a Dask cluster, or one after the other here."""

from __future__ import annotations

import ctypes
import logging
import os
import queue
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage_schema import ArtifactRef, Store
from tasks.stage import Shard

if TYPE_CHECKING:
    from distributed import Client

__all__ = [
    "ClusterError",
    "ClusterSettings",
    "ShardDone",
    "ShardError",
    "Stopped",
    "connect",
    "peak_memory_bytes",
    "run",
    "run_on_cluster",
    "run_serially",
    "worker_environment",
]

RunShard = Callable[[Shard, Store], ArtifactRef]

_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "POLARS_MAX_THREADS",
)
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_DEATHS_ALLOWED = 2  # workers that may die under one shard before it is given up: the third death is its fault
_CONNECT_TIMEOUT_S = 30.0
_LOOK_UP_S = 0.2  # how often a thread that waits for shards looks whether the run was given up


class ShardError(Exception):
    """A shard failed; the message names stage, partition and shard, then says what went wrong.

    Args:
        where: Stage, partition and shard in words.
        kind: Name of the original error's type.
        reason: The original error's message.
        trace: The original traceback as text, for `--debug`.
    """

    def __init__(self, where: str, kind: str, reason: str, trace: str = "") -> None:
        super().__init__(where, kind, reason, trace)
        self.where = where
        self.kind = kind
        self.reason = reason
        self.trace = trace

    def __str__(self) -> str:
        """Give the one sentence a person needs."""
        return f"{self.where}: {self.reason or self.kind}"


class ClusterError(Exception):
    """The cluster cannot be reached or cannot work on this store; the message says why."""


class Stopped(Exception):  # noqa: N818 - not an error of its own: another one has been raised already
    """Work was given up because something else failed or the person interrupted."""


@dataclass(frozen=True)
class ShardDone:
    """What a finished shard leaves: its artifact and how long it took in the worker."""

    shard: Shard
    ref: ArtifactRef
    seconds: float


@dataclass(frozen=True)
class ClusterSettings:
    """Where shards run: `scheduler` when given, else `num_workers` local processes of one thread each."""

    num_workers: int = 2
    memory_bytes: int = 2 * 1024**3
    scheduler: str | None = None


def run(run_shard: RunShard, shard: Shard, store_root: str) -> tuple[ArtifactRef, float]:
    """Compute one shard in this process: the only function that workers are sent.

    Gives the artifact and the seconds it took. Whatever goes wrong is raised as a ShardError, which survives the way
    back from the worker even where the original error would not.
    """
    started = time.perf_counter()
    try:
        ref = run_shard(shard, Store(store_root))
    except Exception as error:  # noqa: BLE001 - every error of a shard is passed on as one that can be pickled
        failure = ShardError(_where(shard), type(error).__name__, _message(error), traceback.format_exc())
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
    """Run shards one after the other in this process, each after those it depends on; artifacts in the order given."""
    done: dict[str, ArtifactRef] = {}
    for shard in _dependency_order(shards):
        if stop is not None and stop.is_set():
            raise Stopped("given up")
        ref, seconds = run(run_shard, shard, store_root)
        done[shard.key] = ref
        if on_done is not None:
            on_done(ShardDone(shard, ref, seconds))
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
        ShardError: A shard failed; no further shard is submitted and those still waiting are cancelled.
        Stopped: `stop` was set from elsewhere.
    """
    here = {shard.key for shard in shards}
    waiting = list(_dependency_order(shards))
    done: dict[str, ArtifactRef] = {}
    flying: dict[Any, Shard] = {}
    arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def submit_ready() -> None:
        for shard in list(waiting):
            if len(flying) >= max_in_flight:
                return
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
            ref, seconds = _result(future, shard)
            future.release()
            done[shard.key] = ref
            if on_done is not None:
                on_done(ShardDone(shard, ref, seconds))
            submit_ready()
    finally:
        if flying:
            client.cancel(list(flying), force=True)
    return [done[shard.key] for shard in shards]


@contextmanager
def connect(settings: ClusterSettings, *, store_root: str) -> Iterator[Client]:
    """Give a client of the named scheduler, or of a local cluster that ends with this block or with this process.

    Raises:
        ClusterError: The scheduler does not answer, or a worker has not got this code or this store.
    """
    import dask
    from distributed import Client, LocalCluster

    _hush_dask()
    environment = worker_environment()
    options: dict[str, Any] = {
        "distributed.scheduler.allowed-failures": _DEATHS_ALLOWED,
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.admin.system-monitor.gil.enabled": False,
        "distributed.worker.memory.pause": False,
    }
    with dask.config.set(options):
        if settings.scheduler is not None:
            try:
                client = Client(settings.scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
            except (OSError, TimeoutError, ValueError) as error:
                raise ClusterError(f"no Dask scheduler answers at {settings.scheduler}: {_message(error)}") from None
            with client:
                _check_workers(client, settings.scheduler, store_root)
                yield client
            return
        cluster = LocalCluster(
            n_workers=settings.num_workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=settings.memory_bytes,
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.CRITICAL,
            host="127.0.0.1",
        )
        try:
            with Client(cluster, set_as_default=False) as client:
                client.register_plugin(_tether(), name="pasdedeux-tether")
                try:
                    yield client
                except BaseException:
                    _kill_workers(cluster)
                    raise
        finally:
            cluster.close()


def peak_memory_bytes(client: Client | None) -> int:
    """Give the most memory that this process or any worker alive has held, bytes."""
    peaks = [] if client is None else list(client.run(_peak_memory_bytes).values())
    return max([_peak_memory_bytes(), *peaks])


def worker_environment() -> dict[str, str]:
    """Give the environment of a worker: one thread for every library, and a place for compiled kernels.

    Compiled kernels lie beside their source where that can be written (numba's own rule), else in the user's cache
    folder, else in a temporary one; NUMBA_CACHE_DIR wins where it is set.
    """
    environment = dict.fromkeys(_ONE_THREAD, "1")
    if "NUMBA_CACHE_DIR" in os.environ:
        environment["NUMBA_CACHE_DIR"] = os.environ["NUMBA_CACHE_DIR"]
    elif not os.access(Path(__file__).parents[1] / "pasdedeux", os.W_OK):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pasdedeux" / "numba"
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError:
            cache = Path(tempfile.gettempdir()) / f"pasdedeux-numba-{os.getuid()}"
            cache.mkdir(exist_ok=True)
        environment["NUMBA_CACHE_DIR"] = str(cache)
    return environment


def _tether() -> Any:
    """Give the Dask worker plugin by which every worker, a restarted one too, dies with the process that started it."""
    from distributed import WorkerPlugin

    class Tether(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            _die_with_parent()

    return Tether()


def _hush_dask() -> None:
    """Let Dask's loggers speak of nothing: what a person needs to know comes as an error of ours."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _die_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies; Dask's own watch does it elsewhere, between two C calls."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _kill_workers(cluster: Any) -> None:
    """End the workers at once: what they compute is lost, what they committed is not."""
    for nanny in cluster.workers.values():
        process = getattr(nanny, "process", None)
        if process is not None and process.pid:
            nanny.auto_restart = False
            os.kill(process.pid, signal.SIGKILL)


def _check_workers(client: Client, address: str, store_root: str) -> None:
    """Refuse a cluster without workers, without this code, or that does not see the store."""
    if not client.scheduler_info(n_workers=-1)["workers"]:
        raise ClusterError(f"the Dask scheduler at {address} has no workers")
    try:
        sights: Mapping[str, bool] = client.run(_sees, store_root)
    except (ImportError, AttributeError) as error:
        raise ClusterError(
            f"the workers at {address} have not got this version of pasdedeux: {_message(error)}"
        ) from None
    blind = sorted(worker for worker, is_seen in sights.items() if not is_seen)
    if blind:
        raise ClusterError(f"worker {blind[0]} does not see the store {store_root}; it must be on a shared file system")


def _peak_memory_bytes() -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # getrusage counts bytes there, kibibytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _sees(store_root: str) -> bool:
    return os.access(store_root, os.W_OK)


def _result(future: Any, shard: Shard) -> tuple[ArtifactRef, float]:
    """Give a finished future's result, or a ShardError; only `.result()` tells of a dead worker."""
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker:
        reason = (
            f"its worker process died {_DEATHS_ALLOWED + 1} times; it was killed from outside or needed more memory "
            "than a worker may have"
        )
        raise ShardError(_where(shard), "KilledWorker", reason) from None
    except CancelledError:
        raise Stopped("given up") from None


def _dependency_order(shards: Sequence[Shard]) -> list[Shard]:
    """Order shards so that each follows those of the list that it reads; otherwise as given.

    A key contains the keys it comes after, so there are no cycles.
    """
    here = {shard.key: shard for shard in shards}
    order: dict[str, Shard] = {}
    stack = [(shard, False) for shard in reversed(shards)]
    while stack:
        shard, is_ready = stack.pop()
        if shard.key in order:
            continue
        if is_ready:
            order[shard.key] = shard
            continue
        stack.append((shard, True))
        stack.extend((here[key], False) for key in shard.after if key in here and key not in order)
    return list(order.values())


def _where(shard: Shard) -> str:
    return f"stage {shard.stage}, {shard.partition}, shard {shard.name}"


def _message(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
