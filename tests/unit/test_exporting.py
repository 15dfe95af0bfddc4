"""What is taken out of the store stands as a person expects it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flows.exports import export_reference
from pasdedeux.formats import read_bvh
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.reconstruction.body import EmbodiedMotion, body_through, hold_hips, pose_body
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from storage_schema import Store
from tests.builders.storage_rows import random_columns
from tests.builders.walkers import reconstruction, walk


def test_a_reconstructed_motion_stands_upright_though_its_camera_looked_down(tmp_path: Path) -> None:
    frames, camera = 3, OrthographicCamera(float(np.deg2rad(30.0)))
    poses = hold_hips(reconstruction(walk(frames))).positions_m
    body = body_through(poses)
    whole = EmbodiedMotion(body, *pose_body(body, poses))
    seen = whole.turned(camera.camera_from_upright_rotmat)
    columns = random_columns("motions", frames) | {
        "sequence_id": ["walk"] * frames,
        "method": ["fit"] * frames,
        "person_id": np.zeros(frames, dtype=int),
        "time_s": np.arange(frames) / 30.0,
        "body22_m": seen.motion(30.0).world()[0],
        "body22_unitquat": seen.unitquat,
    }
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
        tables={"motions": columns},
        facts={"pitch_deg": 30.0},
    )
    export_reference(store, f"motions@{ref.key[:8]}", "bvh", tmp_path / "out")
    source = read_bvh((tmp_path / "out" / "walk_0_fit.bvh").read_bytes())
    motion = source.to_motion(metres_per_unit=0.01, rate_hz=30.0, up_axis="y")
    at = [motion.skeleton.joint_names.index(HUMANOID_NAMES[joint].mixamo) for joint in BODY22.joint_names]
    np.testing.assert_allclose(motion.world()[0][:, at], whole.standing().motion(30.0).world()[0], atol=1e-5)
