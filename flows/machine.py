"""Cores, memory and disk space of this machine, and where shards run."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pasdedeux
from pasdedeux.errors import InputError
from tasks.shards import ClusterSettings, worker_environment
from tasks.shards.cluster import pinned_instructions
from tasks.shards.profiles import read_profile

GIB = 1024**3
WORKER_MEMORY_GB = 2.0
"""Default memory of a local worker."""
_KERNEL_BYTES = 64 * 1024**2
"""Disk space for all compiled kernels."""
_GROUPS, _GROUP_LIMITS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""Where Linux lists the control groups of this process, and their limits."""


def usable_cores() -> int:
    """Return the number of cores that this process may use: by its affinity, and by the limits of its container."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [*_group_limits("cpu", "cpu.max"), *_group_limits("cpu", "cpu.cfs_quota_us", "cpu.cfs_period_us")]
    return min([cores, *(max(1, math.ceil(quota / period)) for quota, period in quotas)])


def memory_bytes() -> int | None:
    """Return the memory of the machine or its container; None if it is unknown."""
    limits = [*_group_limits("memory", "memory.max"), *_group_limits("memory", "memory.limit_in_bytes")]
    with suppress(OSError, ValueError):
        limits.append([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")])
    return min((limit for (limit,) in limits if limit > 0), default=None)


def _group_limits(controller: str, *names: str) -> Iterator[list[int]]:
    """Yield the limits in files of these names of this process's Linux control groups, the innermost first.

    In version 1 each controller has its own groups, and -1 means no limit.
    """
    try:
        lines = os.fsdecode(_GROUPS.read_bytes()).splitlines()
    except OSError:
        return
    for _, controllers, group in (line.split(":", 2) for line in lines if line.count(":") > 1):
        if controller in controllers.split(",") or not controllers:
            top = _GROUP_LIMITS / controllers
            folder = top / group.lstrip("/")
            for place in (folder, *folder.parents[: len(folder.parts) - len(top.parts)]):
                with suppress(OSError, ValueError):  # not there, or "max"
                    limits = [int(word) for name in names for word in (place / name).read_text().split()]
                    if min(limits) > 0:
                        yield limits


def num_workers(asked: int | None, worker_bytes: int, *, oversubscribe: bool = False) -> int:
    """Return the requested number of workers, else one per usable core, limited by memory.

    Raises:
        InputError: More workers than usable cores are requested, without `oversubscribe`.
    """
    cores = usable_cores()
    if asked is None:
        memory = memory_bytes()
        return cores if memory is None else max(1, min(cores, memory // worker_bytes))
    if asked > cores and not oversubscribe:
        raise InputError(
            f"--workers {asked} is more than the cores that may be used here ({cores}): more workers need more memory "
            f"and are not faster; give at most {cores}, or add --oversubscribe"
        )
    return asked


def why_few(settings: ClusterSettings) -> str:
    """Return the reason for fewer local workers than cores, if memory is short; else empty."""
    memory = memory_bytes()
    if memory is None or not max(1, memory // settings.memory_bytes) == settings.num_workers < usable_cores():
        return ""
    needed = f"{settings.memory_bytes / GIB:g} GB for each worker (--worker-memory)"
    return f"; there is memory for no more: {memory / GIB:.1f} GB, and {needed}"


def cluster_settings(
    workers: int | None,
    worker_memory_gb: float = WORKER_MEMORY_GB,
    scheduler: str | None = None,
    *,
    cluster: str | Path | None = None,
    oversubscribe: bool = False,
) -> ClusterSettings:
    """Return where shards run; a scheduler, or the cluster of a profile, has its own workers.

    Raises:
        InputError: As in `num_workers`; or both a scheduler and a profile are given, or the profile cannot be read.
    """
    if scheduler is not None and cluster is not None:
        raise InputError("--scheduler is a cluster that runs, --cluster starts one; give one of them")
    worker_bytes = int(worker_memory_gb * GIB)
    is_elsewhere = scheduler is not None or cluster is not None
    count = 0 if is_elsewhere else num_workers(workers, worker_bytes, oversubscribe=oversubscribe)
    profile = None if cluster is None else read_profile(Path(cluster))
    return ClusterSettings(count, worker_bytes, scheduler, profile)


def processor() -> dict[str, Any]:
    """Return the name and the features of this processor, as LLVM sees them."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    return {"name": binding.get_host_cpu_name(), "features": sorted(name for name in features if features[name])}


def thread_settings() -> dict[str, str]:
    """Return the environment settings that can change the last bits of a result: threads and instruction set."""
    settings = pinned_instructions() | worker_environment()
    settings.pop("NUMBA_CACHE_DIR", None)
    return settings


def kernel_cache() -> tuple[Path, str]:
    """Return the folder of compiled kernels, and why nothing can be written there; empty if it can."""
    folder = Path(worker_environment().get("NUMBA_CACHE_DIR") or Path(pasdedeux.__file__).parent)
    try:
        with tempfile.NamedTemporaryFile(dir=nearest_folder(folder)):
            pass
    except OSError as error:
        return folder, f"{folder} cannot be written to: {error.strerror}"
    is_full = free_bytes(folder) < _KERNEL_BYTES
    return folder, f"the disk of {folder} has {free_bytes(folder) / 1e6:.0f} MB left" if is_full else ""


def free_bytes(folder: Path) -> int:
    """Return the free space on the disk of a folder, which need not exist yet."""
    return shutil.disk_usage(nearest_folder(folder)).free


def nearest_folder(folder: Path) -> Path:
    """Return a folder, or its nearest parent that exists."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
