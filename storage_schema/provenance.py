"""Provenance of an artifact: version and sources of the program, versions of packages."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import platform
from functools import cache
from pathlib import Path

_OUR_PACKAGES = ("pasdedeux", "storage_schema", "tasks")
_PACKAGES = (
    "numpy",
    "scipy",
    "pyarrow",
    "numba",
    "llvmlite",
    "opencv-contrib-python-headless",
    "opencv-python-headless",
    "pybvh",
    "arviz-stats",
    "torch",
)


@cache
def code_version() -> str:
    """Return the version of the installed program; 'unknown' if it runs from sources that are not installed."""
    return _version("pasdedeux") or "unknown"


@cache
def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that can change a result."""
    versions = {name: version for name in _PACKAGES if (version := _version(name))}
    return {"python": platform.python_version(), **versions}


@cache
def source_digest() -> str:
    """Return the sha256 over the Python and TOML files of science, storage and tasks: their paths and bytes.

    The flows are excluded, because they do not affect results.
    """
    digest = hashlib.sha256()
    for package in _OUR_PACKAGES:
        for folder in package_folders(package):
            for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.toml")]):
                digest.update(f"{package}/{path.relative_to(folder).as_posix()}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def package_folders(package: str) -> list[Path]:
    """Return the folders of a package without importing it."""
    spec = importlib.util.find_spec(package)
    return [Path(folder) for folder in (spec.submodule_search_locations or [])] if spec else []
