"""Benchmarks of whole commands: the demo on all cores and on one, `status` and plain reading of its store."""

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
from typing import NamedTuple

from benchmarks import scale
from benchmarks.benchmark import BenchmarkResult, Rate, measure_rate
from benchmarks.scale import growth
from flows.console.status import describe_store, read_studies
from flows.machine import usable_cores
from pasdedeux.errors import PasdedeuxError
from storage_schema import ArtifactRef, ShardRecord, Store, record_latest
from storage_schema.artifact_writer import ArtifactFields
from storage_schema.manifest import MANIFEST_NAME

_NUM_ARTIFACTS = 2_000
_NUMS_TAKES = (1, 10, 100)
_STAGES = ("ingest", "augmentation", "projections")
_TAKES = """
[study]
name = "takes"

[ingest]
duets = [{{ name = "waltz", count = {count}, duration_s = 2 }}]

[augmentation]
persons = ["A"]
kinds = ["uniform"]

[projections]
include_draws = false
"""


class CommandFailedError(PasdedeuxError):
    """A measured command failed; the message has the last output of the command."""


class _Spent(NamedTuple):
    """Cost of a run: wall time and processor time, memory of its largest process, and size of its store."""

    clock_s: float
    processor_s: float
    memory_mb: float
    written_mb: float


def _run(workers: int, study: str = "duets", *arguments: str) -> _Spent:
    """Return the cost of `pasdedeux run` into a new store.

    Raises:
        CommandFailedError: It ended with another exit code than 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = ["run", study, *arguments, "--workers", str(workers)]
        command = [sys.executable, "-m", "flows.console", *words, "--store", folder, "--json"]
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            said = next(reversed(done.stderr.strip().splitlines()), f"exit code {done.returncode}")
            raise CommandFailedError(f"`pasdedeux {' '.join(words)}` failed: {said.removeprefix('error: ')}")
        clock_s, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        written = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        return _Spent(clock_s, spent_s, json.loads(done.stdout)["peak_memory_bytes"] / 1e6, written / 1e6)


def _demo() -> BenchmarkResult:
    """Measure the wall time of the demo's study; the first run, which may compile, is reported but not compared."""
    cores = usable_cores()
    first_s, first_spent_s, *_ = _run(cores)
    many_s, spent_s, *_ = _run(cores)
    one_s = _run(1).clock_s
    return BenchmarkResult(
        "demo, `pasdedeux run duets` into an empty store",
        "runs",
        *Rate(f"{cores} workers", 1.0 / many_s),
        *Rate("1 worker", 1.0 / one_s),
        f"{many_s:.0f} s by the clock and {spent_s:.0f} s of processor time; with one worker {one_s:.0f} s; the first "
        f"time, with what was not compiled yet, {first_s:.0f} s and {first_spent_s:.0f} s",
    )


def _status() -> BenchmarkResult:
    """Measure `status` of a store with many small artifacts of one stage; the plain form only parses manifests."""
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
        ref = store.commit(tables={}, **described)
        manifest, records = store.manifest(ref), []
        for number in range(_NUM_ARTIFACTS):
            key = f"{number:064x}"
            copy = replace(manifest, ref=ArtifactRef("takes", key, ref.content_digest))
            place = store.folder("takes", key)
            place.mkdir(parents=True, exist_ok=True)
            (place / MANIFEST_NAME).write_text(copy.to_json(), encoding="utf-8")
            records.append(ShardRecord.of(copy, store))
        record_latest(store, "many", "none", {"takes": records})
        paths = sorted(Path(folder).glob(f"takes/*/*/{MANIFEST_NAME}"))
        return BenchmarkResult(
            "status of a store",
            "artifacts",
            *measure_rate("status", lambda: describe_store(store, read_studies(store)), count=_NUM_ARTIFACTS),
            *measure_rate(
                "json of the manifests", lambda: [json.loads(p.read_bytes()) for p in paths], count=len(paths)
            ),
            f"{_NUM_ARTIFACTS:,} artifacts without tables",
        )


def _takes() -> BenchmarkResult:
    """Measure three stages on growing numbers of drawn built-in takes of 2 s, in one process."""
    takes = []
    for count in _NUMS_TAKES:
        with tempfile.TemporaryDirectory() as folder:
            study = Path(folder) / "takes.toml"
            study.write_text(_TAKES.format(count=count), encoding="utf-8")
            takes.append(_run(0, str(study), *(word for name in _STAGES for word in ("--only", name))))
    memory, written = [take.memory_mb for take in takes], [take.written_mb for take in takes]
    megabytes = {"memory": memory, "written": written}
    return growth(", ".join(_STAGES), "takes", _NUMS_TAKES, [take.processor_s for take in takes], megabytes)


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"status": _status, "demo": _demo}
FULL_BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {**scale.FULL_BENCHMARKS, "takes": _takes}
