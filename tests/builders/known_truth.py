"""Takes, virtual video of them and what was lifted from it, of which the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pasdedeux.kinematics.rotations import yaw_rotmat
from storage_schema import Manifest, Store
from tests.builders.storage_rows import put, random_columns, take_rows

FRAMES, RATE_HZ = 11, 20.0
TURNS = {"film seen": yaw_rotmat(0.6), "film hidden": yaw_rotmat(-1.1)}
"""Axes of the camera of each sequence, from those of the world."""


def pairs_of(number: int, num_joints: int = 17) -> np.ndarray:
    """Return people of a take (frame, 2, joint, 3) of which no two joints, people or frames are alike, metres."""
    generator = np.random.default_rng(number)
    still = generator.normal(0.0, 0.4, (2, num_joints, 3)) + np.array([[[0.0, 1.0, 0.0]], [[0.7, 1.0, 0.3]]])
    return still + np.linspace(0.0, 0.5, FRAMES)[:, None, None, None] * generator.normal(size=(2, num_joints, 3))


def put_truth(store: Store, skeleton: str = "pair17_m") -> tuple[list[Manifest], list[Manifest], dict[str, np.ndarray]]:
    """Commit two takes, one of them held out, and virtual video of each that begins at its second frame."""
    takes, videos, poses = [], [], {}
    for number, take_id in enumerate(("seen", "hidden")):
        people = pairs_of(number, {"pair17_m": 17, "op14_m": 14, "body22_m": 22}[skeleton])
        poses[take_id] = people.astype(np.float32).astype(np.float64)
        by_person = {skeleton: people.swapaxes(0, 1).reshape(-1, *people.shape[2:])}
        rows, facts = take_rows(take_id, 2, FRAMES, rate_hz=RATE_HZ, is_held_out=take_id == "hidden", **by_person)
        takes.append(put(store, "ingest", take_id, {"poses": rows}, facts))
        name, count = f"film {take_id}", 2 * (FRAMES - 1)
        frame = np.repeat(np.arange(FRAMES - 1), 2)
        seen = random_columns("annotations", count) | {
            "sequence_id": [name] * count,
            "frame": frame,
            "person_id": np.tile([0, 1], FRAMES - 1),
            "partner_id": np.tile([1, 0], FRAMES - 1),
            "is_key": [True] * count,
            "is_held_out": [False] * count,
            "take_id": [take_id] * count,
            "take_frame": frame + 1,
            "op14_px": np.arange(count * 28.0).reshape(count, 14, 2),
            "pair17_px": np.arange(count * 34.0).reshape(count, 17, 2),
            "pair17_confidence": np.ones((count, 17)),
            "image_width_px": [640] * count,
            "image_height_px": [480] * count,
            "focal_px": [500.0] * count,
        }
        camera = random_columns("cameras", 1) | {
            "sequence_id": [name],
            "focal_px": [500.0],
            "camera_from_world_rotmat": TURNS[name][None],
            "camera_position_m": np.array([[0.0, 1.0, 4.0]]),
            "image_width_px": [640],
            "image_height_px": [480],
        }
        facts = {"kind": "sequences", "sequence_ids": [name], "is_virtual": True, "takes": [take_id]}
        facts |= {"num_persons": 2, "num_frames": FRAMES - 1, "rate_hz": RATE_HZ, "is_held_out": take_id == "hidden"}
        videos.append(put(store, "ingest", name, {"annotations": seen, "cameras": camera}, facts, (takes[-1],)))
    return takes, videos, poses


def put_lifted(
    store: Store,
    name: str,
    rows: Sequence[Mapping[str, Any]],
    *,
    table: str = "lifted_pairs",
    inputs: tuple[Manifest, ...] = (),
    **more: Any,
) -> Manifest:
    columns = random_columns(table, len(rows)) | {key: [row[key] for row in rows] for key in rows[0]}
    columns["pair17_m"] = np.array(columns["pair17_m"])
    facts = {"kind": "lifted_pairs", "sequence_ids": [name], "purpose": None, "is_held_out": False, "num_draws": 1}
    facts |= {"num_lifted": 1, "learned_takes": []} | more
    return put(store, "lifting", f"{name} {table}", {table: columns}, facts, inputs)


def put_motions(
    store: Store,
    name: str,
    motions_m: Mapping[str, np.ndarray],
    *,
    person_ids: Sequence[int] = (0, 1),
    inputs: tuple[Manifest, ...] = (),
    **facts: Any,
) -> Manifest:
    """Commit people (frame, person, 14, 3) as each method reconstructed them from a film of the held-out take."""
    num_frames = len(next(iter(motions_m.values())))
    frame = np.tile(np.repeat(np.arange(num_frames), len(person_ids)), len(motions_m))
    columns = random_columns("motions", len(frame)) | {
        "sequence_id": [name] * len(frame),
        "method": np.repeat(list(motions_m), num_frames * len(person_ids)).tolist(),
        "person_id": np.tile(person_ids, num_frames * len(motions_m)),
        "frame": frame,
        "time_s": frame / RATE_HZ,
        "op14_m": np.concatenate([motion_m.reshape(-1, 14, 3) for motion_m in motions_m.values()]),
        "is_bridged": [False] * len(frame),
    }
    facts = {"kind": "motions", "sequence_ids": [name], "sequence_takes": ["hidden"]} | facts
    return put(store, "reconstruction", name, {"motions": columns}, facts, inputs)


def lifted_row(
    poses: Mapping[str, np.ndarray], take_id: str, frame: int, method: str, apart_m: float
) -> dict[str, Any]:
    """Return a row whose pair is the true one in the camera's axes, but for B, who is so much farther away."""
    pair_m = poses[take_id][frame + 1] @ TURNS[f"film {take_id}"].T
    pair_m[1, :, 2] += apart_m
    place = {"sequence_id": f"film {take_id}", "frame": frame, "person_id": 0, "partner_id": 1}
    expected = {"expected_error_m": None, "expected_low_m": None, "expected_high_m": None}
    return place | {"method": method, "pair17_m": np.add(pair_m, [3.0, -1.0, 2.0])} | expected
