"""Takes of two people walking, in a store as the stage `ingest` would leave them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.kinematics import forward_kinematics
from pasdedeux.reconstruction.body import REFERENCE_REST_M, body_through, pose_body
from pasdedeux.skeletons import BODY22
from storage_schema import Manifest, SourceCredit, Store, artifact_key
from tests.builders.storage_rows import random_columns
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


def _bodies(positions: np.ndarray) -> dict[str, np.ndarray]:
    """The whole bodies of op14 positions, backs straight."""
    body = body_through(positions)
    pelvis, local = pose_body(body, positions)
    body22, world = forward_kinematics(BODY22, body.offsets_m, pelvis, local)
    return {"body22_m": body22, "body22_world_unitquat": world}


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
        **_bodies(np.concatenate(worlds)),
    }
    rest = {"take_id": [take_id] * 2, "person": np.arange(2), "body22_rest_m": np.stack([REFERENCE_REST_M] * 2)}
    facts = {"kind": "take", "take_id": take_id, "takes": [take_id], "rate_hz": rate_hz, "is_held_out": is_held_out}
    facts |= {"num_persons": 2, "num_frames": frames}
    return put_artifact(store, "ingest", take_id, {"poses": columns, "takes": random_columns("takes", 2) | rest}, facts)
