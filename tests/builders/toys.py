"""Small stages for tests of the runner: real shards in a real store, with gates to stop at and a record of what ran.

Environment: TOY_FOLDER is a folder for gates and records. A shard named `<stage>-<partition>-<name>` waits while the
file `hold-<that>` is there and fails while `fail-<that>` is there; it leaves a line in `ran.txt` when it begins to
compute.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.graph import Graph
from tasks.stage import EarlyPlan, Parameters, Shard, SourceFile, Stage, StageInputs, StageName
from tasks.stage.committing import commit
from tasks.stage.facts import Facts, TakeFacts, merge_takes
from tasks.stage.streams import stream

HOLD_LIMIT_S = 60.0


def note_and_obey(shard: Shard) -> None:
    time.sleep(float(os.environ.get("TOY_PAUSE_S", "0")))
    folder = Path(os.environ.get("TOY_FOLDER", "/nonexistent"))
    if not folder.is_dir():
        return
    name = f"{shard.stage}-{shard.partition}-{shard.name}"
    with (folder / "ran.txt").open("a") as file:
        file.write(f"{name} {os.getpid()}\n")
    if (folder / f"fail-{name}").exists():
        raise OSError(28, "No space left on device")
    deadline = time.monotonic() + HOLD_LIMIT_S
    while (folder / f"hold-{name}").exists() and time.monotonic() < deadline:
        time.sleep(0.01)


class GrowParameters(Parameters):
    num_takes: int = Field(2, ge=1, le=50, description="Takes")
    num_segments: int = Field(3, ge=1, description="Segments of each take, each from the one before")
    scale: float = Field(1.0, gt=0, description="Scale of the values")
    source: Path | None = Field(None, description="A file whose bytes enter")
    licence: str = Field("CC0-1.0", description="Licence of the takes")


class SegmentParameters(Parameters):
    take: int
    segment: int
    scale: float
    licence: str


class BendParameters(Parameters):
    step: int = Field(1000, ge=1, description="Values are rounded to multiples of this")
    level: Level | None = Field(None, description="What it thinks of them")


class JudgeParameters(Parameters):
    title: str = Field("toys", description="Title of the report")
    level: Level = Field(Level.WARN, description="What it thinks of them")


class AsideParameters(Parameters):
    size: int = Field(4, ge=0, description="Rows; none make no shard")


GROW, BEND, JUDGE, ASIDE = (StageName(name, 1) for name in ("grow", "bend", "judge", "aside"))


def plan_grow(inputs: StageInputs, parameters: GrowParameters) -> list[Shard]:
    files: tuple[SourceFile, ...] = ()
    if parameters.source is not None:
        if not parameters.source.is_file():
            raise InputError(f"grow.source: {parameters.source.name} does not exist")
        import hashlib

        files = (SourceFile(str(parameters.source), hashlib.sha256(parameters.source.read_bytes()).hexdigest()),)
    shards: list[Shard] = []
    for take in range(parameters.num_takes):
        before: tuple[str, ...] = ()
        for segment in range(parameters.num_segments):
            options = parameters.part(SegmentParameters, take=take, segment=segment)
            shard = GROW.shard(inputs, f"t{take}", f"s{segment}", options, files=files, after=before)
            before = (shard.key,)
            shards.append(shard)
    return shards


def run_grow(shard: Shard, store: Store) -> ArtifactRef:
    note_and_obey(shard)
    options, value = shard.options(SegmentParameters), 0.0
    for key in shard.after:
        before = store.find("grow", key)
        assert before is not None, "the segment before is not committed"
        value = float(store.read(before.ref, "training_log")["value"][-1])
    noise = stream(shard.seed, "grow", shard.partition, options.segment).normal(size=5)
    values = value + np.cumsum(np.abs(noise)) * options.scale
    return commit(
        shard,
        store,
        tables={
            "training_log": {
                "split": [shard.partition] * 5,
                "model": ["grow"] * 5,
                "step": np.arange(5),
                "quantity": ["value"] * 5,
                "value": values,
            }
        },
        facts=TakeFacts(take_id=shard.partition, takes=(shard.partition,)),
        sources=[SourceCredit(name=shard.partition, licence=options.licence, credit="made for a test")],
    )


def plan_bend(inputs: StageInputs, parameters: BendParameters) -> list[Shard]:
    return [
        BEND.shard(inputs, manifest.partition, manifest.name, parameters, {"log": [manifest]})
        for manifest in inputs.of("training_log")
    ]


def run_bend(shard: Shard, store: Store) -> ArtifactRef:
    note_and_obey(shard)
    step, level = shard.options(BendParameters).step, shard.options(BendParameters).level
    values = np.floor(store.read(shard.ref("log"), "training_log")["value"] / step) * step
    return commit(
        shard,
        store,
        tables={
            "models": {
                "split": [shard.partition],
                "model": ["bend"],
                "array_name": ["values"],
                "array_shape": [np.array([5], dtype=np.int32)],
                "array_dtype": ["float64"],
                "values": [values],
            }
        },
        facts=Facts(takes=merge_takes(store.manifest(shard.ref("log")))),
        **({} if level is None else {"verdict": Verdict(level, "made for a test")}),
    )


def plan_judge(inputs: StageInputs, parameters: JudgeParameters) -> list[Shard]:
    return [JUDGE.shard(inputs, "all", "all", parameters, {"models": inputs.of("models")})]


def run_judge(shard: Shard, store: Store) -> ArtifactRef:
    note_and_obey(shard)
    total = sum(float(store.read(ref, "models")["values"][0].sum()) for ref in shard.refs("models"))
    return commit(
        shard,
        store,
        tables={
            "scores": {
                "topic": ["models"],
                "metric": ["total"],
                "method": ["sum"],
                "is_baseline": [False],
                "split": ["all"],
                "item": ["all"],
                "at": [float("nan")],
                "value": [total],
                "unit": [""],
                "count": [len(shard.refs("models"))],
                "low": [float("nan")],
                "high": [float("nan")],
            }
        },
        facts=Facts(takes=()),
        attachments={"report.html": f"<h1>{shard.options(JudgeParameters).title}</h1>".encode()},
        verdict=Verdict(
            shard.options(JudgeParameters).level, "made for a test", "total", total, "m", 2 * total, "twice that"
        ),
    )


def plan_aside(inputs: StageInputs, parameters: AsideParameters) -> list[Shard]:
    if not parameters.size:
        return []
    return [ASIDE.shard(inputs, "aside", "all", parameters)]


def run_aside(shard: Shard, store: Store) -> ArtifactRef:
    note_and_obey(shard)
    size = shard.options(AsideParameters).size
    columns = {
        "sequence_id": ["one"] * size,
        **{name: np.arange(size) for name in ("frame", "person_id", "partner_id", "first_frame", "last_frame")},
        "method": ["draws"] * size,
        "pair17_m": np.zeros((size, 2, 17, 3)),
    }
    return commit(shard, store, tables={"in_betweens": columns}, facts=Facts(takes=()))


TOYS = Graph(
    (
        Stage(
            *("judge", 1, ("models",), ("scores",), JudgeParameters, plan_judge, run_judge, "adds it all up"),
        ),
        Stage("grow", 1, (), ("training_log",), GrowParameters, plan_grow, run_grow, "makes values"),
        Stage(
            "bend",
            1,
            ("training_log",),
            ("models",),
            BendParameters,
            plan_bend,
            run_bend,
            "rounds them",
            early=(EarlyPlan(plan_bend, each=("training_log",)),),
        ),
        Stage(
            "aside",
            1,
            (),
            ("in_betweens",),
            AsideParameters,
            plan_aside,
            run_aside,
            "stands alone",
            "a size (aside.size)",
        ),
    )
)


def toys_with(name: str, graph: Graph = TOYS, **changes: Any) -> Graph:
    """Return the toy stages, one of which is changed."""
    return Graph(tuple(replace(stage, **changes) if stage.name == name else stage for stage in graph.stages))


if __name__ == "__main__":
    from flows.console import main
    from tests.builders import toys  # by its name: workers must find the stages there, not in __main__

    main(sys.argv[1:], graph=toys.TOYS)
