"""`doctor`: what this machine is and whether everything a run needs is there."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

import typer

from flows.console.context import JsonOption, StoreOption, print_json
from flows.machine import GIB, free_bytes, memory_bytes, nearest_folder, usable_cores
from flows.prefect_server import ServerError, check_server
from tasks.shards import worker_environment

app = typer.Typer(rich_markup_mode=None)

_MIN_MEMORY_BYTES = 2 * GIB
_MIN_DISK_BYTES = GIB
_PACKAGES = [
    "numpy",
    "scipy",
    "numba",
    "pyarrow",
    "opencv-contrib-python-headless",
    "prefect",
    "dask",
    "distributed",
    "pydantic",
]
"""Packages that every run needs."""


@dataclass(frozen=True)
class Finding:
    """One thing looked at: what it is, what was found, and whether a run can do with it."""

    name: str
    found: str
    is_ok: bool = True


@app.command(help="Check that everything a run needs is there; exit code 1 when something is not.")
def doctor(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
    """Look at the machine and say what is found."""
    findings = [
        Finding("python", platform.python_version(), sys.version_info >= (3, 11)),
        *(_package(name) for name in _PACKAGES),
        _cores(),
        _memory(),
        _store(store),
        _kernel_cache(),
        _prefect(),
        _dask(),
    ]
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        for finding in findings:
            typer.echo(f"{'ok  ' if finding.is_ok else 'BAD '} {finding.name:<34} {finding.found}")
    if not all(finding.is_ok for finding in findings):
        raise typer.Exit(1)


def _package(name: str) -> Finding:
    try:
        return Finding(name, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Finding(name, "not installed", is_ok=False)


def _cores() -> Finding:
    return Finding("cores", f"{usable_cores()} usable of {os.cpu_count()}; a run starts one worker per usable core")


def _memory() -> Finding:
    try:
        total = memory_bytes()
    except (ValueError, OSError):
        return Finding("memory", "unknown")
    return Finding("memory", f"{total / GIB:.1f} GB; 2 GB per worker is planned for", total >= _MIN_MEMORY_BYTES)


def _store(store: Path) -> Finding:
    if not os.access(nearest_folder(store), os.W_OK):
        return Finding("store", f"{store} cannot be written to", is_ok=False)
    free = free_bytes(store)
    return Finding("store", f"{store} can be written to, {free / GIB:.1f} GB free", free >= _MIN_DISK_BYTES)


def _kernel_cache() -> Finding:
    """Say where compiled kernels are kept, trying to write there."""
    import pasdedeux

    folder = Path(worker_environment().get("NUMBA_CACHE_DIR") or Path(pasdedeux.__file__).parent)
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return Finding("compiled kernels", f"kept in {folder}")
    except OSError as error:
        return Finding("compiled kernels", f"{folder} cannot be written to: {error.strerror}", is_ok=False)


def _prefect() -> Finding:
    from flows.prefect_server import telemetry_off

    telemetry_off()
    from prefect.settings import get_current_settings

    address = get_current_settings().api.url
    if address is None:
        return Finding("prefect server", "none set (PREFECT_API_URL): a run starts its own and ends it")
    try:
        check_server(address)
    except ServerError as error:
        return Finding("prefect server", str(error), is_ok=False)
    return Finding("prefect server", f"{address} answers")


def _dask() -> Finding:
    """Start one worker and ask it for its process id."""
    from tasks.shards import ClusterSettings, connect

    with tempfile.TemporaryDirectory() as folder, connect(ClusterSettings(num_workers=1), store_root=folder) as client:
        answers = client.run(os.getpid)
    return Finding("dask", f"a local worker starts and answers (process {next(iter(answers.values()))})")
