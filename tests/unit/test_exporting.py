"""What is taken out of the store stands as a person expects it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flows.exports import export_reference
from pasdedeux.formats import read_bvh
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.skeletons import OP14
from storage_schema import Store
from tests.builders.storage_rows import random_columns


def _standing(frames: int) -> np.ndarray:
    pose = np.zeros((14, 3))
    pose[OP14.index("head"), 1], pose[OP14.index("neck"), 1] = 1.7, 1.5
    heights = {"shoulder": 1.4, "elbow": 1.2, "wrist": 1.0, "hip": 0.9, "knee": 0.5, "ankle": 0.1}
    for side, x in (("right", -0.2), ("left", 0.2)):
        for joint, height in heights.items():
            pose[OP14.index(f"{side}_{joint}")] = [x, height, 0.0]
    return np.repeat(pose[None], frames, axis=0)


def test_a_reconstructed_motion_stands_upright_though_its_camera_looked_down(tmp_path: Path) -> None:
    frames, camera = 3, OrthographicCamera(float(np.deg2rad(30.0)))
    columns = random_columns("motions", frames) | {
        "sequence_id": ["walk"] * frames,
        "method": ["fit"] * frames,
        "person_id": np.zeros(frames, dtype=int),
        "time_s": np.arange(frames) / 30.0,
        "op14_m": _standing(frames) @ camera.camera_from_upright_rotmat.T,
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
    positions = motion.world()[0]
    head, ankle = (positions[:, motion.skeleton.joint_names.index(name)] for name in ("head", "left_ankle"))
    np.testing.assert_allclose(head - ankle, np.broadcast_to([-0.2, 1.6, 0.0], (frames, 3)), atol=1e-3)
