"""Takes of two people walking, in a store as the stage `ingest` would leave them."""

from __future__ import annotations

from typing import Any

import numpy as np

from storage_schema import Manifest, SourceCredit, Store, artifact_key
from tests.builders.walkers import walk


def put_artifact(store: Store, stage: str, name: str, tables: dict[str, Any], facts: dict[str, Any]) -> Manifest:
    """Commit what an earlier stage would have written."""
    ref = store.commit(
        stage=stage,
        key=artifact_key(stage=stage, version=1, parameters={"name": name}, input_digests=[], seed=0),
        partition=name,
        name=name,
        version=1,
        parameters={"name": name},
        seed=0,
        inputs=[],
        files=[],
        tables=tables,
        facts=facts,
        sources=[SourceCredit("walkers", "CC0", "made up for tests")],
    )
    return store.manifest(ref)


def put_take(store: Store, take_id: str, *, rate_hz: float = 30.0, is_held_out: bool = False) -> Manifest:
    frames = 90
    worlds = [walk(frames, seed=sum(map(ord, take_id)) + person, rate_hz=rate_hz) for person in range(2)]
    count = 2 * frames
    frame = np.tile(np.arange(frames), 2)
    columns = {
        "take_id": [take_id] * count,
        "person": np.repeat([0, 1], frames),
        "frame": frame,
        "time_s": frame / rate_hz,
        "root_translation_m": np.zeros((count, 3)),
        "local_unitquat": [np.zeros(4)] * count,
        "pair17_m": np.zeros((count, 17, 3)),
        "op14_m": np.concatenate(worlds),
        "body22_m": np.zeros((count, 22, 3)),
        "body22_world_unitquat": np.zeros((count, 22, 4)),
    }
    facts = {"kind": "take", "take_id": take_id, "takes": [take_id], "rate_hz": rate_hz, "is_held_out": is_held_out}
    facts |= {"num_persons": 2, "num_frames": frames}
    return put_artifact(store, "ingest", take_id, {"poses": columns}, facts)
