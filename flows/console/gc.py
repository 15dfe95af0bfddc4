"""`gc`: removes artifacts of a store that nothing needs."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

from typer import Option

from flows.collecting import Collection, collect, find_garbage
from flows.console import options
from flows.console.context import answer, app, existing_store
from flows.console.display import format_table, size_text
from pasdedeux.plain_text import counted


@app.command()
def gc(
    store: options.Store = Path("store"),
    days: Annotated[
        float, Option(min=0, max=36500, metavar="N", help="Also keep everything of the last N days.")
    ] = 7.0,
    is_dry: Annotated[bool, Option("--dry-run/--yes", help="List what would be removed, or remove it.")] = True,
    as_json: options.Json = False,
) -> None:
    """Delete unneeded artifacts of a store; without --yes, only list them.

    \b
      pasdedeux gc --store /data/store               dry run, by stage
      pasdedeux gc --store /data/store --yes
      pasdedeux gc --store /data/store --days 0 --yes

    It keeps the artifacts of datasets, of the last finished run of each stage of a study, of `TABLE:study` references
    and of runs of the last days, and everything that these were computed from.  It removes folders and reports of
    older runs, and clips that were unpacked for training (from any store) but not used in the last days; they are
    unpacked again when needed.  Nothing is removed while a run is in progress.  If gc is killed, the store stays
    intact, and the same command finishes the work.
    """
    opened = existing_store(store)
    since = datetime.now(UTC) - timedelta(days=days)
    collection = find_garbage(opened, since) if is_dry else collect(opened, since)
    by_stage = _by_stage(collection)
    names = ("num_kept", "bytes_kept", "num_going", "bytes_going")
    described = {
        "is_dry_run": is_dry,
        "stages": {stage: dict(zip(names, row, strict=True)) for stage, row in by_stage.items()},
        "artifacts": [{"stage": stored.place[0], "key": stored.place[1]} for stored in collection.artifacts.going],
        "runs": list(collection.going_runs),
        "unpacked_clips": [str(path) for path in collection.going_clips],
    }
    needed_by = f"{counted(collection.num_datasets, 'dataset')} and {counted(len(collection.kept_runs), 'run')}"
    rows = [
        (stage, num_kept, size_text(bytes_kept), num_going, size_text(bytes_going))
        for stage, (num_kept, bytes_kept, num_going, bytes_going) in by_stage.items()
    ]
    going = size_text(collection.num_bytes)
    lines = [
        f"kept: what {needed_by} need, and all that was made since {since:%Y-%m-%d %H:%M} UTC",
        *format_table(("", "stay", "size", "go", "size"), rows),
        f"nothing was removed; --yes removes {going}" if is_dry else f"freed {going}",
    ]
    answer(described, lines, as_json=as_json)


def _by_stage(collection: Collection) -> dict[str, tuple[int, int, int, int]]:
    """Return number and bytes kept and removed: by stage, for folders of runs, for unpacked clips, and in all."""
    counts: Counter[tuple[str, int]] = Counter()
    kept, going = collection.artifacts.kept, collection.artifacts.going
    for at, stored, runs, clips in (
        (0, kept, collection.kept_runs, collection.kept_clips),
        (2, going, collection.going_runs, collection.going_clips),
    ):
        for name, num_bytes in [
            *((artifact.place[0], artifact.num_bytes) for artifact in stored),
            *(("runs", n) for n in runs.values()),
            *(("unpacked clips", n) for n in clips.values()),
        ]:
            for row in (name, "all"):
                counts[row, at] += 1
                counts[row, at + 1] += num_bytes
    names = sorted({name for name, _ in counts}, key=lambda name: (name == "all", name))
    return {name: (counts[name, 0], counts[name, 1], counts[name, 2], counts[name, 3]) for name in names}
