"""`gc`: frees the room that nothing needs."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from flows.collecting import Collection, collect, find_garbage
from flows.console.context import JsonOption, StoreOption, open_store, print_json
from flows.console.display import counted, print_table
from storage_schema import UnknownReference

app = typer.Typer(rich_markup_mode=None)

_GC = """Remove from a store what nothing needs; without --yes only say what that is, and how many bytes.

\b
  pasdedeux gc --store /data/store               what would go, stage by stage; removes nothing
  pasdedeux gc --store /data/store --yes
  pasdedeux gc --store /data/store --days 0 --yes

Kept is what a dataset names, what the last finished run of each stage of a study made, what `TABLE:study` names, what
runs of the last days made or read, and everything that any of these were computed from.  The folders of older runs go
too, their reports with them.  Nothing is removed while a run is in progress.  Killed half-way it leaves a whole store,
and the same command again finishes.
"""


@app.command(help=_GC)
def gc(
    store: StoreOption = Path("store"),
    days: Annotated[
        float, typer.Option(min=0, max=36500, metavar="N", help="Keep all of the last N days too; 0 for none of them.")
    ] = 7.0,
    is_dry: Annotated[bool, typer.Option("--dry-run/--yes", help="Only say what would go, or remove it.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Remove what nothing needs."""
    opened = open_store(store)
    if not opened.root.is_dir():
        raise UnknownReference(f"there is no store in {opened}; --store names the folder of one")
    since = datetime.now(UTC) - timedelta(days=days)
    found = find_garbage(opened, since) if is_dry else collect(opened, since)
    if as_json:
        print_json(_described(found, is_dry=is_dry))
        return
    kept = f"{counted(found.num_datasets, 'dataset')} and {counted(len(found.kept_runs), 'run')}"
    typer.echo(f"kept: what {kept} need, and all that was made since {since:%Y-%m-%d %H:%M} UTC")
    rows = [(stage, *_cells(*numbers)) for stage, numbers in _by_stage(found).items()]
    print_table(("", "stay", "size", "go", "size"), rows)
    typer.echo(
        f"nothing was removed; --yes removes {_size(found.num_bytes)}" if is_dry else f"freed {_size(found.num_bytes)}"
    )


def _by_stage(found: Collection) -> dict[str, tuple[int, int, int, int]]:
    """Return number and bytes of what stays and of what goes: for each stage, for the folders of runs, for all."""
    counts: Counter[tuple[str, int]] = Counter()
    for at, stored, runs in ((0, found.artifacts.kept, found.kept_runs), (2, found.artifacts.going, found.going_runs)):
        for name, num_bytes in [
            *((one.place[0], one.num_bytes) for one in stored),
            *(("runs", n) for n in runs.values()),
        ]:
            for row in (name, "all"):
                counts[row, at] += 1
                counts[row, at + 1] += num_bytes
    names = sorted({name for name, _ in counts}, key=lambda name: (name == "all", name))
    return {name: (counts[name, 0], counts[name, 1], counts[name, 2], counts[name, 3]) for name in names}


def _described(found: Collection, *, is_dry: bool) -> dict[str, object]:
    names = ("num_kept", "bytes_kept", "num_going", "bytes_going")
    return {
        "is_dry_run": is_dry,
        "stages": {stage: dict(zip(names, row, strict=True)) for stage, row in _by_stage(found).items()},
        "artifacts": [{"stage": stored.place[0], "key": stored.place[1]} for stored in found.artifacts.going],
        "runs": list(found.going_runs),
    }


def _cells(num_kept: int, bytes_kept: int, num_going: int, bytes_going: int) -> tuple[str, str, str, str]:
    return str(num_kept), _size(bytes_kept), str(num_going), _size(bytes_going)


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:.1f} MB"
