"""What this machine is: cores, memory, and room on a disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

__all__ = [
    "GIB",
    "free_bytes",
    "memory_bytes",
    "nearest_folder",
    "num_workers",
    "usable_cores",
]

GIB = 1024**3


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> int:
    """Return the memory of the machine; OSError or ValueError where the system does not tell."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def num_workers(asked: int | None, worker_bytes: int) -> int:
    """Return the number of workers asked for, else one per usable core as far as the memory reaches."""
    if asked is not None:
        return asked
    return max(1, min(usable_cores(), memory_bytes() // worker_bytes))


def free_bytes(folder: Path) -> int:
    """Return the room left on the disk of a folder that need not be there yet."""
    return shutil.disk_usage(nearest_folder(folder)).free


def nearest_folder(folder: Path) -> Path:
    """Return a folder, or the first above it that is there."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
