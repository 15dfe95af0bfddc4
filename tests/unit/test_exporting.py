"""What is taken out of the store stands as a person expects it."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports import export_reference
from pasdedeux.formats import read_bvh
from pasdedeux.kinematics import Motion
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.reconstruction.body import EmbodiedMotion, body_through, hold_hips, pose_body
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from storage_schema import Store
from tests.builders.storage_rows import random_columns
from tests.builders.walkers import reconstruction, walk


def exported(
    tmp_path: Path, columns: dict[str, Any], facts: dict[str, Any], *, table: str = "motions"
) -> dict[str, Motion]:
    """Return the motions of the BVH files that a table becomes, by the name of their file."""
    store = Store(tmp_path / "store")
    ref = store.commit(
        stage="reconstruction",
        key="a" * 64,
        partition="walk",
        name="walk",
        version=1,
        parameters={},
        seed=0,
        inputs=[],
        files=[],
        tables={table: columns},
        facts=facts,
    )
    export_reference(store, f"{table}@{ref.key[:8]}", "bvh", tmp_path / "out")
    return {
        path.stem: read_bvh(path.read_bytes()).to_motion(metres_per_unit=0.01, rate_hz=30.0, up_axis="y")
        for path in (tmp_path / "out").glob("*.bvh")
    }


def body_of_walk(frames: int, size: float = 1.0) -> EmbodiedMotion:
    poses = size * hold_hips(reconstruction(walk(frames))).positions_m
    body = body_through(poses)
    return EmbodiedMotion(body, *pose_body(body, poses))


def rows_of(frame: np.ndarray, body: EmbodiedMotion, sequence_id: str, person_id: int, method: str) -> dict[str, Any]:
    count = len(frame)
    return random_columns("motions", count) | {
        "sequence_id": [sequence_id] * count,
        "method": [method] * count,
        "person_id": np.full(count, person_id),
        "frame": frame,
        "time_s": frame / 30.0,
        "body22_m": body.motion(30.0).world()[0],
        "body22_unitquat": body.unitquat,
    }


def joined(*parts: dict[str, Any]) -> dict[str, Any]:
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if isinstance(parts[0][name], list)
        else np.concatenate([part[name] for part in parts])
        for name in parts[0]
    }


def test_people_of_a_video_have_the_same_frames_and_one_floor(tmp_path: Path) -> None:
    tall, small = body_of_walk(8, 1.1), body_of_walk(5, 0.8)
    columns = joined(
        rows_of(np.arange(3, 11), tall, "walk", 0, "fit"), rows_of(np.arange(6, 11), small, "walk", 1, "fit")
    )
    found = exported(tmp_path, columns, {"pitch_deg": 0.0})
    first, second = found["walk_0_fit"], found["walk_1_fit"]
    assert (first.num_frames, second.num_frames) == (8, 8)
    rise = np.mean([tall.body.ankle_height_m, small.body.ankle_height_m])
    for motion, body, at in ((first, tall, 0), (second, small, 3)):
        rises = motion.root_translation_m[at:] - body.pelvis_m
        np.testing.assert_allclose(rises, np.broadcast_to([0.0, rise, 0.0], rises.shape), atol=1e-5)
    np.testing.assert_allclose(second.root_translation_m[:3], second.root_translation_m[[3, 3, 3]], atol=1e-9)


def test_variants_whose_names_join_to_the_same_are_not_mixed(tmp_path: Path) -> None:
    joints = body_of_walk(8).motion(30.0).world()[0]
    columns = random_columns("variants", 8) | {
        "take_id": ["a"] * 3 + ["a_b"] * 5,
        "variant_id": ["b_c"] * 3 + ["c"] * 5,
        "frame": np.concatenate([np.arange(3), np.arange(5)]),
        "time_s": np.concatenate([np.arange(3), np.arange(5)]) / 30.0,
        "body22_m": np.stack([joints, joints], axis=1),
    }
    found = exported(tmp_path, columns, {}, table="variants")
    assert {name: motion.num_frames for name, motion in found.items()} == {
        **dict.fromkeys(("a_b_c_A", "a_b_c_B"), 3),
        **dict.fromkeys(("a_b_c_A.2", "a_b_c_B.2"), 5),
    }


def test_a_reconstructed_motion_stands_upright_though_its_camera_looked_down(tmp_path: Path) -> None:
    camera, whole = OrthographicCamera(float(np.deg2rad(30.0))), body_of_walk(3)
    columns = rows_of(np.arange(3), whole.turned(camera.camera_from_upright_rotmat), "walk", 0, "fit")
    motion = exported(tmp_path, columns, {"pitch_deg": 30.0})["walk_0_fit"]
    at = [motion.skeleton.joint_names.index(HUMANOID_NAMES[joint].mixamo) for joint in BODY22.joint_names]
    soles = whole.motion(30.0).world()[0] + [0.0, whole.body.ankle_height_m, 0.0]
    np.testing.assert_allclose(motion.world()[0][:, at], soles, atol=1e-5)
