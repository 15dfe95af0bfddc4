"""Stage `ingest`: what comes in, as takes with poses, and as annotations with the cameras of virtual video."""

from __future__ import annotations

from storage_schema import ArtifactRef, Store
from tasks.ingest.annotation_shards import run_annotations, run_virtual_video
from tasks.ingest.parameters import IngestParameters
from tasks.ingest.planning import VERSION, plan
from tasks.ingest.take_shard import run_take
from tasks.stage import Shard, Stage

__all__ = ["STAGE", "VERSION", "IngestParameters", "plan", "run_shard"]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Compute and commit one shard: a take, virtual video over a take, or a source of 2D poses."""
    kind = shard.parameters["kind"]
    if kind in {"duet", "files"}:
        return run_take(shard, store)
    if kind in {"video", "random_views"}:
        return run_virtual_video(shard, store)
    return run_annotations(shard, store)


STAGE = Stage(
    name="ingest",
    version=VERSION,
    reads=(),
    writes=("takes", "poses", "annotations", "cameras"),
    parameters=IngestParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Takes with poses, and 2D annotations, from files, built-in duets and virtual video",
)
