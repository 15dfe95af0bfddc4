"""Stage `ingest`: what comes in, as takes with poses, and as annotations with the cameras of virtual video."""

from __future__ import annotations

from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.facts import SkippedFacts
from tasks.ingest.annotations import run_annotations
from tasks.ingest.parameters import IngestParameters
from tasks.ingest.plan import INGEST, plan
from tasks.ingest.shard_parameters import (
    AnnotationParameters,
    DuetParameters,
    SkippedParameters,
    TakeParameters,
    VideoParameters,
)
from tasks.ingest.takes import run_duet, run_take
from tasks.ingest.virtual_video import run_virtual_video
from tasks.stage import Shard, Stage, commit

__all__ = ["STAGE", "IngestParameters", "plan", "run_shard"]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Compute and commit one shard: a take, virtual video over a take, or a source of 2D poses."""
    match shard.parameters:
        case DuetParameters() as parameters:
            return run_duet(shard, store, parameters)
        case TakeParameters() as parameters:
            return run_take(shard, store, parameters)
        case VideoParameters() as parameters:
            return run_virtual_video(shard, store, parameters)
        case AnnotationParameters() as parameters:
            return run_annotations(shard, store, parameters)
        case SkippedParameters(skipped=skipped):
            words = f"{', '.join(skipped)} skipped: {next(iter(skipped.values()))}"
            facts = SkippedFacts(takes=(), skipped=tuple(skipped.values()))
            return commit(shard, store, tables={}, facts=facts, verdict=Verdict(Level.WARN, words))
        case other:
            raise AssertionError(f"ingest has no shards of {type(other).__name__}")


STAGE = Stage(
    *INGEST,
    reads=(),
    writes=("takes", "take_quality", "poses", "objects", "annotations", "cameras"),
    parameters=IngestParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Takes with poses, and 2D annotations, from files, built-in duets and virtual video",
    needs="takes or annotations ([[ingest.takes]], [[ingest.annotations]])",
)
