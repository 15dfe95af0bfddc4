"""The workers: a local Dask cluster that cannot outlive the run, or an existing scheduler, checked before use."""

from __future__ import annotations

import ctypes
import logging
import os
import resource
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pasdedeux.threads import THREAD_VARIABLES
from storage_schema import Store
from storage_schema.durable import cache_folder
from storage_schema.provenance import code_version, package_versions, source_digest
from tasks.shards.errors import ClusterError, in_one_line
from tasks.shards.profiles import ClusterProfile, await_workers, started

if TYPE_CHECKING:
    from distributed import Client

DEATHS_ALLOWED = 2  # workers that may die computing a shard: the third death is blamed on the shard
_INSTRUCTIONS = (
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NPY_ENABLE_CPU_FEATURES",
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "MKL_CBWR",
)
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
CONNECT_TIMEOUT_S = 30.0
is_refused: list[str] = []
"""Reason why this worker must not compute for the run that it joined; empty if it may."""
_REFUSALS = "pasdedeux-refusals"
"""Topic under which the scheduler keeps the reasons why workers left."""
_GREETINGS = 3


@dataclass(frozen=True)
class ClusterSettings:
    """Where shards run: on `scheduler` or a cluster of a profile when given, else `num_workers` local processes."""

    num_workers: int = 2
    memory_bytes: int = 2 * 1024**3
    scheduler: str | None = None
    profile: ClusterProfile | None = None

    @property
    def is_shared(self) -> bool:
        """Tell whether workers may join and leave, and run on other machines."""
        return self.scheduler is not None or self.profile is not None


@contextmanager
def connect(settings: ClusterSettings, *, store_root: str) -> Iterator[Client]:
    """Return a client of the named scheduler, of a profile's cluster, or of a local one that ends with this process.

    Raises:
        ClusterError: The scheduler does not answer, or a worker does not have this code or this store.
    """
    import dask
    from distributed import LocalCluster

    _hush_dask()
    environment = worker_environment()
    options: dict[str, Any] = {
        "distributed.scheduler.allowed-failures": DEATHS_ALLOWED,
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.admin.system-monitor.gil.enabled": False,
        # Profiles sampled a hundred times a second, and ticks fifty times a second: nobody reads them.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "500ms",
        "distributed.worker.memory.pause": False,
        # Shards that follow others wait in the priority queue, too, with those that are ready.
        "distributed.scheduler.rootish-taskgroup-dependencies": float("inf"),
        "distributed.scheduler.work-stealing-interval": "100ms",
        # A shard waits at the scheduler: the death of a worker where it waits would count against it.
        "distributed.scheduler.worker-saturation": 1.0,
    }
    with dask.config.set(options):
        if settings.scheduler is not None:
            with _client_of(settings.scheduler) as client, _without_asyncio_words():
                _only_fit_workers(client, settings.scheduler, store_root)
                yield client
            return
        if settings.profile is not None:
            with started(settings.profile) as cluster, _client_of(cluster) as client, _without_asyncio_words():
                await_workers(client, settings.profile)
                _only_fit_workers(client, settings.profile.cluster, store_root)
                yield client
            return
        with _no_ctrl_c_for_children():
            try:
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
            except RuntimeError as error:
                raise ClusterError(f"the local workers did not start: {in_one_line(error)}") from None
        try:
            with _client_of(cluster) as client:
                client.register_plugin(_tether(), name="pasdedeux-tether")
                try:
                    with _without_asyncio_words():
                        yield client
                except BaseException:
                    _kill_workers(cluster)
                    raise
        finally:
            cluster.close()


@contextmanager
def _without_asyncio_words() -> Iterator[None]:
    """Silence asyncio if this block fails: cancelled work needs no message besides the error."""
    try:
        yield
    except BaseException:
        logging.getLogger("asyncio").setLevel(logging.CRITICAL + 1)
        raise


def _client_of(scheduler: Any) -> Client:
    """Return a client of a scheduler's address or of a local cluster.

    Distributed asserts that the scheduler's greeting comes alone; a message for all clients in the same 2 ms breaks
    that, and asking again mends it.
    """
    from distributed import Client

    if isinstance(scheduler, str) and scheduler.startswith("tls://"):
        _check_tls(scheduler)
    for _ in range(_GREETINGS):
        try:
            return Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except AssertionError:
            continue
        except (OSError, TimeoutError, ValueError) as error:
            raise ClusterError(f"no Dask scheduler answers at {scheduler}: {in_one_line(error)}") from None
    raise ClusterError(f"what answers at {scheduler} is not a Dask scheduler")


def _check_tls(address: str) -> None:
    """Refuse TLS without Dask's settings of the client, or with settings that cannot be read: ClusterError."""
    from distributed.security import Security

    words = "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ..._TLS__CLIENT__CERT and ..._TLS__CLIENT__KEY"
    try:
        has_context = Security().get_connection_args("client").get("ssl_context") is not None
    except (OSError, ValueError) as error:
        raise ClusterError(f"certificates for {address} cannot be read: {in_one_line(error)}; see {words}") from None
    if not has_context:
        raise ClusterError(f"{address} needs certificates of a client; set {words} in the environment of this command")


def peak_memory_bytes(client: Client | None) -> int:
    """Return the most memory that this process or any worker alive has held, bytes."""
    peaks = [] if client is None else list(client.run(_peak_memory_bytes).values())
    return max([_peak_memory_bytes(), *peaks])


def worker_environment() -> dict[str, str]:
    """Return the environment of a worker: one thread for every library, and a place for compiled kernels.

    Compiled kernels lie beside their source where that can be written (numba's own rule), else in the user's cache
    folder (`cache_folder`); NUMBA_CACHE_DIR wins where it is set.
    """
    environment = dict.fromkeys(THREAD_VARIABLES, "1")
    if "NUMBA_CACHE_DIR" in os.environ:
        environment["NUMBA_CACHE_DIR"] = os.environ["NUMBA_CACHE_DIR"]
    elif not os.access(Path(__file__).parents[2] / "pasdedeux", os.W_OK):
        environment["NUMBA_CACHE_DIR"] = str(cache_folder() / "numba")
    return environment


def _tether() -> Any:
    """Return a Dask worker plugin that ends every worker, restarted ones too, with the process that started it."""
    from distributed import WorkerPlugin

    class Tether(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            _die_with_parent()

    return Tether()


@contextmanager
def _no_ctrl_c_for_children() -> Iterator[None]:
    """Start threads and processes without Ctrl-C and SIGHUP: a terminal sends both to all, only this one reacts.

    Both inherit the blocked signals; a signal that comes meanwhile arrives when the block ends.  The resource tracker
    of multiprocessing lifts the block of SIGINT where it is started, so it is started first; it ignores SIGTERM.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _hush_dask() -> None:
    """Silence the loggers of Dask and its event loop: our own errors tell what a person needs to know."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _die_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies; Dask's own watch does it elsewhere, between two C calls."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _kill_workers(cluster: Any) -> None:
    """End the workers at once: current work is lost, committed work is not."""
    for nanny in cluster.workers.values():
        process = getattr(nanny, "process", None)
        if process is not None and process.pid:
            nanny.auto_restart = False
            os.kill(process.pid, signal.SIGKILL)


def _only_fit_workers(client: Client, address: str, store_root: str) -> None:
    """Refuse workers that are unfit for the run, including those that join while it lasts."""
    _check_workers(client, address, store_root)
    rule = f"pasdedeux-only-fit-{client.id}"
    client.register_plugin(_ends_with(client.id, rule), name=f"{rule}-ends")
    client.register_plugin(only_fit(installed(), store_root), name=rule)


def _ends_with(run: str, rule: str) -> Any:
    """Return a Dask scheduler plugin that lifts a rule for workers when the client of its run is gone, even if killed.

    The run's store may be gone tomorrow, and workers of other runs need not have it.  A client whose connection broke
    and returned while nothing of its run was in progress has lost its rule.
    """
    from distributed import SchedulerPlugin

    class EndsWith(SchedulerPlugin):
        def remove_client(self, scheduler: Any, client: str) -> None:
            if client == run:
                scheduler.remove_plugin(f"{rule}-ends")
                if rule in scheduler.worker_plugins:
                    scheduler.loop.add_callback(scheduler.unregister_worker_plugin, None, rule)

    return EndsWith()


def _check_workers(client: Client, address: str, store_root: str) -> None:
    """Refuse a cluster without workers, without this code, or without access to the store."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        last = "".join(f"; the last that left: {why}" for why in refusals(client)[-1:])
        raise ClusterError(f"the Dask scheduler at {address} has no workers{last}")
    try:
        reasons: Mapping[str, str] = client.run(_why_unfit, installed(), store_root)
    except (ImportError, AttributeError) as error:
        raise ClusterError(
            f"the workers at {address} do not have this version of pasdedeux: {in_one_line(error)}"
        ) from None
    if unfit := sorted(worker for worker, why in reasons.items() if why):
        raise ClusterError(reasons[unfit[0]])


def refusals(client: Client) -> list[str]:
    """Return why workers that joined later left, oldest first, including those of earlier runs."""
    return [reason for _, reason in client.get_events(_REFUSALS) or ()]


def installed() -> dict[str, str]:
    """Return what determines results here: versions of packages, digest of the sources, pinned instructions."""
    sources = {"sources of pasdedeux": source_digest()[:12]}
    return {"pasdedeux": code_version(), **package_versions(), **sources, **pinned_instructions()}


def pinned_instructions() -> dict[str, str]:
    """Return the instructions that the environment allows compiled code to use."""
    return {name: os.environ[name] for name in _INSTRUCTIONS if name in os.environ}


def _why_unfit(mine: Mapping[str, str], store_root: str, dask_worker: Any) -> str:
    """Return why this worker must not compute for a run; empty if it may.

    A process must compute one shard at a time, have the packages, sources and instructions of the run, and write to its
    store.
    """
    who, theirs = f"worker {dask_worker.address}", installed()
    if dask_worker.state.nthreads != 1:
        return (
            f"{who} has {dask_worker.state.nthreads} threads, but a process computes one shard at a time; start "
            "workers with --nthreads 1, and as many of them as there are cores"
        )
    if not Store(store_root).can_write():
        needs = "it must reach the bucket" if store_root.startswith("s3://") else "it must be on a shared file system"
        return f"{who} cannot write to the store {store_root}; {needs}"
    for name in sorted({*mine, *theirs}):
        if mine.get(name) != theirs.get(name):
            return (
                f"{who} has {name} {theirs.get(name, 'not set')}, here it is {mine.get(name, 'not set')}: results "
                "would differ; install and set the same everywhere (deploy/constraints.txt, deploy/instructions.env)"
            )
    return ""


def only_fit(mine: Mapping[str, str], store_root: str) -> Any:
    """Return a Dask worker plugin that makes a worker that joins later leave if it is unfit for the run.

    Dask keeps a worker whose plugin fails, so it has to leave; shards sent meanwhile go elsewhere.
    """
    from distributed import WorkerPlugin

    class OnlyFit(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            _leave_if_unfit(mine, store_root, worker)

    return OnlyFit()


def _leave_if_unfit(mine: Mapping[str, str], store_root: str, worker: Any) -> None:
    # A function of the module: attributes of the plugin are sent as copies, and so would the list be.
    if reason := _why_unfit(mine, store_root, worker):
        is_refused.append(reason)
        logging.getLogger("distributed.worker").error("refused by a run of pasdedeux: %s", reason)
        worker.log_event(_REFUSALS, reason)
        # Gracefully: its shards count as returned, not as killed with it.
        worker.loop.add_callback(worker.close_gracefully, reason="not fit for the run")


def _peak_memory_bytes() -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # getrusage counts bytes there, kibibytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
