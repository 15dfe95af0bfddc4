"""One run of a study: stage after stage, each planned when what it reads is there; who runs the shards is passed in."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from flows.listener import Listener
from flows.planning import Plan, Selection, StagePlan, plan_stage, stage_inputs, stage_verdict, what_is_missing
from flows.records import begin_record, copy_report, end_record, read_last_run, record_stage, report_folder
from flows.study import Study
from pasdedeux.errors import InputError
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Manifest, MissingArtifact, RunFolder, StorageError, Store, new_run
from tasks.graph import Graph
from tasks.shards import ShardError, joined
from tasks.stage import Shard

__all__ = [
    "Outcome",
    "Partition",
    "Run",
    "StageOutcome",
    "StageRunner",
    "begin",
    "execute",
    "outcome_of_fresh",
    "partitions_to_run",
]


@dataclass(frozen=True)
class Run:
    """Everything one run needs to know; who computes its shards comes separately."""

    study: Study
    graph: Graph
    store: Store
    selection: Selection = field(default_factory=Selection)
    listener: Listener = field(default_factory=Listener)


@dataclass(frozen=True)
class Partition:
    """Shards of one stage that a person sees as one step; `needs` are partitions that must be there before."""

    name: str
    shards: tuple[Shard, ...]
    needs: tuple[str, ...] = ()


StageRunner = Callable[[Run, StagePlan], None]
"""Runs the shards of a stage that are not fresh, and commits them all or raises."""


@dataclass(frozen=True)
class StageOutcome:
    """What a run did for one stage."""

    name: str
    num_shards: int
    num_computed: int
    seconds: float
    artifacts: tuple[ArtifactRef, ...]
    verdict: Verdict | None = None
    empty_reason: str = ""
    missing: str = ""

    @classmethod
    def of(cls, plan: StagePlan, found: Sequence[Manifest], seconds: float) -> StageOutcome:
        """Return what was done for a stage by this plan, which led to these artifacts."""
        return cls(
            name=plan.stage.name,
            num_shards=len(plan.shards),
            num_computed=len(plan.todo),
            seconds=seconds,
            artifacts=tuple(manifest.ref for manifest in found),
            verdict=stage_verdict(found),
            empty_reason=plan.empty_reason,
            missing=what_is_missing(plan, found),
        )

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "stage": self.name,
            "num_shards": self.num_shards,
            "num_computed": self.num_computed,
            "seconds": round(self.seconds, 3),
            "verdict": None if self.verdict is None else self.verdict.to_json(),
            "artifacts": [{"key": ref.key, "content_digest": ref.content_digest} for ref in self.artifacts],
        }


@dataclass(frozen=True)
class Outcome:
    """What a run did, stage by stage, where its report is (None when the study makes none), and the memory it took."""

    run_id: str
    stages: tuple[StageOutcome, ...]
    report: Path | None
    peak_memory_bytes: int | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """Return what is missing for the stages that were asked for and made nothing, a sentence each."""
        return tuple(stage.missing for stage in self.stages if stage.missing)

    @property
    def num_computed(self) -> int:
        """Return the number of shards computed."""
        return sum(stage.num_computed for stage in self.stages)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "run_id": self.run_id,
            "num_computed": self.num_computed,
            "report": None if self.report is None else str(self.report),
            "peak_memory_bytes": self.peak_memory_bytes,
            "stages": [stage.to_json() for stage in self.stages],
        }


def execute(run: Run, folder: RunFolder, plan: Plan, run_stage: StageRunner) -> Outcome:
    """Bring every selected stage of the study up to date; the record of the last run follows stage by stage.

    Args:
        run: What is to be built.
        folder: Where the run is recorded, from `begin`.
        plan: The plan made beforehand.
        run_stage: Runs the shards of one stage.

    Raises:
        ShardError, InputError: A stage failed; those that need nothing of it are up to date.
    """
    status = "failed"
    outcomes: list[StageOutcome] = []
    try:
        manifests: dict[str, Sequence[Manifest]] = {}
        failures: dict[str, ShardError | InputError] = {}
        left_out: list[str] = []
        for first in plan.stages:
            name = first.stage.name
            manifests[name] = first.manifests
            if not first.is_selected:
                continue
            if {*failures, *left_out}.intersection(run.graph.upstream[name]):
                left_out.append(name)
                continue
            try:
                outcome, manifests[name] = _bring_up_to_date(run, folder.run_id, first, manifests, run_stage)
                outcomes.append(outcome)
            except (ShardError, InputError) as error:
                failures[name] = error
                if isinstance(error, ShardError) and error.is_fatal:
                    break
        if failures:
            if left_out:
                run.listener.note(f"not run, as they need what failed: {', '.join(left_out)}")
            raise _as_one(failures)
        status = "finished"
    except KeyboardInterrupt:
        status = "interrupted"
        raise
    finally:
        # On a disk that is full the record fails as well: what is said is what went wrong first.
        with nullcontext() if status == "finished" else suppress(StorageError):
            run.store.clear_leftovers()
            end_record(folder, run.study.name, status, [outcome.to_json() for outcome in outcomes])
    return Outcome(folder.run_id, tuple(outcomes), copy_report(run.store, folder, _reporting(run, outcomes)))


def begin(run: Run, plan: Plan) -> RunFolder:
    """Make the folder of a new run and write down what is about to be done."""
    folder = new_run(run.store, run.study.name)
    begin_record(folder, run.study.name, run.study.resolved(), plan.to_json())
    return folder


def outcome_of_fresh(run: Run, plan: Plan) -> Outcome:
    """Return the outcome of a study that is fresh; a run is recorded only when none of this study was before."""
    last = read_last_run(run.store, run.study.name)
    is_on_record = last is not None and all(
        last.refs(stage.stage.name) == [m.ref for m in stage.manifests] for stage in plan.stages if stage.is_selected
    )
    has_report = any("scores" in stage.stage.writes and stage.is_selected for stage in plan.stages)
    report = report_folder(run.store, last.run_id) if last is not None else None
    if last is None or not is_on_record or (has_report and report is None):
        return execute(run, begin(run, plan), plan, _no_work)
    outcomes = tuple(StageOutcome.of(stage, stage.manifests, 0.0) for stage in plan.stages if stage.is_selected)
    return Outcome(last.run_id, outcomes, report)


def partitions_to_run(plan: StagePlan) -> list[Partition]:
    """Return the shards that are not fresh by partition, each partition after those whose shards it reads."""
    home = {shard.key: shard.partition for shard in plan.todo}
    shards: dict[str, list[Shard]] = {}
    needs: dict[str, set[str]] = {}
    for shard in plan.todo:
        shards.setdefault(shard.partition, []).append(shard)
        needs.setdefault(shard.partition, set()).update(
            home[key] for key in shard.after if home.get(key, shard.partition) != shard.partition
        )
    # Sorted: sets of names have another order in every process, and partitions would have.
    order = TopologicalSorter({name: sorted(before) for name, before in needs.items()}).static_order()
    return [Partition(name, tuple(shards[name]), tuple(sorted(needs[name]))) for name in order]


def _bring_up_to_date(
    run: Run, run_id: str, first: StagePlan, manifests: dict[str, Sequence[Manifest]], run_stage: StageRunner
) -> tuple[StageOutcome, tuple[Manifest, ...]]:
    """Plan one stage on what is there now, compute what is not fresh, and record it."""
    stage, study = first.stage, run.study
    started = time.perf_counter()
    plan = first
    is_forced = stage.name in run.selection.force
    if first.is_pending:
        inputs = stage_inputs(
            stage, study.head.seed, {name: manifests[name] for name in run.graph.upstream[stage.name]}
        )
        plan = plan_stage(stage, study, inputs, run.store, is_forced=is_forced)
        plan = replace(plan, is_asked=first.is_asked)
    run.listener.stage_started(plan)
    if plan.todo:
        for manifest in plan.manifests if is_forced else ():
            run.store.discard(manifest.ref)
        run_stage(run, plan)
    found: list[Manifest] = []
    for item in plan.shards:
        manifest_or_none = run.store.find(stage.name, item.shard.key)
        if manifest_or_none is None:
            raise MissingArtifact(f"stage {stage.name} left no artifact for {item.shard.partition} {item.shard.name}")
        found.append(manifest_or_none)
    record_stage(run.store, study.name, run_id, stage.name, found)
    seconds = time.perf_counter() - started
    outcome = StageOutcome.of(plan, found, seconds)
    run.listener.stage_finished(plan, seconds, outcome.verdict)
    return outcome, tuple(found)


def _as_one(failures: Mapping[str, ShardError | InputError]) -> Exception:
    """Return one error for what failed, stage by stage."""
    if len(failures) == 1:
        return next(iter(failures.values()))
    return joined(
        [
            error if isinstance(error, ShardError) else ShardError(f"stage {name}", type(error).__name__, str(error))
            for name, error in failures.items()
        ]
    )


def _no_work(run: Run, plan: StagePlan) -> None:
    raise AssertionError(f"stage {plan.stage.name} has work although all of it is fresh")


def _reporting(run: Run, outcomes: Sequence[StageOutcome]) -> list[ArtifactRef]:
    """Return the artifacts of the stage that writes `scores`: the report is attached to them."""
    return [ref for o in outcomes if "scores" in run.graph.stage(o.name).writes for ref in o.artifacts]
