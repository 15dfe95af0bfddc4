"""The profile of a run: which process computed which shard when, and the times of stages and of the longest shards."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib import colormaps

from pasdedeux.evaluation.pictures import Picture, figure_svg, label_axis, legend_beside, new_figure
from pasdedeux.evaluation.report import render
from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.plain_text import counted
from storage_schema import Manifest, Store
from tasks.shards import ShardDone, WhereComputed

PROFILE_FILE = "profile.html"
_NUM_LONGEST = 10
_HEADINGS = ("clock", "processor", "part of all", "peak memory", "written")


@dataclass(frozen=True)
class _Bar:
    """A computed shard: its artifact, its process, and its start and duration in seconds of the run."""

    manifest: Manifest
    place: WhereComputed
    start_s: float
    seconds: float


def write_profile(folder: Path, store: Store, done: Sequence[ShardDone]) -> Path:
    """Write the profile of a run's shards to `profile.html` in a folder, and return the file.

    Shards that existed before are not included.
    """
    computed = [(shard, shard.place) for shard in done if shard.place is not None]
    origin_s = min((place.began_s for _, place in computed), default=0.0)
    bars = [
        _Bar(store.manifest(shard.ref), place, place.began_s - origin_s, shard.seconds) for shard, place in computed
    ]
    bars.sort(key=lambda bar: bar.start_s)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / PROFILE_FILE
    path.write_text(render("profile.html", words=_words(bars), picture=_time_line(bars), tables=_tables(bars)), "utf-8")
    return path


def _words(bars: Sequence[_Bar]) -> str:
    """Return in words how much was computed, by how many processes, and how busy they were."""
    num_processes, end_s = (
        len({bar.place.process for bar in bars}),
        max((bar.start_s + bar.seconds for bar in bars), default=0.0),
    )
    busy = sum(bar.seconds for bar in bars) / (num_processes * end_s) if end_s else 0.0
    return (
        f"{counted(len(bars), 'shard')}, without those that were there already. Processes: {num_processes}, "
        f"for {end_s:.1f} s, "
        f"at work {busy:.0%} of that. Memory is the most that a process had held by the end of a shard."
    )


def _time_line(bars: Sequence[_Bar]) -> Picture:
    """Draw when each process computed which shards."""
    colours = colormaps["tab20"]  # a plain axis has ten, fewer than the stages
    processes = list(dict.fromkeys(bar.place.process for bar in bars))
    stages = list(dict.fromkeys(bar.manifest.ref.stage for bar in bars))
    figure, ((axis,),) = new_figure(9.5, 1.3 + 0.35 * len(processes))
    for number, stage in enumerate(stages):
        stage_bars = [bar for bar in bars if bar.manifest.ref.stage == stage]
        rows, starts = [processes.index(bar.place.process) for bar in stage_bars], [bar.start_s for bar in stage_bars]
        lengths = [bar.seconds for bar in stage_bars]
        axis.barh(rows, lengths, left=starts, color=colours(number), edgecolor="white", linewidth=0.3, label=stage)
    axis.set_yticks(range(len(processes)), [f"process {number}" for number in range(1, len(processes) + 1)])
    axis.invert_yaxis()
    label_axis(axis, "seconds since the first shard began")
    if stages:
        legend_beside(axis)
    caption = "Shards on processes over time, coloured by stage; white is waiting."
    return Picture("time-line.svg", caption, figure_svg(figure))


def _tables(bars: Sequence[_Bar]) -> list[TextTable]:
    """Return tables of the times of stages and of the longest shards."""
    stages: dict[str, list[_Bar]] = defaultdict(list)
    for bar in bars:
        stages[bar.manifest.ref.stage].append(bar)
    total_s = sum(bar.seconds for bar in bars)
    order = sorted(stages, key=lambda stage: -sum(bar.seconds for bar in stages[stage]))
    longest = sorted(bars, key=lambda bar: -bar.seconds)[:_NUM_LONGEST]
    by_stage = [(stage, str(len(stages[stage])), *_row(stages[stage], total_s)) for stage in order]
    by_shard = [
        (bar.manifest.ref.stage, bar.manifest.partition, bar.manifest.name, *_row([bar], total_s)) for bar in longest
    ]
    return [
        TextTable("Stages", ("stage", "shards", *_HEADINGS), tuple(by_stage)),
        TextTable(f"The {len(longest)} longest shards", ("stage", "partition", "shard", *_HEADINGS), tuple(by_shard)),
    ]


def _row(bars: Sequence[_Bar], total_s: float) -> tuple[str, ...]:
    """Return the times of shards, in the columns of `_HEADINGS`."""
    seconds = sum(bar.seconds for bar in bars)
    return (
        f"{seconds:.2f} s",
        f"{sum(bar.place.processor_s for bar in bars):.2f} s",
        f"{seconds / total_s:.1%}" if total_s else "-",
        f"{max(bar.place.memory_bytes for bar in bars) / 1e6:.0f} MB",
        f"{sum(bar.manifest.num_bytes for bar in bars) / 1e6:.2f} MB",
    )
