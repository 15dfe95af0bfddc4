"""`status`, `verify` and `gc`: what lies in a store, whether it is whole, and the room that nothing needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from typer import Option

from flows.collecting import Collection, collect, find_garbage
from flows.console.context import JsonOption, StoreOption, answer, app, open_store
from flows.console.display import format_table, manifest_lines
from flows.records import describe_runs, last_manifests, read_last_run, uncollected
from pasdedeux.plain_text import counted
from storage_schema import LatestRun, Manifest, Store, UnknownReference, latest_studies
from storage_schema import verify as verify_store
from storage_schema.manifest import RESERVED_NAMES
from storage_schema.references import what_is_wrong
from storage_schema.verification import ProblemKind
from tasks.summary import stage_verdict


@app.command()
@uncollected()
def status(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
    """Show what is in a store: the studies built in it, their verdicts, its runs and its size."""
    opened = open_store(store)
    found = describe_store(opened)
    answer(found.described, _status_lines(opened, found), as_json=as_json)


class Described(NamedTuple):
    """What `status` says of a store as JSON values, the last run of each study, and what is there of it by stage."""

    described: dict[str, Any]
    lasts: list[LatestRun]
    manifests: dict[str, dict[str, list[Manifest]]]


def describe_store(store: Store) -> Described:
    """Return what `status` says of a store."""
    lasts = [last for name in latest_studies(store) if (last := read_last_run(store, name)) is not None]
    found = {last.study: last_manifests(store, last) for last in lasts}
    return Described(_describe(store, lasts, found), lasts, found)


@app.command()
def verify(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
    """Read every file of the store again and compare it with its manifest; exit code 1 when something is wrong."""
    opened = open_store(store)
    if not opened.root.is_dir():
        raise UnknownReference(f"there is no store in {opened}; --store names the folder of one")
    found = verify_store(opened)
    size = (
        f"{counted(found.num_artifacts, 'artifact')}, {counted(found.num_files, 'file')}, "
        f"{found.num_bytes / 1e6:.1f} MB"
    )
    lines = [*map(str, found.problems), *(f"note: {note}" for note in found.notes)]
    lines.append(
        f"{size}: " + ("all as their manifests say" if found.is_ok else counted(len(found.problems), "problem"))
    )
    damaged = {problem.stage for problem in found.problems if problem.kind is not ProblemKind.EXTRA}
    if stages := sorted(damaged - RESERVED_NAMES):
        force = " ".join(f"--force {stage}" for stage in stages)
        lines.append(f"what is damaged is computed again by `pasdedeux run STUDY {force}`")
    described = {"is_ok": found.is_ok, **asdict(found), "problems": [str(problem) for problem in found.problems]}
    answer(described, lines, as_json=as_json)
    if not found.is_ok:
        raise typer.Exit(1)


def _status_lines(store: Store, found: Described) -> Iterator[str]:
    if not found.lasts:
        yield f"store {store}: no study was built in it yet"
    for last, study in zip(found.lasts, found.described["studies"], strict=True):
        yield f"study {study['study']}, last run {study['run_id']}"
        rows = [(f"  {s['stage']}", s["num_shards"], s["num_there"], _size(s["bytes"])) for s in study["stages"]]
        yield from format_table(("  stage", "shards", "there", "size"), rows)
        manifests = found.manifests[last.study]
        for line in (*_missing_lines(store, last, manifests), *manifest_lines(manifests)):
            yield f"  {line}"
    yield from (f"run {record['run_id']}: {record['status']}" for record in found.described["runs"][-5:])


def _missing_lines(store: Store, last: LatestRun, found: Mapping[str, Sequence[Manifest]]) -> list[str]:
    """Say what is not there of what a study has made, and why; nothing where all is."""
    there = {one.ref.place for manifests in found.values() for one in manifests}
    gone = [ref for stage in last.stages for ref in last.refs(stage) if ref.place not in there]
    return [
        f"not there: {counted(len(gone), 'artifact')}, such as {ref.stage}@{ref.key[:12]}, which "
        f"{what_is_wrong(ref, store)}; a run of the study computes what it needs anew"
        for ref in gone[:1]
    ]


def _describe(
    store: Store, lasts: Sequence[LatestRun], manifests: Mapping[str, Mapping[str, Sequence[Manifest]]]
) -> dict[str, Any]:
    studies = []
    for last in lasts:
        stages = []
        for stage, found in manifests[last.study].items():
            verdict = stage_verdict(found)
            stages.append(
                {
                    "stage": stage,
                    "num_shards": len(last.stages[stage]),
                    "num_there": len(found),
                    "bytes": sum(manifest.num_bytes for manifest in found),
                    "verdict": None if verdict is None else verdict.to_json(),
                }
            )
        studies.append({"study": last.study, "run_id": last.run_id, "stages": stages})
    return {"store": str(store), "studies": studies, "runs": describe_runs(store)}


@app.command()
def gc(
    store: StoreOption = Path("store"),
    days: Annotated[float, Option(min=0, max=36500, metavar="N", help="Also keep all of the last N days.")] = 7.0,
    is_dry: Annotated[bool, Option("--dry-run/--yes", help="List what would be removed, or remove it.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Delete what nothing needs from a store; without --yes only list it.

    \b
      pasdedeux gc --store /data/store               dry run, by stage
      pasdedeux gc --store /data/store --yes
      pasdedeux gc --store /data/store --days 0 --yes

    It keeps what a dataset names, what the last finished run of each stage of a study made, what `TABLE:study` names,
    what runs of the last days made or read, and everything that any of these were computed from.  Folders of older runs
    are removed with their reports.  Nothing is removed while a run is in progress.  If it is killed, the store stays
    whole, and the same command finishes the work.
    """
    opened = open_store(store)
    if not opened.root.is_dir():
        raise UnknownReference(f"there is no store in {opened}; --store names the folder of one")
    since = datetime.now(UTC) - timedelta(days=days)
    found = find_garbage(opened, since) if is_dry else collect(opened, since)
    by_stage = _by_stage(found)
    names = ("num_kept", "bytes_kept", "num_going", "bytes_going")
    described = {
        "is_dry_run": is_dry,
        "stages": {stage: dict(zip(names, row, strict=True)) for stage, row in by_stage.items()},
        "artifacts": [{"stage": stored.place[0], "key": stored.place[1]} for stored in found.artifacts.going],
        "runs": list(found.going_runs),
    }
    needed_by = f"{counted(found.num_datasets, 'dataset')} and {counted(len(found.kept_runs), 'run')}"
    rows = [
        (stage, num_kept, _size(bytes_kept), num_going, _size(bytes_going))
        for stage, (num_kept, bytes_kept, num_going, bytes_going) in by_stage.items()
    ]
    going = _size(found.num_bytes)
    lines = [
        f"kept: what {needed_by} need, and all that was made since {since:%Y-%m-%d %H:%M} UTC",
        *format_table(("", "stay", "size", "go", "size"), rows),
        f"nothing was removed; --yes removes {going}" if is_dry else f"freed {going}",
    ]
    answer(described, lines, as_json=as_json)


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


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:.1f} MB"
