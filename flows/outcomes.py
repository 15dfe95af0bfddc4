"""The request of a run, and its outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.planning import StagePlan, StageSelection, what_is_missing
from flows.progress import Listener
from flows.study import Study
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.graph import Graph
from tasks.summary import stage_verdict


@dataclass(frozen=True)
class Run:
    """What one run builds, without the pool that computes its shards; `is_profiled`: with a profile."""

    study: Study
    graph: Graph
    store: Store
    selection: StageSelection = field(default_factory=StageSelection)
    listener: Listener = field(default_factory=Listener)
    is_profiled: bool = False


@dataclass(frozen=True)
class StageOutcome:
    """The outcome of a run for one stage."""

    name: str
    num_shards: int
    num_computed: int
    seconds: float
    artifacts: tuple[ArtifactRef, ...]
    verdict: Verdict | None = None
    empty_reason: str = ""
    missing: str = ""

    @classmethod
    def of(cls, plan: StagePlan, manifests: Sequence[Manifest], seconds: float) -> StageOutcome:
        """Return the outcome of a stage from its plan and its artifacts."""
        return cls(
            name=plan.stage.name,
            num_shards=len(plan.shards),
            num_computed=len(plan.todo),
            seconds=seconds,
            artifacts=tuple(manifest.ref for manifest in manifests),
            verdict=stage_verdict(manifests),
            empty_reason=plan.empty_reason,
            missing=what_is_missing(plan, manifests),
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
    """The outcome of a run by stage, and its memory.

    `report` is the folder of its report, and `page` the file to open; None without a report.
    """

    run_id: str
    stages: tuple[StageOutcome, ...]
    report: Path | None
    peak_memory_bytes: int | None = None
    page: Path | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """Return a sentence for each requested stage that made nothing, with its missing inputs."""
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
            "page": None if self.page is None else str(self.page),
            "peak_memory_bytes": self.peak_memory_bytes,
            "stages": [stage.to_json() for stage in self.stages],
        }
