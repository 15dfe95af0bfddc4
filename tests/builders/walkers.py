"""Made-up op14 motion for tests: a walker with swinging limbs, different on both sides so that mirroring shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import multiply, unitquat_from_rotvec
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, mid_hip
from pasdedeux.reconstruction.bones import place_bone_rotations
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14

Array = npt.NDArray[np.float64]


def walk(num_frames: int, *, seed: int = 0, rate_hz: float = 24.0, turn_rad: float = 1.5) -> Array:
    """Positions (frame, 14, 3), metres: arms down and swinging, the left arm raised at times, knees that bend."""
    rng = np.random.default_rng(seed)
    time = np.arange(num_frames) / rate_hz
    phase = 2 * np.pi * 0.9 * time + rng.uniform(0, 2 * np.pi)
    swing = 0.5 + 0.2 * rng.uniform(-1, 1)
    rotvec = np.zeros((num_frames, 14, 3))
    joint = OP14.index
    rotvec[:, joint("left_elbow"), 2] = -1.3 + 1.1 * np.sin(0.7 * time + rng.uniform(0, 6)) ** 2
    rotvec[:, joint("right_elbow"), 2] = 1.3
    rotvec[:, joint("left_elbow"), 1] = 0.4 * swing * np.sin(phase)
    rotvec[:, joint("right_elbow"), 1] = 0.9 * swing * np.sin(phase)
    rotvec[:, joint("left_wrist"), 1] = -0.5 - 0.4 * np.sin(phase)
    rotvec[:, joint("right_wrist"), 1] = 0.9 + 0.3 * np.sin(1.3 * phase)
    rotvec[:, joint("left_knee"), 0] = -swing * np.sin(phase)
    rotvec[:, joint("right_knee"), 0] = swing * np.sin(phase)
    rotvec[:, joint("left_ankle"), 0] = 0.5 - 0.45 * np.cos(phase)
    rotvec[:, joint("right_ankle"), 0] = 0.5 + 0.45 * np.cos(phase)
    heading = np.zeros((num_frames, 3))
    heading[:, 1] = turn_rad * time / max(time[-1], 1e-9) if num_frames > 1 else 0.0
    lean = np.zeros((num_frames, 3))
    lean[:, 0] = 0.1 + 0.05 * np.sin(phase)
    unitquat = unitquat_from_rotvec(rotvec)
    unitquat[:, OP14.root] = multiply(unitquat_from_rotvec(heading), unitquat_from_rotvec(lean))
    root = np.stack([0.3 * np.sin(0.5 * time), 0.92 + 0.02 * np.cos(2 * phase), 0.4 * time], axis=-1)
    return place_bone_rotations(unitquat, REFERENCE_LENGTHS_M, root)


def database_of(motions: Sequence[np.ndarray], **facts: Any) -> Database:
    """Return a database of motions (frame, 14, 3), one after the other."""
    poses = np.concatenate([centre_and_face(motion).poses_m for motion in motions]).astype(np.float32)
    starts = np.cumsum([0, *map(len, motions[:-1])])
    return Database(poses, np.isin(np.arange(len(poses)), starts), **facts)


def random_poses(rng: np.random.Generator, count: int, *, spread: float = 0.5) -> Array:
    """Positions (count, 14, 3) of unrelated poses about the T-pose, mid-hip at the origin."""
    unitquat = unitquat_from_rotvec(rng.normal(0, spread, (count, 14, 3)))
    return place_bone_rotations(unitquat, REFERENCE_LENGTHS_M, np.zeros((count, 3)))


CAMERAS: list[DatabaseCamera] = [DatabaseCamera(), DatabaseCamera(0.35)]


def walk_database(seed: int, camera: DatabaseCamera, *, num_frames: int = 20, num_yaws: int = 30) -> Database:
    """Return a database of a walk, of five unrelated poses, and of the same walk again."""
    steps, others = walk(num_frames, seed=seed), random_poses(np.random.default_rng(seed), 5)
    poses = centre_and_face(np.concatenate([steps, others, steps])).poses_m.astype(np.float32)
    return Database(poses, np.zeros(len(poses), dtype=bool), num_yaws=num_yaws, camera=camera)


def reconstruction(
    positions: np.ndarray, *, num_bridged: int = 0, rate_hz: float = 30.0, person_id: int = 0, first_frame: int = 0
) -> ReconstructedTrack:
    """A reconstruction of these poses (frame, 14, 3), matched to the rows of the same number."""
    frames = len(positions)
    lens = Lens(1.0, (0.0, 0.0))
    seen = np.ones((frames, 14))
    is_bridged = np.arange(frames) < num_bridged
    return ReconstructedTrack(
        track=Track(np.zeros((frames, 14, 2)), seen, rate_hz, lens, person_id, first_frame),
        positions_m=positions,
        root_m=mid_hip(positions),
        yaw_rad=np.zeros(frames),
        score_m=np.zeros(frames),
        row=np.where(is_bridged, -1, np.arange(frames)),
        is_bridged=is_bridged,
        metres_per_pixel=np.ones(frames),
        correction_m=np.zeros(frames),
        noise_m=0.0,
    )
