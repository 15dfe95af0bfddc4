"""`bench`: what the fast forms are worth on this machine, each beside its plain baseline in the same run."""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Annotated

import typer

import pasdedeux.benchmarks
from flows.console.context import JsonOption, print_json
from flows.console.display import format_table
from flows.planning import PlanError
from pasdedeux.benchmarks.benchmark import BenchmarkResult
from tasks.shards import worker_environment

app = typer.Typer(rich_markup_mode=None)


@app.command(help="Measure the speed of what is compiled on this machine, each beside its plain form in the same run.")
def bench(
    stage: Annotated[str | None, typer.Argument(metavar="[STAGE]", help="One stage; all when none.")] = None,
    large: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Also measure databases of N projections; 2 GB for 10^7.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure and show a table."""
    os.environ.update(worker_environment())
    found = find_benchmarks(large=large)
    if stage is not None and stage not in found:
        raise PlanError(f"there are no benchmarks for '{stage}'; there are for: {', '.join(found)}")
    results: list[tuple[str, BenchmarkResult]] = []
    for name, functions in found.items():
        if stage in (None, name):
            for label, function in functions.items():
                typer.echo(f"measuring {name}: {label}", err=True)
                results.append((name, function()))
    if as_json:
        print_json([{"stage": name, **asdict(result), "ratio": result.ratio} for name, result in results])
        return
    rows = [(r.name, _rate(r.fast_per_s), _rate(r.plain_per_s), f"{r.unit}/s", f"x {r.ratio:.1f}") for _, r in results]
    header, *lines = format_table(("benchmark", "fast", "plain", "", "ratio"), rows)
    typer.echo(header)
    for line, (_, result) in zip(lines, results, strict=True):
        typer.echo(line)
        typer.echo(f"    {result.fast_name} against {result.plain_name}" + (f"; {result.note}" if result.note else ""))


def find_benchmarks(*, large: int | None = None) -> dict[str, dict[str, Callable[[], BenchmarkResult]]]:
    """Return the benchmarks of every stage that has a module of its name in `pasdedeux.benchmarks`.

    Those of its `LARGE_BENCHMARKS`, which take a size, are among them when a size is given.
    """
    found: dict[str, dict[str, Callable[[], BenchmarkResult]]] = {}
    for module in pkgutil.iter_modules(pasdedeux.benchmarks.__path__):
        benchmarks = importlib.import_module(f"pasdedeux.benchmarks.{module.name}")
        if hasattr(benchmarks, "BENCHMARKS"):
            found[module.name] = dict(benchmarks.BENCHMARKS)
            if large is not None:
                for label, function in getattr(benchmarks, "LARGE_BENCHMARKS", {}).items():
                    found[module.name][label] = partial(function, large)
    return found


def _rate(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 else f"{value:.3g}"
