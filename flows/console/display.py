"""Output for people: progress of a run, and plans and results as short tables."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

from flows.console.context import echo, wrapped
from flows.costs import Cost, Work
from flows.machine import GIB
from flows.outcomes import Outcome
from flows.planning import Plan, StagePlan, State
from flows.progress import Listener, Progress
from flows.records import last_manifests, read_last_run
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.plain_text import counted, visible
from pasdedeux.verdict import Verdict
from storage_schema import Manifest, Store
from tasks.stage import Shard
from tasks.summary import summary_of

_SILENCE_S = 5.0
"""Without a terminal, a progress line is printed after this silence."""
_LONGEST_SILENCE_S = 60.0
"""Longest pause before an unchanged line is repeated; pauses double up to it."""
_LOOK_UP_S = 0.5
_NAMED = 3
"""Running shards that are named."""


def make_listener(*, is_quiet: bool = False) -> Listener:
    """Return a listener on standard error: bars at a terminal, else lines; when quiet, one that prints nothing."""
    if is_quiet:
        return Listener()
    return BarListener() if sys.stderr.isatty() else LineListener()


class LineListener(Listener):
    """Prints one fact a line, and progress after five seconds of silence; an unchanged line less and less often."""

    def __init__(self) -> None:
        self._started = self._last_line = time.monotonic()
        self._doing, self._said, self._pause_s = "starting", "", _SILENCE_S
        self._closed = threading.Event()
        self._watch = threading.Thread(target=self._break_silence, daemon=True)
        self._watch.start()

    def note(self, text: str) -> None:
        """Print a message."""
        self._doing = f"still {text}"
        self._say(text)

    def stage_started(self, plan: StagePlan) -> None:
        """Print the shards to compute."""
        if plan.todo:
            self._say(f"{plan.stage.name}: {len(plan.todo)} of {counted(len(plan.shards), 'shard')} to compute")

    def progressed(self, progress: Progress) -> None:
        """Keep the progress, for the next line."""
        self._doing = progress_text(progress)

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """Print that the stage is done, with its verdict."""
        done = f"done in {seconds:.1f} s" if plan.todo else f"{counted(len(plan.shards), 'shard')}, all fresh"
        words = [plan.empty_reason or done, *([verdict_words(verdict)] if verdict else [])]
        self._say(f"{plan.stage.name}: {'; '.join(words)}")

    def close(self) -> None:
        """Stop printing."""
        self._closed.set()
        self._watch.join()

    def _break_silence(self) -> None:
        while not self._closed.wait(_LOOK_UP_S):
            pause_s = self._pause_s if self._doing == self._said else _SILENCE_S
            if time.monotonic() - self._last_line > pause_s - _LOOK_UP_S:
                self._said, self._pause_s = self._doing, min(2.0 * pause_s, _LONGEST_SILENCE_S)
                self._say(self._said)

    def _say(self, text: str) -> None:
        self._last_line = time.monotonic()
        echo(f"[{time.monotonic() - self._started:6.1f} s] {text}", err=True)


class BarListener(LineListener):
    """Prints the same lines at a terminal, above a bar and the running shards."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._progress = Progress(0, 0, (), 0.0, is_all=False)
        self._since: dict[str, float] = {}
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, get_renderable=self._drawn, transient=True)
        self._live.start()

    def progressed(self, progress: Progress) -> None:
        """Move the bar."""
        now = time.monotonic()
        self._since = {shard.key: self._since.get(shard.key, now) for shard in progress.running}
        self._progress = progress

    def close(self) -> None:
        """Release the terminal."""
        super().close()
        self._live.stop()

    def _drawn(self) -> Any:
        """Draw the bar with counts and times, then a row for each running shard; names are cut first."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        progress, now = self._progress, time.monotonic()
        bar, rows = Table.grid(padding=(0, 1), expand=True), Table.grid(padding=(0, 1), expand=True)
        for ratio in (1, None, None, None):
            bar.add_column(no_wrap=True, ratio=ratio)
        for ratio in (2, None, 3, None):
            rows.add_column(no_wrap=True, ratio=ratio, justify="left" if ratio else "right")
        done = f"{progress.num_done}/{progress.num_shards}"
        is_known = progress.num_shards > 0
        line = ProgressBar(progress.num_shards if is_known else None, progress.num_done, pulse=not is_known)
        bar.add_row(line, done * is_known, duration_text(now - self._started), left_text(progress))
        for shard in progress.running[:_NAMED]:
            took = duration_text(now - self._since.get(shard.key, now))
            words = (f"  {shard.stage} {shard.partition}", _part_text(progress, shard), shard.name, took)
            rows.add_row(*(Text(visible(word, is_line=True)) for word in words))
        if (more := len(progress.running) - _NAMED) > 0:
            rows.add_row(f"  and {more} more")
        return Group(bar, rows)

    def _break_silence(self) -> None:
        """Do nothing: the bar shows progress."""

    def _say(self, text: str) -> None:
        for line in wrapped(text, self._console.width):
            self._console.print(line, markup=False, soft_wrap=True)


class StepReporter:
    """Reports the steps of a piece of work to a listener, with the time left if all take the same; call it for each.

    Args:
        listener: Receives the progress.
        total: Number of steps.
    """

    def __init__(self, listener: Listener, total: int) -> None:
        self._listener, self._total, self._done, self._started = listener, total, 0, time.monotonic()

    def __call__(self) -> None:
        """Count a step."""
        self._done = min(self._done + 1, self._total)
        left_s = (time.monotonic() - self._started) / self._done * (self._total - self._done)
        self._listener.progressed(Progress(self._done, self._total, (), left_s, is_all=True, noun="step"))


def plan_lines(plan: Plan) -> list[str]:
    """Return a plan as lines: each stage, then its partitions that need work, with the reason."""
    lines: list[str] = []
    for stage in plan.stages:
        lines.append(f"{stage.stage.name:<16}{_stage_words(stage)}")
        if stage.is_pending:
            continue
        groups: dict[tuple[str, str], list[str]] = {}
        for name, items in stage.partitions().items():
            todo = [item for item in items if item.state is not State.FRESH]
            if not todo:
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
    lines.extend(f"note: {visible(note, is_line=True)}" for note in plan.notes)
    lines.extend(f"warning: {warning}" for warning in plan.warnings)
    return lines


def outcome_lines(outcome: Outcome) -> list[str]:
    """Return the outcome of a run as a short table."""
    rows = [
        (
            stage.name,
            stage.num_shards,
            stage.num_shards - stage.num_computed,
            stage.num_computed,
            stage.seconds,
            stage.empty_reason,
        )
        for stage in outcome.stages
    ]
    return format_table(("stage", "shards", "fresh", "computed", "seconds", ""), rows, text_columns=(0, 5))


def headlines(store: Store, study: str, seen: Iterable[Manifest] = ()) -> list[str]:
    """Return what the last run of a study built and how much is good, as at the top of the report and the card."""
    last = read_last_run(store, study)
    by_stage = {} if last is None else last_manifests(store, last, seen)
    return summary_of([*chain(*by_stage.values())]).headlines() if by_stage else []


def manifest_lines(stages: Mapping[str, Sequence[Manifest]]) -> list[str]:
    """Return the verdicts on artifacts by stage as lines."""
    return summary_of([*chain(*stages.values())]).lines() if stages else []


def progress_text(progress: Progress) -> str:
    """Return the progress of a run in one line: `12 of 45 shards, computing chains ic 0; about 40 s left`."""
    words = [f"{progress.num_done} of {counted(progress.num_shards, progress.noun)}", _running_text(progress)]
    return "; ".join(filter(None, [", ".join(filter(None, words)), left_text(progress)]))


def _running_text(progress: Progress) -> str:
    """Return the shards being computed, in words: `computing chains ic 0`."""
    running = [
        " ".join(
            filter(None, (*dict.fromkeys((shard.stage, shard.partition, shard.name)), f"({part})" if part else ""))
        )
        for shard in progress.running
        for part in [_part_text(progress, shard)]
    ]
    more = f" and {len(running) - _NAMED} more" if len(running) > _NAMED else ""
    return f"computing {', '.join(running[:_NAMED])}{more}" if running else ""


def _part_text(progress: Progress, shard: Shard) -> str:
    """Return the progress of a shard's partition, if it has several shards: `3 of 9`."""
    done, total = progress.partitions.get((shard.stage, shard.partition), (0, 1))
    return f"{done} of {total}" if total > 1 else ""


def left_text(progress: Progress) -> str:
    """Return the remaining time in words; empty if it is unknown or less than a second."""
    if progress.left_s < 1.0:
        return ""
    return f"{'about' if progress.is_all else 'more than'} {duration_text(progress.left_s)} left"


def cost_lines(work: Work, costs: Sequence[Cost]) -> list[str]:
    """Return the cost of a build as a short table, and the measurements that it is based on."""
    gigabytes = "" if work.worker_bytes is None else f"{work.worker_bytes / GIB:.1f}"
    rows = [
        (
            cost.num_workers,
            duration_text(cost.wall_s),
            f"{cost.core_hours:.3g}",
            f"{100 * cost.busy_share:.0f} %",
            "" if work.worker_bytes is None else f"{cost.num_workers * work.worker_bytes / GIB:.3g} GB",
        )
        for cost in costs
    ]
    lines = format_table(("workers", "wall time", "core hours", "at work", "memory"), rows, text_columns=())
    lines.append(
        f"{counted(work.num_shards, 'shard')}, {duration_text(work.processor_s)} of one core, "
        f"{size_text(work.num_bytes)}" + (f", at most {gigabytes} GB per process" if gigabytes else "")
    )
    if work.num_measured < work.num_shards:
        lines.append(f"{work.num_measured} of them were measured; the others are assumed to take as long")
    if work.unknown:
        lines.append(f"not counted, because never measured: {', '.join(work.unknown)}")
    return lines


def size_text(num_bytes: float) -> str:
    """Format a size: 12.3 MB."""
    return f"{num_bytes / 1e6:.1f} MB"


def duration_text(seconds: float) -> str:
    """Format a duration: 41 s, 3 min 20 s, 2.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds // 60:.0f} min {seconds % 60:.0f} s" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def format_table(
    header: Sequence[str], rows: Iterable[Sequence[object]], *, text_columns: Collection[int] = (0,)
) -> list[str]:
    """Return rows as aligned lines under a header: text columns to the left, numbers to the right."""
    cells = [
        tuple(f"{cell:.1f}" if isinstance(cell, float) else visible(str(cell), is_line=True) for cell in row)
        for row in (header, *rows)
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]

    def line(row: Sequence[str]) -> str:
        signs = ("<" if column in text_columns else ">" for column in range(len(row)))
        return "  ".join(f"{cell:{sign}{width}}" for cell, sign, width in zip(row, signs, widths, strict=True)).rstrip()

    return [line(row) for row in cells]


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
