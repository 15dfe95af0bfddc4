"""`status` and `verify`: what lies in a store, and whether it is whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from flows.console.context import JsonOption, StoreOption, open_store, print_json
from flows.console.display import counted, manifest_lines, print_table
from flows.records import describe_runs, last_manifests, read_last_run, uncollected
from storage_schema import LatestRun, Manifest, Store, UnknownReference, latest_studies
from storage_schema import verify as verify_store
from storage_schema.manifest import RESERVED_NAMES
from storage_schema.references import what_is_wrong
from storage_schema.verification import ProblemKind
from tasks.summary import stage_verdict

app = typer.Typer(rich_markup_mode=None)

_STATUS = "Show what is in a store: the studies built in it, their verdicts, its runs and its size."
_VERIFY = "Read every file of the store again and compare it with its manifest; exit code 1 when something is wrong."


@app.command(help=_STATUS)
@uncollected()
def status(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
    """Show what is in a store."""
    opened = open_store(store)
    lasts = [last for name in latest_studies(opened) if (last := read_last_run(opened, name)) is not None]
    found = {last.study: last_manifests(opened, last) for last in lasts}
    described = _describe(opened, lasts, found)
    if as_json:
        print_json(described)
        return
    if not described["studies"]:
        typer.echo(f"store {opened}: no study was built in it yet")
    for last, study in zip(lasts, described["studies"], strict=True):
        typer.echo(f"study {study['study']}, last run {study['run_id']}")
        rows = [
            (f"  {s['stage']}", str(s["num_shards"]), str(s["num_there"]), f"{s['bytes'] / 1e6:.1f} MB")
            for s in study["stages"]
        ]
        print_table(("  stage", "shards", "there", "size"), rows)
        for line in (*_missing_lines(opened, last, found[last.study]), *manifest_lines(found[last.study])):
            typer.echo(f"  {line}")
    for record in described["runs"][-5:]:
        typer.echo(f"run {record['run_id']}: {record['status']}")


@app.command(help=_VERIFY)
def verify(store: StoreOption = Path("store"), as_json: JsonOption = False) -> None:
    """Read every file of the store again."""
    opened = open_store(store)
    if not opened.root.is_dir():
        raise UnknownReference(f"there is no store in {opened}; --store names the folder of one")
    found = verify_store(opened)
    if as_json:
        print_json({"is_ok": found.is_ok, **asdict(found), "problems": [str(problem) for problem in found.problems]})
    else:
        for problem in found.problems:
            typer.echo(str(problem))
        for note in found.notes:
            typer.echo(f"note: {note}")
        size = f"{found.num_artifacts} artifacts, {found.num_files} files, {found.num_bytes / 1e6:.1f} MB"
        typer.echo(f"{size}: " + ("all as their manifests say" if found.is_ok else f"{len(found.problems)} problems"))
    if not found.is_ok:
        damaged = {problem.stage for problem in found.problems if problem.kind is not ProblemKind.EXTRA}
        stages = sorted(damaged - RESERVED_NAMES)
        if stages and not as_json:
            force = " ".join(f"--force {stage}" for stage in stages)
            typer.echo(f"what is damaged is computed again by `pasdedeux run STUDY {force}`")
        raise typer.Exit(1)


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
