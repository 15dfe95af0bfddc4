"""Benchmarks of whole commands: the demo on all cores beside one, and `status` beside plain reading of its store."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from flows.console.stores import describe_store
from flows.machine import usable_cores
from pasdedeux.benchmarks.benchmark import BenchmarkResult, Rate, measure
from storage_schema import ArtifactRef, ShardRecord, Store, record_latest
from storage_schema.manifest import MANIFEST_NAME
from storage_schema.store import ArtifactFields

_NUM_ARTIFACTS = 2_000


class CommandFailedError(Exception):
    """A command that is measured failed; the message is one sentence, with what the command said last."""


def _run_s(workers: int) -> tuple[float, float]:
    """Return what `pasdedeux run duets` takes into a new store by the clock, and of processor time, seconds.

    Raises:
        CommandFailedError: It ended with another exit code than 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "flows.console", "run", "duets", "--store", folder, "--workers", str(workers)]
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            said = next(reversed(done.stderr.strip().splitlines()), f"exit code {done.returncode}")
            raise CommandFailedError(
                f"`pasdedeux run duets --workers {workers}` failed: {said.removeprefix('error: ')}"
            )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return time.perf_counter() - started, spent


def _demo() -> BenchmarkResult:
    """Measure the study of the demo by the clock; the first run, which may compile, is said and not compared."""
    cores = usable_cores()
    first_s, first_spent_s = _run_s(cores)
    many_s, spent_s = _run_s(cores)
    one_s, _ = _run_s(1)
    return BenchmarkResult(
        "demo, `pasdedeux run duets` into an empty store",
        "runs",
        *Rate(f"{cores} workers", 1.0 / many_s),
        *Rate("1 worker", 1.0 / one_s),
        f"{many_s:.0f} s by the clock and {spent_s:.0f} s of processor time; with one worker {one_s:.0f} s; the first "
        f"time, with what was not compiled yet, {first_s:.0f} s and {first_spent_s:.0f} s",
    )


def _status() -> BenchmarkResult:
    """Measure `status` of a store of many small artifacts, all of one stage; its plain form only parses manifests."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(folder)
        described = ArtifactFields(
            stage="takes",
            key=f"{0:064x}",
            partition="take",
            name="0",
            version=1,
            parameters={},
            seed=0,
            inputs=(),
            files=(),
        )
        one = store.commit(tables={}, **described)
        manifest, records = store.manifest(one), []
        for number in range(_NUM_ARTIFACTS):
            key = f"{number:064x}"
            copy = replace(manifest, ref=ArtifactRef("takes", key, one.content_digest))
            place = store.folder("takes", key)
            place.mkdir(parents=True, exist_ok=True)
            (place / MANIFEST_NAME).write_text(copy.to_json(), encoding="utf-8")
            records.append(ShardRecord.of(copy, store))
        record_latest(store, "many", "none", {"takes": records})
        paths = sorted(Path(folder).glob(f"takes/*/*/{MANIFEST_NAME}"))
        return BenchmarkResult(
            "status of a store",
            "artifacts",
            *measure("status", lambda: describe_store(store), count=_NUM_ARTIFACTS),
            *measure("json of the manifests", lambda: [json.loads(p.read_bytes()) for p in paths], count=len(paths)),
            f"{_NUM_ARTIFACTS:,} artifacts without tables",
        )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"status": _status, "demo": _demo}
