"""Takes of two people walking, in a store as the stage `ingest` would leave them."""

from __future__ import annotations

import numpy as np

from pasdedeux.kinematics import forward_kinematics
from pasdedeux.reconstruction.body import REFERENCE_REST_M, body_through, pose_body
from pasdedeux.skeletons import BODY22
from storage_schema import Manifest, Store
from tests.builders.storage_rows import put, random_columns, take_rows
from tests.builders.walkers import walk


def _bodies(positions: np.ndarray) -> dict[str, np.ndarray]:
    """The whole bodies of op14 positions, backs straight."""
    body = body_through(positions)
    pelvis, local = pose_body(body, positions)
    body22, world = forward_kinematics(BODY22, body.offsets_m, pelvis, local)
    return {"body22_m": body22, "body22_world_unitquat": world}


def put_take(
    store: Store, take_id: str, *, rate_hz: float = 30.0, is_held_out: bool = False, **more_facts: object
) -> Manifest:
    frames = 90
    worlds = [walk(frames, seed=sum(map(ord, take_id)) + person, rate_hz=rate_hz) for person in range(2)]
    joints = np.concatenate(worlds)
    columns, facts = take_rows(
        take_id, 2, frames, rate_hz=rate_hz, is_held_out=is_held_out, op14_m=joints, **_bodies(joints)
    )
    rest = {"take_id": [take_id] * 2, "person": np.arange(2), "body22_rest_m": np.stack([REFERENCE_REST_M] * 2)}
    return put(
        store, "ingest", take_id, {"poses": columns, "takes": random_columns("takes", 2) | rest}, facts | more_facts
    )
