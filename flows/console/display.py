"""What a person sees: progress while a run works, and plans and results as short tables."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import typer

from flows.execution import Outcome
from flows.listener import Listener
from flows.planning import Plan, StagePlan, State
from flows.records import last_manifests, read_last_run
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.verdict import Verdict
from storage_schema import Store
from tasks.shards import ShardDone
from tasks.summary import summary_of

__all__ = [
    "BarListener",
    "LineListener",
    "counted",
    "format_table",
    "make_listener",
    "outcome_lines",
    "plan_lines",
    "print_table",
    "summary_lines",
]

_BETWEEN_LINES_S = 5.0


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 shard", "2 shards"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def make_listener(*, is_quiet: bool = False) -> Listener:
    """Return bars at a terminal, lines elsewhere, nothing when asked to be quiet; all on standard error."""
    if is_quiet:
        return Listener()
    return BarListener() if sys.stderr.isatty() else LineListener()


class LineListener(Listener):
    """Says one fact a line, at most one line in five seconds while a stage works."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._lock = threading.Lock()
        self._num_done = 0
        self._num_todo = 0
        self._last_line = 0.0

    def note(self, text: str) -> None:
        """Say a sentence."""
        self._say(text)

    def stage_started(self, plan: StagePlan) -> None:
        """Say what the stage has to do."""
        self._num_done, self._num_todo = 0, len(plan.todo)
        self._last_line = time.monotonic()
        if plan.todo:
            self._say(f"{plan.stage.name}: {len(plan.todo)} of {counted(len(plan.shards), 'shard')} to compute")

    def shard_done(self, done: ShardDone) -> None:
        """Say now and then how far the stage is."""
        with self._lock:
            self._num_done += 1
            now = time.monotonic()
            if now - self._last_line < _BETWEEN_LINES_S:
                return
            self._last_line = now
            text = f"{done.shard.stage}: {self._num_done} of {self._num_todo}"
        self._say(text)

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """Say that the stage is done, and whether it is good."""
        done = f"done in {seconds:.1f} s" if plan.todo else f"{counted(len(plan.shards), 'shard')}, all fresh"
        words = [plan.empty_reason or done, *([verdict_words(verdict)] if verdict else [])]
        self._say(f"{plan.stage.name}: {'; '.join(words)}")

    def _say(self, text: str) -> None:
        typer.echo(f"[{time.monotonic() - self._started:6.1f} s] {text}", err=True)


class BarListener(Listener):
    """Shows a bar per stage that has work."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress: Any = Progress(
            TextColumn("{task.description:<16}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[last]}"),
            console=Console(stderr=True),
        )
        self._progress.start()
        self._bar: Any = None

    def note(self, text: str) -> None:
        """Show a sentence above the bars."""
        self._progress.console.print(text, markup=False, highlight=False)

    def stage_started(self, plan: StagePlan) -> None:
        """Show a bar with as much as is there already."""
        num_fresh = len(plan.shards) - len(plan.todo)
        self._bar = self._progress.add_task(plan.stage.name, total=len(plan.shards), completed=num_fresh, last="")

    def shard_done(self, done: ShardDone) -> None:
        """Move the bar."""
        self._progress.update(self._bar, advance=1, last=f"{done.shard.partition} {done.shard.name}"[:40])

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """Let the finished bar stand, with whether the stage is good."""
        words = verdict_words(verdict) if verdict else plan.empty_reason or ("" if plan.todo else "fresh")
        self._progress.update(self._bar, last=words)
        self._progress.stop_task(self._bar)

    def close(self) -> None:
        """Give the terminal back."""
        self._progress.stop()


def plan_lines(plan: Plan, *, is_long: bool = False) -> list[str]:
    """Return a plan as lines: a stage a line, then its partitions that need work (`is_long`: all), with the reason."""
    lines: list[str] = []
    for stage in plan.stages:
        lines.append(f"{stage.stage.name:<16}{_stage_words(stage)}")
        if stage.is_pending:
            if is_long:
                lines.extend(
                    f"    {name:<28} {counted(count, 'shard')} last time" for name, count in stage.last_partitions
                )
            continue
        groups: dict[tuple[str, str], list[str]] = {}
        for name, items in stage.partitions().items():
            todo = [item for item in items if item.state is not State.FRESH]
            if not todo and not is_long:
                continue
            states = ", ".join(
                f"{sum(i.state is state for i in items)} {state.value}"
                for state in State
                if any(i.state is state for i in items)
            )
            reasons = "; ".join(dict.fromkeys(item.reason for item in todo))
            groups.setdefault((states, reasons), []).append(name)
        for (states, reasons), names in groups.items():
            lines.append(f"    {_names(names):<28} {states}" + (f": {reasons}" if reasons else ""))
    lines.extend(f"warning: {warning}" for warning in plan.warnings)
    return lines


def outcome_lines(outcome: Outcome) -> list[str]:
    """Return what a run did as a short table."""
    rows = [
        (
            stage.name,
            str(stage.num_shards),
            str(stage.num_shards - stage.num_computed),
            str(stage.num_computed),
            f"{stage.seconds:.1f}",
            stage.empty_reason,
        )
        for stage in outcome.stages
    ]
    return format_table(("stage", "shards", "fresh", "computed", "seconds", ""), rows, text_columns=(0, 5))


def summary_lines(store: Store, study: str) -> list[str]:
    """Return what the last run of a study built, from what, and whether it is good, as the report and the card do."""
    last = read_last_run(store, study)
    found = {} if last is None else last_manifests(store, last)
    return summary_of([one for manifests in found.values() for one in manifests]).lines() if found else []


def format_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, text_columns: Collection[int] = (0,)
) -> list[str]:
    """Return rows as aligned lines under a header; columns of text to the left, the others (numbers) to the right."""
    rows = [tuple(row) for row in rows]
    widths = [max(len(row[i]) for row in [tuple(header), *rows]) for i in range(len(header))]

    def line(row: Sequence[str]) -> str:
        aligned = [
            f"{cell:{'<' if column in text_columns else '>'}{widths[column]}}" for column, cell in enumerate(row)
        ]
        return "  ".join(aligned).rstrip()

    return [line(header), *(line(row) for row in rows)]


def print_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, text_columns: Collection[int] = (0,)) -> None:
    """Print rows as `format_table` aligns them, on standard output."""
    for line in format_table(header, rows, text_columns=text_columns):
        typer.echo(line)


def _stage_words(stage: StagePlan) -> str:
    suffix = "" if stage.is_selected else " (not selected)"
    if stage.is_pending:
        return f"pending: {stage.pending_reason}{suffix}"
    if stage.empty_reason:
        return f"{stage.empty_reason}{suffix}"
    if stage.is_fresh:
        verdict = f"; {verdict_words(stage.verdict)}" if stage.verdict else ""
        return f"fresh, {counted(len(stage.shards), 'shard')}{suffix}{verdict}"
    counts = [f"{stage.count(state)} {state.value}" for state in State if stage.count(state)]
    return f"{', '.join(counts)} of {counted(len(stage.shards), 'shard')}{suffix}"


def _names(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} ... {names[-1]} ({len(names)})"
