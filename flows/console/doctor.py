"""`doctor`: checks that this machine has everything that a run needs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import typer

from flows.console import options
from flows.console.context import answer, app, echo
from flows.machine import GIB, free_bytes, kernel_cache, memory_bytes, nearest_folder, usable_cores
from flows.prefect_server import ServerError, check_server, telemetry_off
from storage_schema.provenance import package_versions
from tasks.shards import ClusterError, ClusterSettings, connect

_MIN_MEMORY_BYTES = 2 * GIB
_MIN_DISK_BYTES = GIB


class _BadError(Exception):
    """A check failed; the message states the finding."""


@app.command()
def doctor(store: options.Store = Path("store"), as_json: options.Json = False) -> None:
    """Check the installation; exit code 1 if something is missing."""
    checks: dict[str, Callable[[], str]] = {
        "packages": lambda: ", ".join(f"{name} {version}" for name, version in package_versions().items()),
        "cores": lambda: f"{usable_cores()} usable of {os.cpu_count()}; a run starts one worker per usable core",
        "memory": _check_memory,
        "store": partial(_check_store, store),
        "compiled kernels": _check_kernel_cache,
        "prefect server": _check_prefect,
        "dask": _check_dask,
    }
    findings = []
    for name, check in checks.items():
        try:
            findings.append({"name": name, "found": check(), "is_ok": True})
        except (_BadError, ServerError, ClusterError) as error:
            findings.append({"name": name, "found": str(error), "is_ok": False})
    lines = [
        f"{'ok  ' if finding['is_ok'] else 'BAD '} {finding['name']:<16} {finding['found']}" for finding in findings
    ]
    answer(findings, lines, as_json=as_json)
    if not all(finding["is_ok"] for finding in findings):
        raise typer.Exit(1)


def _at_least(is_enough: bool, version: str) -> str:
    if not is_enough:
        raise _BadError(version)
    return version


def _check_memory() -> str:
    total = memory_bytes()
    if total is None:
        return "unknown"
    return _at_least(total >= _MIN_MEMORY_BYTES, f"{total / GIB:.1f} GB; 2 GB per worker are assumed")


def _check_store(store: Path) -> str:
    if not os.access(nearest_folder(store), os.W_OK):
        raise _BadError(f"{store} is not writable")
    free = free_bytes(store)
    return _at_least(free >= _MIN_DISK_BYTES, f"{store} is writable, {free / GIB:.1f} GB free")


def _check_kernel_cache() -> str:
    """Return where compiled kernels are kept."""
    folder, why_not = kernel_cache()
    return _at_least(not why_not, why_not or f"kept in {folder}")


def _check_prefect() -> str:
    telemetry_off()
    from prefect.settings import get_current_settings

    address = get_current_settings().api.url
    if address is None:
        return "none set (PREFECT_API_URL): a run starts and ends its own"
    check_server(address, lambda text: echo(text, err=True))
    return f"{address} answers"


def _check_dask() -> str:
    """Start one worker and ask it for its process id."""
    with tempfile.TemporaryDirectory() as folder, connect(ClusterSettings(num_workers=1), store_root=folder) as client:
        return f"a local worker starts and answers (process {next(iter(client.run(os.getpid).values()))})"
