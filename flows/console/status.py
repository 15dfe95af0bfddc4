"""`status`: the contents of a store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from flows.console import options
from flows.console.context import answer, app, open_store
from flows.console.display import format_table, manifest_lines, size_text
from flows.records import describe_runs, last_manifests, read_last_run, uncollected
from pasdedeux.plain_text import counted
from storage_schema import LatestRun, Manifest, Store, latest_studies
from storage_schema.references import what_is_wrong
from tasks.summary import stage_verdict


@app.command()
@uncollected()
def status(store: options.Store = Path("store"), as_json: options.Json = False) -> None:
    """Show the contents of a store: its studies, their verdicts, its runs and its size."""
    opened = open_store(store)
    described = describe_store(opened)
    answer(described.described, _status_lines(opened, described), as_json=as_json)


class Described(NamedTuple):
    """What `status` says of a store as JSON values, the last run of each study, and what is there of it by stage."""

    described: dict[str, Any]
    lasts: list[LatestRun]
    manifests: dict[str, dict[str, list[Manifest]]]


def describe_store(store: Store) -> Described:
    """Return what `status` says of a store."""
    lasts = [last for name in latest_studies(store) if (last := read_last_run(store, name)) is not None]
    manifests_by_study = {last.study: last_manifests(store, last) for last in lasts}
    return Described(_describe(store, lasts, manifests_by_study), lasts, manifests_by_study)


def _status_lines(store: Store, described: Described) -> Iterator[str]:
    if not described.lasts:
        yield f"store {store}: no study was built yet"
    for last, study in zip(described.lasts, described.described["studies"], strict=True):
        yield f"study {study['study']}, last run {study['run_id']}"
        rows = [(f"  {s['stage']}", s["num_shards"], s["num_there"], size_text(s["bytes"])) for s in study["stages"]]
        yield from format_table(("  stage", "shards", "there", "size"), rows)
        manifests = described.manifests[last.study]
        for line in (*_missing_lines(store, last, manifests), *manifest_lines(manifests)):
            yield f"  {line}"
    yield from (f"run {record['run_id']}: {record['status']}" for record in described.described["runs"][-5:])


def _missing_lines(store: Store, last: LatestRun, by_stage: Mapping[str, Sequence[Manifest]]) -> list[str]:
    """Say what is not there of what a study has made, and why; nothing where all is."""
    there = {manifest.ref.place for manifests in by_stage.values() for manifest in manifests}
    gone = [ref for stage in last.stages for ref in last.refs(stage) if ref.place not in there]
    return [
        f"missing: {counted(len(gone), 'artifact')}, such as {ref.stage}@{ref.key[:12]}, which "
        f"{what_is_wrong(ref, store)}; a run of the study recomputes what it needs"
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
