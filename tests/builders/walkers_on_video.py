"""OpenPose files of two walkers and a store with a projection database, for the command `reconstruct`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.projections.retarget import centre_and_face, mid_hip
from pasdedeux.reconstruction.body import body_through, pose_body
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import Store
from tasks.projections import ProjectionsParameters
from tests.builders.storage_rows import put
from tests.builders.walkers import walk

LAYOUT = KEYPOINT_LAYOUTS["coco18"]
FRAMES = 40


def openpose(points: np.ndarray) -> str:
    """One frame of people (person, 14, 2) as OpenPose writes COCO-18; joints that op14 lacks are not detected."""
    people = []
    for person in points:
        values = np.zeros((18, 3))
        for name, point in zip(OP14.joint_names, person, strict=True):
            name = {"head": "nose"}.get(name, name)
            values[LAYOUT.keypoint_names.index(name)] = [*point, 0.9]
        people.append({"person_id": [-1], "pose_keypoints_2d": values.reshape(-1).tolist()})
    return json.dumps({"version": 1.3, "people": people})


def walkers(num_frames: int) -> np.ndarray:
    walkers = [walk(num_frames, seed=50 + i, rate_hz=30.0) + np.array([1.4 * i, 0.0, 0.0]) for i in (0, 1)]
    return np.stack(walkers, axis=1)


def camera_of(yaw_rad: float, num_frames: int = FRAMES) -> PinholeCamera:
    """Return the camera that sees the walkers from a side."""
    middle = mid_hip(walkers(num_frames)).mean(axis=(0, 1))
    return look_at_camera(middle, distance_m=5.0, yaw_rad=yaw_rad, pitch_rad=0.1, focal_px=1400.0)


def write_walkers(folder: Path, num_frames: int = FRAMES, *, yaw_rad: float = 0.3) -> Path:
    """Write OpenPose files of two walkers, listed in changing order, seen from a side."""
    for frame, points in enumerate(camera_of(yaw_rad, num_frames).project(walkers(num_frames)).px):
        listed = points[::-1] if frame % 2 else points
        (folder / f"film_{frame:012d}_keypoints.json").write_text(openpose(listed))
    return folder


def build_store(folder: Path) -> Store:
    """Return a store with one projections artifact."""
    poses = np.concatenate([centre_and_face(walk(72, seed=seed)).poses_m for seed in range(4)])
    count = len(poses)
    built = Store(folder)
    tables = {
        "projections": {
            "origin": ["take"] * count,
            "take_id": ["walk"] * count,
            "person": np.zeros(count, dtype=int),
            "frame": np.arange(count),
            "is_sequence_start": np.arange(count) % 72 == 0,
            "op14_m": poses,
            "op14_unitquat": bone_rotations(poses),
            "body22_unitquat": pose_body(body_through(poses), poses)[1],
            "heading_rad": np.zeros(count),
            "root_translation_m": np.zeros((count, 3)),
            "joint_radius_m": np.hypot(poses[..., 0], poses[..., 2]),
        }
    }
    facts = {
        "kind": "projections",
        "takes": ["walk"],
        "rate_hz": 24.0,
        "pitches_deg": ProjectionsParameters().pitches_deg,
    }
    put(built, "projections", "walk", tables, facts)
    return built


def reference(store: Store) -> list[str]:
    (manifest,) = store.artifacts("projections")
    return ["--store", str(store.root), "--database", f"projections@{manifest.ref.key[:16]}"]
