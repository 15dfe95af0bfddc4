"""`status`: prints the contents of a store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.console import options
from flows.console.context import answer, app, open_store
from flows.console.display import format_table, manifest_lines, size_text
from flows.records import describe_runs, last_manifests, last_runs
from pasdedeux.garbage import uncollected
from pasdedeux.plain_text import counted
from storage_schema import LatestRun, Manifest, Store
from storage_schema.references import what_is_wrong
from tasks.summary import stage_verdict

StudyManifests = list[tuple[LatestRun, dict[str, list[Manifest]]]]
"""The last run of each study, with its remaining artifacts by stage."""


@app.command()
@uncollected()
def status(store: options.Store = Path("store"), as_json: options.Json = False) -> None:
    """Show the contents of a store: its studies, their verdicts, its runs and its size."""
    opened = open_store(store)
    studies = read_studies(opened)
    described = describe_store(opened, studies)
    answer(described, _status_lines(opened, described, studies), as_json=as_json)


def read_studies(store: Store) -> StudyManifests:
    """Read the last run of each study of a store, and the manifests of its remaining artifacts."""
    return [(last, last_manifests(store, last)) for last in last_runs(store)]


def describe_store(store: Store, studies: StudyManifests) -> dict[str, Any]:
    """Return what `status` prints, as JSON values."""
    return {
        "store": str(store),
        "studies": [_describe(last, manifests) for last, manifests in studies],
        "runs": describe_runs(store),
    }


def _describe(last: LatestRun, by_stage: Mapping[str, Sequence[Manifest]]) -> dict[str, Any]:
    stages = []
    for stage, manifests in by_stage.items():
        verdict = stage_verdict(manifests)
        stages.append(
            {
                "stage": stage,
                "num_shards": len(last.stages[stage]),
                "num_there": len(manifests),
                "bytes": sum(manifest.num_bytes for manifest in manifests),
                "verdict": None if verdict is None else verdict.to_json(),
            }
        )
    return {"study": last.study, "run_id": last.run_id, "stages": stages}


def _status_lines(store: Store, described: Mapping[str, Any], studies: StudyManifests) -> Iterator[str]:
    if not studies:
        yield f"store {store}: no study was built yet"
    for (last, manifests), study in zip(studies, described["studies"], strict=True):
        yield f"study {study['study']}, last run {study['run_id']}"
        rows = [(f"  {s['stage']}", s["num_shards"], s["num_there"], size_text(s["bytes"])) for s in study["stages"]]
        yield from format_table(("  stage", "shards", "there", "size"), rows)
        for line in (*_missing_lines(store, last, manifests), *manifest_lines(manifests)):
            yield f"  {line}"
    yield from (f"run {record['run_id']}: {record['status']}" for record in described["runs"][-5:])


def _missing_lines(store: Store, last: LatestRun, by_stage: Mapping[str, Sequence[Manifest]]) -> list[str]:
    """Return how many artifacts of a study are missing, and why one is; empty if none is."""
    there = {manifest.ref.place for manifests in by_stage.values() for manifest in manifests}
    gone = [ref for ref in last.refs() if ref.place not in there]
    return [
        f"missing: {counted(len(gone), 'artifact')}, such as {ref.stage}@{ref.key[:12]}, which "
        f"{what_is_wrong(ref, store)}; a run of the study recomputes what it needs"
        for ref in gone[:1]
    ]
