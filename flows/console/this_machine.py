"""`doctor` and `bench`: what this machine is, whether a run has all it needs there, and how fast it is."""

from __future__ import annotations

import importlib
import os
import pkgutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

import pasdedeux.benchmarks
from flows.console.context import JsonOption, StoreOption, answer, app, echo
from flows.console.display import format_table
from flows.machine import GIB, free_bytes, kernel_cache, memory_bytes, nearest_folder, usable_cores
from flows.planning import PlanError
from flows.prefect_server import ServerError, check_server, telemetry_off
from pasdedeux.benchmarks.benchmark import BenchmarkResult
from storage_schema.provenance import package_versions
from tasks.shards import ClusterError, ClusterSettings, connect, worker_environment

_MIN_MEMORY_BYTES = 2 * GIB
_MIN_DISK_BYTES = GIB
_COMMANDS, _FULL_SCALE = "commands", "full-scale"
"""Benchmarks of whole commands, and of growth to full sizes: they run for minutes, so only where they are named."""


class _BadError(Exception):
    """A check failed; the message is what was found."""


@app.command()
def doctor(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
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
    lines = [f"{'ok  ' if one['is_ok'] else 'BAD '} {one['name']:<16} {one['found']}" for one in findings]
    answer(findings, lines, as_json=as_json)
    if not all(one["is_ok"] for one in findings):
        raise typer.Exit(1)


def _at_least(is_enough: bool, found: str) -> str:
    if not is_enough:
        raise _BadError(found)
    return found


def _check_memory() -> str:
    total = memory_bytes()
    if total is None:
        return "unknown"
    return _at_least(total >= _MIN_MEMORY_BYTES, f"{total / GIB:.1f} GB; 2 GB per worker is planned for")


def _check_store(store: Path) -> str:
    if not os.access(nearest_folder(store), os.W_OK):
        raise _BadError(f"{store} cannot be written to")
    free = free_bytes(store)
    return _at_least(free >= _MIN_DISK_BYTES, f"{store} can be written to, {free / GIB:.1f} GB free")


def _check_kernel_cache() -> str:
    """Say where compiled kernels are kept."""
    folder, why_not = kernel_cache()
    return _at_least(not why_not, why_not or f"kept in {folder}")


def _check_prefect() -> str:
    telemetry_off()
    from prefect.settings import get_current_settings

    address = get_current_settings().api.url
    if address is None:
        return "none set (PREFECT_API_URL): a run starts its own and ends it"
    check_server(address, lambda text: echo(text, err=True))
    return f"{address} answers"


def _check_dask() -> str:
    """Start one worker and ask it for its process id."""
    with tempfile.TemporaryDirectory() as folder, connect(ClusterSettings(num_workers=1), store_root=folder) as client:
        return f"a local worker starts and answers (process {next(iter(client.run(os.getpid).values()))})"


@app.command()
def bench(
    stage: Annotated[
        str | None,
        Argument(metavar="[STAGE]", help="One stage, scale, full-scale or commands; default: all stages, scale."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure kernels, or whole commands, here, each relative to a plain form.

    \b
      pasdedeux bench              kernels of all stages
      pasdedeux bench chains       of one stage
      pasdedeux bench scale        how cost grows with size
      pasdedeux bench full-scale   the same to 10,000,000 projections, 1,000,000 annotations, 100 takes: only when named
      pasdedeux bench commands     `status`, and the demo, which is built three times: only when named
    """
    os.environ.update(worker_environment())
    found = find_benchmarks()
    if stage is not None and stage not in found:
        raise PlanError(f"there are no benchmarks for '{stage}'; there are for: {', '.join(found)}")
    results: list[tuple[str, BenchmarkResult]] = []
    for name in [one for one in found if one not in (_COMMANDS, _FULL_SCALE)] if stage is None else [stage]:
        for label, function in found[name].items():
            echo(f"measuring {name}: {label}", err=True)
            results.append((name, function()))
    described = [{"stage": name, **asdict(result), "ratio": result.ratio} for name, result in results]
    rows = [(r.name, _rate(r.fast_per_s), _rate(r.plain_per_s), f"{r.unit}/s", f"x {r.ratio:.1f}") for _, r in results]
    lines = format_table(("benchmark", "fast", "plain", "", "ratio"), rows)
    for number, (_, result) in enumerate(results, start=1):
        lines[number] += f"\n    {result.fast_name} against {result.plain_name}"
        lines[number] += f"; {result.note}" if result.note else ""
    answer(described, lines, as_json=as_json)


def find_benchmarks() -> dict[str, dict[str, Callable[[], BenchmarkResult]]]:
    """Return the benchmarks of every stage with a module of its name in `pasdedeux.benchmarks`, and of commands.

    Those of growth are there twice, to small and to full sizes.
    """
    names = [module.name for module in pkgutil.iter_modules(pasdedeux.benchmarks.__path__)]
    modules = {name: importlib.import_module(f"pasdedeux.benchmarks.{name}") for name in names}
    found = {name: module.BENCHMARKS for name, module in modules.items() if hasattr(module, "BENCHMARKS")}
    commands = importlib.import_module("flows.console.command_benchmarks")
    return {**found, _FULL_SCALE: commands.FULL_BENCHMARKS, _COMMANDS: commands.BENCHMARKS}


def _rate(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 else f"{value:.3g}"
