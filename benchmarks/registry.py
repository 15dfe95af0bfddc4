"""All benchmarks by stage, and the measurements and output of `pasdedeux bench`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from benchmarks import augmentation, chains, commands, generation, lifting, loader, projections, scale
from benchmarks.benchmark import BenchmarkResult
from flows.console.display import format_table
from flows.planning import PlanError

BENCHMARKS: dict[str, Mapping[str, Callable[[], BenchmarkResult]]] = {
    "augmentation": augmentation.BENCHMARKS,
    "chains": chains.BENCHMARKS,
    "generation": generation.BENCHMARKS,
    "lifting": lifting.BENCHMARKS,
    "loader": loader.BENCHMARKS,
    "projections": projections.BENCHMARKS,
    "scale": scale.BENCHMARKS,
    "full-scale": commands.FULL_BENCHMARKS,
    "commands": commands.BENCHMARKS,
}
_SLOW = ("full-scale", "commands")
"""These take minutes, so they run only if named."""


def run_benchmarks(stage: str | None, say: Callable[[str], None]) -> list[tuple[str, BenchmarkResult]]:
    """Return the results of one stage, or of all but the slow ones, each with its stage.

    Raises:
        PlanError: There are no benchmarks for this stage.
    """
    if stage is not None and stage not in BENCHMARKS:
        raise PlanError(f"there are no benchmarks for '{stage}'; there are for: {', '.join(BENCHMARKS)}")
    results = []
    for name in [name for name in BENCHMARKS if name not in _SLOW] if stage is None else [stage]:
        for label, benchmark in BENCHMARKS[name].items():
            say(f"measuring {name}: {label}")
            results.append((name, benchmark()))
    return results


def table(results: list[BenchmarkResult]) -> list[str]:
    """Return a header and a line for each result, with the two compared forms below it."""
    rows = [(r.name, _rate(r.fast_per_s), _rate(r.plain_per_s), f"{r.unit}/s", f"x {r.ratio:.1f}") for r in results]
    lines = format_table(("benchmark", "fast", "plain", "", "ratio"), rows)
    for number, result in enumerate(results, start=1):
        lines[number] += f"\n    {result.fast_name} against {result.plain_name}"
        lines[number] += f"; {result.note}" if result.note else ""
    return lines


def _rate(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 else f"{value:.3g}"
