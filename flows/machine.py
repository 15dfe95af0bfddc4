"""What this machine is: cores, memory, room on a disk, and the versions of what is installed."""

from __future__ import annotations

import os
import shutil
import sys
from importlib import metadata
from pathlib import Path

__all__ = [
    "GIB",
    "PACKAGES",
    "free_bytes",
    "installed_version",
    "memory_bytes",
    "nearest_folder",
    "python_version",
    "usable_cores",
]

GIB = 1024**3
PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "pyarrow",
    "opencv-contrib-python-headless",
    "prefect",
    "dask",
    "distributed",
    "pydantic",
)
"""Packages that every run needs."""


def python_version() -> str:
    """Return the version of Python, as 3.11.9."""
    return sys.version.split()[0]


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> int:
    """Return the memory of the machine; OSError or ValueError where the system does not tell."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def free_bytes(folder: Path) -> int:
    """Return the room left on the disk of a folder that need not be there yet."""
    return shutil.disk_usage(nearest_folder(folder)).free


def nearest_folder(folder: Path) -> Path:
    """Return a folder, or the first above it that is there."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
