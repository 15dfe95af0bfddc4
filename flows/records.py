"""Records of a run: settings, plan, environment, how it ended, report."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from flows.machine import processor, thread_settings
from pasdedeux.garbage import uncollected
from storage_schema import (
    ArtifactRef,
    CorruptArtifact,
    LatestRun,
    Manifest,
    MissingArtifact,
    RunFolder,
    ShardRecord,
    StorageError,
    Store,
    latest_studies,
    list_runs,
    open_run,
    read_latest,
    record_latest,
    record_page,
)
from storage_schema.provenance import code_version, package_versions, source_digest
from storage_schema.runs import REPORT_PAGE, STUDY_FILE

PLAN_FILE, ENVIRONMENT_FILE = "plan.json", "environment.json"
"""Files of a run's folder beside the resolved study: the plan and the environment."""

_RUN = "run.json"
_RUNNING = re.compile(rb'"status": *("running")')


def read_last_run(store: Store, study: str) -> LatestRun | None:
    """Return the last run of a study; None if there was none or its record cannot be read.

    The record only serves explanations; keys decide which artifacts are fresh. A damaged record, or one of an older
    schema, therefore causes no work.
    """
    try:
        return read_latest(store, study)
    except (CorruptArtifact, MissingArtifact):
        return None


def last_runs(store: Store) -> list[LatestRun]:
    """Return the last run of every study, except those whose record cannot be read."""
    return [last for study in latest_studies(store) if (last := read_last_run(store, study)) is not None]


@uncollected()
def last_manifests(store: Store, last: LatestRun, seen: Iterable[Manifest] = ()) -> dict[str, list[Manifest]]:
    """Return the remaining artifacts of the last run by stage; `seen` manifests are not read again."""
    known = {manifest.ref.key: manifest for manifest in seen}

    def look(stage: str, record: ShardRecord) -> Manifest | None:
        manifest = known.get(record.key)
        if manifest is not None and manifest.ref.content_digest == record.content_digest:
            return manifest
        return store.find(stage, record.key)

    return {
        stage: [there for record in records if (there := look(stage, record)) is not None]
        for stage, records in last.stages.items()
    }


def run_file(store: Store, run_id: str, name: str) -> dict[str, Any]:
    """Return a JSON file of a run's folder; empty if it is gone or damaged."""
    try:
        values = json.loads(open_run(store, run_id).read(name))
    except (MissingArtifact, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def last_sections(store: Store, last: LatestRun | None) -> dict[str, Any]:
    """Return the resolved study of the last run by section; empty if it is gone."""
    return {} if last is None else run_file(store, last.run_id, STUDY_FILE)


def record_stage(store: Store, study: str, run_id: str, stage: str, manifests: Sequence[Manifest]) -> None:
    """Record the current artifacts of a stage, unless they are on record already."""
    last = read_last_run(store, study)
    if last is None or stage not in last.stages or not is_on_record(last, stage, manifests):
        record_latest(store, study, run_id, {stage: [ShardRecord.of(manifest, store) for manifest in manifests]})


def is_on_record(last: LatestRun, stage: str, manifests: Sequence[Manifest]) -> bool:
    """Return whether the record of a stage has exactly these artifacts, with their keys and content."""
    refs = [manifest.ref for manifest in manifests]
    return last.refs(stage) == refs and [ref.key for ref in last.refs(stage)] == [ref.key for ref in refs]


def begin_record(folder: RunFolder, study: str, sections: Mapping[str, Any], plan: Mapping[str, Any]) -> None:
    """Write the beginning of a run: the resolved study, the plan, the environment."""
    folder.write(STUDY_FILE, sections)
    folder.write(PLAN_FILE, plan)
    folder.write(ENVIRONMENT_FILE, environment())
    folder.write(_RUN, {**_identity(folder, study), "status": "running"})


def end_record(
    folder: RunFolder, study: str, status: str, stages: Sequence[Mapping[str, Any]], peak_memory_bytes: int | None
) -> None:
    """Write the end of a run: status, outcome by stage, peak memory of a process."""
    said = {"status": status, "stages": list(stages), "peak_memory_bytes": peak_memory_bytes}
    try:
        folder.write(_RUN, {**_identity(folder, study), **said})
    except StorageError:
        _mark_failed(folder)
        raise


def _mark_failed(folder: RunFolder) -> None:
    """Change `running` to `failed` in place, because a full disk has no room for another file."""
    with suppress(OSError), (folder.path / _RUN).open("r+b") as file:
        if (status := _RUNNING.search(file.read())) is not None:
            file.seek(status.start(1))
            file.write(b'"failed" ')


def describe_runs(store: Store) -> list[dict[str, str]]:
    """Return the runs of a store, oldest first, with id, study and status (`killed` if the process is gone)."""
    described = []
    for folder in list_runs(store):
        record = run_record(store, folder.run_id)
        if not record:
            continue
        status = record["status"]
        if status == "running" and record["host"] == platform.node() and not _is_alive(record["pid"]):
            status = "killed"
        described.append({"run_id": folder.run_id, "study": record["study"], "status": status, "host": record["host"]})
    return described


def mixture(store: Store, last: LatestRun, stages: Sequence[str]) -> str:
    """Return why the recorded artifacts of these stages do not belong to one run; empty if they do.

    They belong to one run if all their inputs are on record too, and if changes of the last run were followed to the
    end; it does not matter which run computed them.
    """
    if run_record(store, last.run_id).get("status", "finished") != "finished":
        return f"its last run, {last.run_id}, did not finish"
    now = {stage: {ref.content_digest for ref in last.refs(stage)} for stage in last.stages}
    records = (run_record(store, folder.run_id) for folder in list_runs(store))
    finished = [record for record in records if (record.get("study"), record.get("status")) == (last.study, "finished")]
    for stage in stages:
        # The artifacts of each stage in the last run that built this one.
        runs = ({entry["stage"]: entry for entry in record["stages"]} for record in reversed(finished))
        seen = next((entries for entries in runs if stage in entries), {})
        then = {other: {artifact["content_digest"] for artifact in entry["artifacts"]} for other, entry in seen.items()}
        read = {(ref.stage, ref.content_digest) for shard in last.stages[stage] for ref in shard.inputs}
        changed = {
            other
            for other, digest in read
            if digest not in now.get(other, ()) or then.get(other, now[other]) != now[other]
        }
        if changed:
            return f"stage {stage} was computed before {', '.join(sorted(changed))} changed"
    return ""


def report_folder(store: Store, run_id: str) -> Path | None:
    """Return the folder of a run's report; None without one."""
    folder = store.root / "runs" / run_id / "report"
    return folder if run_id and folder.is_dir() else None


def copy_report(store: Store, folder: RunFolder, refs: Sequence[ArtifactRef]) -> Path | None:
    """Copy the attachments of these artifacts (report page, dataset card, clips) into the run's folder."""
    report = folder.path / "report"
    for ref in refs:
        for name in store.manifest(ref).attachments:
            folder.write_bytes(f"report/{name}", store.attachment(ref, name))
    return report if report.is_dir() else None


def shown_page(store: Store, study: str, report: Path | None) -> Path | None:
    """Copy the page of a run's report to its permanent path, and return the path to open.

    If the store cannot be written, that is the page in the run's folder; without a page, the folder.
    """
    if report is None or not (page := report / REPORT_PAGE).is_file():
        return report
    try:
        return record_page(store, study, page.read_bytes())
    except (OSError, StorageError):
        return page


def _identity(folder: RunFolder, study: str) -> dict[str, Any]:
    return {"study": study, "run_id": folder.run_id, "pid": os.getpid(), "host": platform.node()}


def run_record(store: Store, run_id: str) -> dict[str, Any]:
    """Return the record of a run's end; empty if it is gone or damaged."""
    return run_file(store, run_id, _RUN)


def made_by(store: Store, run_id: str) -> list[ArtifactRef]:
    """Return the artifacts that a run made or found, by stage; none without a record."""
    return [
        ArtifactRef(stage["stage"], artifact["key"], artifact["content_digest"])
        for stage in run_record(store, run_id).get("stages", [])
        for artifact in stage["artifacts"]
    ]


def environment() -> dict[str, Any]:
    """Return the environment of this process for the record; it enters no key."""
    return {
        "platform": platform.platform(),
        "num_cores": os.cpu_count(),
        "packages": {"pasdedeux": code_version(), **package_versions()},
        "sources": source_digest(),
        "processor": processor(),
        "settings": thread_settings(),
    }


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
