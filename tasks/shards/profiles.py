"""Profiles of clusters: the class, arguments and size of the Dask cluster that a run starts for itself."""

from __future__ import annotations

import importlib
import signal
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from pasdedeux.errors import InputError
from pasdedeux.settings import Settings, first_problem
from tasks.files.user_files import read_text_file
from tasks.shards.errors import ClusterError, in_one_line

if TYPE_CHECKING:
    from distributed import Client, SpecCluster
    from distributed.deploy.cluster import Cluster

_LOOK_AGAIN_S = 0.5


class ClusterProfile(Settings):
    """A file of TOML that says how a cluster is started; `deploy/clusters/` has some."""

    cluster: str = Field(
        pattern=r"^\w+(\.\w+)+$",
        description="Class of a Dask cluster: dask_jobqueue.SLURMCluster, dask_jobqueue.PBSCluster, "
        "dask_kubernetes.operator.KubeCluster, tasks.shards.jobs_here.JobsHere, ...",
    )
    options: dict[str, Any] = Field({}, description="Arguments of that class; memory of a worker is among them")
    min_workers: int = Field(1, ge=1, description="Workers that are kept as long as the run lasts")
    max_workers: int = Field(1, ge=1, description="Workers that there may be where there is work for them")
    start_s: float = Field(900.0, gt=0, description="Longest time to wait for the first worker, seconds")


def read_profile(path: Path) -> ClusterProfile:
    """Read a profile.

    Raises:
        InputError: There is none, or a key of it is wrong; says which, and which there are.
    """
    try:
        return ClusterProfile.model_validate(tomllib.loads(read_text_file(path)))
    except InputError as error:
        raise InputError(f"cluster profile: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"cluster profile {path} is not valid TOML: {error}") from None
    except ValidationError as error:
        known = ", ".join(ClusterProfile.model_fields)
        raise InputError(f"cluster profile {path}: {first_problem(error)}; keys: {known}") from None


@contextmanager
def started(profile: ClusterProfile) -> Iterator[Any]:
    """Start the cluster for this block; it maintains its number of workers.

    Raises:
        ClusterError: The class is not installed or is none, or the cluster or its first jobs cannot be started.
    """
    from distributed import SpecCluster

    kind = cluster_class(profile.cluster)
    try:
        cluster = kind(**profile.options)
    except Exception as error:  # noqa: BLE001 - whatever a scheduler of jobs says becomes one sentence
        raise ClusterError(f"{profile.cluster} cannot be started: {in_one_line(error)}") from None
    if isinstance(cluster, SpecCluster):
        # Adapting submits jobs in a callback whose errors are lost, without retrying: wait for the first ones here.
        try:
            cluster.sync(_scaled, cluster, profile.min_workers, callback_timeout=profile.start_s)
        except BaseException as error:
            with suppress(Exception):
                cluster._created.clear()  # it asserts that every job has ended, even those that never began
                cluster.close()
            _remove_keys(cluster)
            if not isinstance(error, Exception):
                raise
            raise ClusterError(f"{profile.cluster} cannot start its jobs: {in_one_line(error)}") from None
    try:
        with cluster:
            cluster.adapt(minimum=profile.min_workers, maximum=max(profile.min_workers, profile.max_workers))
            yield cluster
    finally:
        _remove_keys(cluster)


def _remove_keys(cluster: Any) -> None:
    """Remove keys and certificates that dask-jobqueue wrote for its jobs into a shared folder.

    They are open temporary files, which remain if the process ends before they are collected.
    """
    for name, file in vars(cluster).items():
        if name in ("_job_ca_file", "_job_key", "_job_cert"):
            file.close()


async def _scaled(cluster: SpecCluster, num_workers: int) -> None:
    cluster.scale(num_workers)
    await cluster._correct_state()


def await_workers(client: Client, profile: ClusterProfile) -> None:
    """Wait for the first worker; ClusterError where none comes in time."""
    deadline = time.monotonic() + profile.start_s
    while not client.scheduler_info(n_workers=-1)["workers"]:
        if time.monotonic() > deadline:
            raise ClusterError(
                f"{profile.cluster} had no worker after {profile.start_s:g} s: look at its queue of jobs"
            )
        time.sleep(_LOOK_AGAIN_S)


def cluster_class(path: str) -> type[Cluster]:
    """Return a class of Dask clusters by its path; Ctrl-C is restored, as importing dask-jobqueue takes it over.

    Raises:
        ClusterError: The class is not installed, or is none.
    """
    from distributed.deploy.cluster import Cluster

    module, _, name = path.rpartition(".")
    on_interrupt = signal.getsignal(signal.SIGINT)
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ClusterError(
            f"{path} is not there ({in_one_line(error)}): install {module.partition('.')[0]} here"
        ) from None
    finally:
        if signal.getsignal(signal.SIGINT) is not on_interrupt:
            signal.signal(signal.SIGINT, on_interrupt)
    if not (isinstance(kind, type) and issubclass(kind, Cluster)):
        raise ClusterError(f"{path} is no Dask cluster")
    return kind
