"""`check`: judges motions of two people from any source like takes and variants, without a study or a store."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from flows.console import options
from flows.console.context import answer, app
from flows.console.display import StepReporter, format_table, make_listener
from flows.console.inputs import RateOption, UnitOption, in_options
from flows.exports.export_format import write_text
from pasdedeux.augmentation import quality
from pasdedeux.evaluation.motion_check import HELD, TOUCH
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.report import render
from pasdedeux.evaluation.score_tables import TextTable, format_value
from pasdedeux.figure import Figure
from pasdedeux.plain_text import counted
from pasdedeux.plausibility import capture
from pasdedeux.threads import use_one_thread
from pasdedeux.verdict import Level
from tasks.ingest.checking import (
    UNREADABLE,
    Checked,
    MotionFiles,
    check_motion,
    clips_in_folder,
    count_people,
    files_below,
    motion_player,
    pair_up,
    source_of,
)

_NUM_SHOWN = 10
"""Number of motions in players, the worst first."""
_NUM_NAMED, _MAX_ROWS = 20, 60
"""Motions named at the top of the page, and rows in a terminal."""
_FEW, _FEW_FILES = 8, 100
"""Up to this many motions, or files, are handled in this process, which avoids starting others."""


@app.command()
def check(
    paths: Annotated[list[Path], Argument(metavar="PATH...", help="Folders or motion files, a person or more each.")],
    source: Annotated[
        Path | None, Option(metavar="PATH", help="The sources of these motions: a folder or files.")
    ] = None,
    page: Annotated[Path, Option(metavar="FILE", help="Page to write.")] = Path("check.html"),
    unit: UnitOption = None,
    rate: RateOption = None,
    workers: Annotated[int | None, Option(min=1, help="Processes; one per core when not given.")] = None,
    fail_on: options.FailOn = None,
    as_json: options.Json = False,
) -> None:
    """Check motion of two people from any source, and show the worst.

    BVH, AMC with its ASF, C3D, TRC, npz, ExPI and SMPL are read as in a study: units, axes, rates and layouts are
    detected from the content.  Partners are found by their names: `waltz_A.bvh` with `waltz_B.bvh`, `60_03.bvh` with
    `61_03.bvh`, `A/x.bvh` with `B/x.bvh`; a file of two people is a pair, and so are two files given alone.

    \b
      pasdedeux check captures                    a folder; writes check.html
      pasdedeux check a.bvh b.bvh --unit 0.0254   two people, in inches
      pasdedeux check variants --source takes     variants against their takes
      pasdedeux check captures --fail-on fail     for a script

    The check covers unit and axes, floor (height for each person, tilt), sliding feet, jumps (also out of the first
    frame), jerk, size, the same motion or body twice, and overlap of bodies.  The limits are those of a study
    (`pasdedeux study keys ingest`).  With --source, each motion is compared with its source, whose name is the start
    of its own: are contacts kept, do standing feet stay, is it as smooth (`pasdedeux study keys augmentation`).

    \b
    pass   nothing was found
    warn   look at it; the reason says what and where
    fail   do not use it

    A file that cannot be read gets a row that says why, and the exit code is 2.  --json prints all figures.
    """
    with _pool(workers) as run:
        pairs, checked = _find(paths, unit or (), rate, run)
        if source is not None:
            sources, unread = _find([source], unit or (), rate, run)
            originals = [motion for motion, _ in sources]
            sourced = [(motion, source_of(motion.name, originals)) for motion, _ in pairs]
            pairs = [pair for pair in sourced if pair[1] is not None]
            checked += unread + [_without_source(motion, originals) for motion, its in sourced if its is None]
        checked += [replace(pair, reason=in_options(pair.reason)) for pair in run(check_motion, pairs)]
        checked.sort(key=lambda motion: (-motion.verdict.level.rank, motion.name))
        files = {motion.name: (motion, its) for motion, its in pairs}
        worst = [motion for motion in checked if motion.name in files and motion.figures][:_NUM_SHOWN]
        pictures = run(motion_player, [(*files[motion.name], motion) for motion in worst])
    write_text(page, _page(checked, pictures))
    answer([_as_json(motion) for motion in checked], [*_lines(checked), f"page: {page}"], as_json=as_json)
    levels = {motion.level for motion in checked}
    if UNREADABLE in levels:
        raise typer.Exit(2)
    if fail_on is not None and levels & {Level.FAIL, fail_on}:
        raise typer.Exit(1)


Run = Callable[..., list[Any]]
"""Calls a function with each row of arguments, and returns its results in the same order."""


@contextmanager
def _pool(workers: int | None) -> Iterator[Run]:
    """Yield a function that runs work in processes and shows progress; small work runs in this process."""
    use_one_thread()
    context = get_context("forkserver")
    context.set_forkserver_preload(["tasks.ingest.checking"])
    with ProcessPoolExecutor(workers or len(os.sched_getaffinity(0)), context) as pool:

        def run(work: Callable[..., Any], rows: Sequence[tuple[Any, ...]], few: int = _FEW) -> list[Any]:
            if len(rows) <= few:
                return [work(*row) for row in rows]
            listener, done = make_listener(), list[Any]()
            listener.note(f"{len(rows)} to look at")
            step = StepReporter(listener, len(rows))
            try:
                for result in pool.map(work, *zip(*rows, strict=True), chunksize=4):
                    done.append(result)
                    step()
            finally:
                listener.close()
                pool.shutdown(wait=False, cancel_futures=True) if len(done) < len(rows) else None
            return done

        yield run


def _find(
    paths: Sequence[Path], units_m: Sequence[float], rate_hz: float | None, run: Run
) -> tuple[list[tuple[MotionFiles, MotionFiles | None]], list[Checked]]:
    """Return the motions of files and folders, clips of datasets with their sources, and unreadable files."""
    clips = {path: clips_in_folder(path) for path in paths}
    named_clips = [clip for of_folder in clips.values() for clip in of_folder]
    if all(clips.values()):
        return named_clips, []
    files = files_below([path for path, of_folder in clips.items() if not of_folder])
    counts = dict(zip(files, run(count_people, [(path,) for path in files], _FEW_FILES), strict=True))
    whole = {path: count for path, count in counts.items() if isinstance(count, int)}
    unread = [Checked(path.stem, (str(path),), UNREADABLE, why) for path, why in counts.items() if isinstance(why, str)]
    return named_clips + [(motion, None) for motion in pair_up(whole, units_m=units_m, rate_hz=rate_hz)], unread


def _without_source(motion: MotionFiles, sources: Sequence[MotionFiles]) -> Checked:
    names = ", ".join(other.name for other in sources[:5]) + ", ..." * (len(sources) > 5)
    why = f"no source has a name that this begins with; sources: {names}"
    return Checked(motion.name, motion.files, UNREADABLE, why)


def _as_json(pair: Checked) -> dict[str, Any]:
    return {"name": pair.name, "files": list(pair.files), "verdict": pair.level, "reason": pair.reason} | pair.figures


def _lines(checked: Sequence[Checked]) -> list[str]:
    """Return the table for a terminal, the worst first, and the number of motions at each level."""
    rows = [(pair.level, pair.name, *_cells(pair, _TOUCH).values(), pair.reason) for pair in checked[:_MAX_ROWS]]
    lines = format_table(("verdict", "name", *_TOUCH, "why"), rows, text_columns=(0, 1, len(_TOUCH) + 2))
    if len(checked) > _MAX_ROWS:
        lines.append(f"and {len(checked) - _MAX_ROWS} more, all of them on the page")
    return [*lines, _counted(checked)]


def _counted(checked: Sequence[Checked]) -> str:
    levels = [motion.level for motion in checked]
    each = (f"{levels.count(level)} {level}" for level in (UNREADABLE, "fail", "warn", "pass") if level in levels)
    return f"{counted(len(checked), 'motion')}: {', '.join(each)}"


def _cells(checked: Checked, columns: Mapping[str, Figure]) -> dict[str, str]:
    """Return figures as text; of several people the worst value."""
    cells = {}
    for heading, figure in columns.items():
        given = [checked.figures, checked.figures.get("against_source", {}), *checked.figures.get("people", ())]
        values = [row[figure.name] for row in given if row.get(figure.name) is not None]
        if not values:
            cells[heading] = ""
        elif figure.kind == "str" or isinstance(values[0], str):
            cells[heading] = ", ".join(dict.fromkeys(map(str, values)))
        elif figure.name.endswith("_share"):
            cells[heading] = f"{100 * max(values):.0f} %"
        else:
            worst = min if figure.better == "larger" else max
            cells[heading] = format_value(float(worst(values)), figure.unit)
    return cells


def _page(checked: Sequence[Checked], pictures: Sequence[Picture]) -> str:
    tables = [
        _table("Verdicts and contacts", checked, _TOUCH, {"why": lambda motion: motion.reason}),
        _table("How files were read", checked, _READ, {"files": lambda motion: ", ".join(dict.fromkeys(motion.files))}),
        _table("Capture, the worse of both people", checked, _CAPTURE),
        _table("Against the source", [motion for motion in checked if "source" in motion.figures], _AGAINST),
    ]
    bad = {motion.name: motion.verdict for motion in checked if motion.verdict.level is not Level.PASS}
    return render(
        "check.html", title="Check of motions", said=_counted(checked), bad=bad, pictures=pictures, tables=tables
    )


def _table(
    caption: str,
    checked: Iterable[Checked],
    columns: Mapping[str, Figure],
    more: Mapping[str, Callable[[Checked], str]] | None = None,
) -> TextTable:
    more = more or {}
    rows = (
        (motion.name, motion.level, *_cells(motion, columns).values(), *(tell(motion) for tell in more.values()))
        for motion in checked
    )
    return TextTable(caption, ("name", "verdict", *columns, *more), tuple(rows))


def _columns(figures: Mapping[str, Figure], *, all_of_them: bool = False) -> dict[str, Figure]:
    """Return figures by their column headings, by default only those with limits."""
    return {figure.words: figure for name, figure in figures.items() if all_of_them or figure.limits is not None}


_TOUCH = {"seconds": Figure("duration_s", "s", "")} | _columns(TOUCH, all_of_them=True)
_READ = {
    "format": Figure("format", "", "", kind="str"),
    "layout": Figure("layout", "", "", kind="str"),
    "rate": Figure("rate_hz", "Hz", ""),
    "metres of a unit": Figure("metres_per_unit", "", ""),
    "up": Figure("up_axis", "", "", kind="str"),
    "stature": capture.FIGURES["stature_m"],
}
_CAPTURE = _columns(capture.FIGURES)
_AGAINST = _columns(HELD) | _columns(quality.FIGURES)
