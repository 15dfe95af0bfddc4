"""The stage `ingest` planned and run in this process, and a pair of files for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.placement import place_motion
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Manifest, ShardRecord, Store, record_latest
from tasks.ingest import STAGE, IngestParameters
from tasks.stage import Shard, StageInputs
from tasks.stage.judgements import verdict_of
from tests.builders.source_samples import figure_motion


def planned(**section: Any) -> list[Shard]:
    return STAGE.plan(StageInputs(manifests={}, seed=5), IngestParameters.model_validate(section))


def run(store: Store, shards: list[Shard]) -> dict[tuple[str, str], Manifest]:
    refs: dict[tuple[str, str], ArtifactRef] = {}
    for shard in shards:
        refs[shard.partition, shard.name] = STAGE.run_shard(shard, store)
    return {key: store.manifest(ref) for key, ref in refs.items()}


def ingest_take(store: Store, take: dict[str, Any], **section: Any) -> Manifest:
    """Ingest one take, without virtual video of it."""
    quiet = {"num_videos": 0, "num_random_views": 0}
    (made,) = run(store, planned(takes=[take], virtual_video=quiet, **section)).values()
    return made


def judged(manifest: Manifest) -> Verdict:
    verdict = verdict_of(manifest)
    assert verdict is not None
    return verdict


def write_figure_pair(folder: Path) -> tuple[Path, Path]:
    """Write two BVH files: the figure, and a second person 1 m to its left that faces it."""
    first, second = folder / "60_01.bvh", folder / "61_01.bvh"
    motion = figure_motion(num_frames=40, rate_hz=60.0)
    first.write_text(write_bvh(motion))
    second.write_text(write_bvh(place_motion(motion, translation_m=(1.0, 0.0, 0.0), yaw_rad=np.pi)))
    return first, second


def duet_store(root: Path) -> tuple[Store, list[Manifest]]:
    """Return a store with a waltz of a second at 12 Hz, on record as the study `short`, and the take."""
    store = Store(root)
    shards = planned(rate_hz=12.0, duets=[{"name": "waltz", "duration_s": 1.0}])
    takes = list(run(store, [shard for shard in shards if shard.name == "take"]).values())
    record_latest(store, "short", "20260101T000000-short", {"ingest": [ShardRecord.of(take, store) for take in takes]})
    return store, takes
