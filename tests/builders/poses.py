"""Made-up poses of `pair17`, and pairs of people, with and without a camera."""

from __future__ import annotations

import numpy as np

from pasdedeux.cameras.frames import true_direction
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.cameras.virtual_video import frame_take, sample_views
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat, unitquat_from_rotvec, yaw_rotmat
from pasdedeux.sampling.annotations import AnnotatedPairs, shows_enough
from pasdedeux.sampling.parameters import NUM_JOINTS, NUM_PER_PERSON
from pasdedeux.skeletons import PAIR17

BASIS = proportions_torso_basis()


def standing() -> np.ndarray:
    """A person standing upright, facing +Z (left is +X), arms hanging."""
    place = {
        "pelvis": [0, 1, 0],
        "spine": [0, 1.15, 0],
        "chest": [0, 1.3, 0],
        "neck": [0, 1.5, 0],
        "head": [0, 1.65, 0.03],
        "left_shoulder": [0.18, 1.42, 0],
        "left_elbow": [0.23, 1.12, 0],
        "left_wrist": [0.25, 0.87, 0.05],
        "left_hip": [0.1, 0.92, 0],
        "left_knee": [0.1, 0.5, 0.02],
        "left_ankle": [0.1, 0.08, 0],
    }
    pose = np.zeros((17, 3))
    for joint, index in zip(PAIR17.joint_names, range(17), strict=True):
        source = joint.replace("right_", "left_")
        pose[index] = np.array(place[source]) * ([-1, 1, 1] if joint.startswith("right_") else [1, 1, 1])
    return pose


def put(pose: np.ndarray, joint: str, direction: list[float]) -> np.ndarray:
    """Point the bone that ends in `joint` elsewhere, carrying nothing along."""
    moved = pose.copy()
    index = PAIR17.index(joint)
    parent = PAIR17.parents[index]
    length = np.linalg.norm(pose[index] - pose[parent])
    moved[index] = moved[parent] + length * normalise(np.array(direction, dtype=float))
    return moved


def wild(seed: int, count: int) -> np.ndarray:
    """Poses whose bones point anywhere near their standing direction, or quite anywhere."""
    rng = np.random.default_rng(seed)
    rest = standing()
    scale = rng.choice([0.1, 0.5, 2.0], size=(count, 1, 1))
    poses = np.zeros((count, 17, 3))
    for parent, child in ((PAIR17.parents[j], j) for j in PAIR17.order[1:]):
        bone = rest[child] - rest[parent]
        noise = rng.normal(size=(count, 3)) * scale[:, 0] * np.linalg.norm(bone)
        poses[:, child] = poses[:, parent] + normalise(bone + noise) * np.linalg.norm(bone)
    turn = rotmat_from_unitquat(normalise(rng.normal(size=(count, 4))))
    return np.einsum("nij,nkj->nki", turn, poses) + rng.normal(size=(count, 1, 3))


def random_pairs(seed: int, count: int) -> np.ndarray:
    first, second = wild(seed, count), wild(seed + 1, count)
    first -= first[:, :1]
    second -= second[:, :1]
    return np.stack([first, second + np.random.default_rng(seed).normal(scale=0.2, size=(count, 1, 3))], axis=1)


def dancers(seed: int, count: int) -> np.ndarray:
    """Standing people 0.4 to 1 m apart, turned any way, leaning by about 10 degrees."""
    rng = np.random.default_rng(seed)
    pose = standing() - [0, 1, 0]
    lean = rotmat_from_unitquat(unitquat_from_rotvec(rng.normal(scale=0.15, size=(count, 2, 3)) * [1, 0, 1]))
    turn = yaw_rotmat(rng.uniform(-np.pi, np.pi, size=(count, 2))) @ lean
    pairs = np.einsum("npij,kj->npki", turn, pose)
    angle, gap = rng.uniform(-np.pi, np.pi, size=count), rng.uniform(0.4, 1.0, size=count)
    pairs[:, 1] += np.stack([gap * np.sin(angle), 0 * gap, gap * np.cos(angle)], axis=-1)[:, None]
    return pairs + np.array([0, 1, 0])


def filmed(pairs: np.ndarray, seed: int, distance_m: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2, 17, 2) and true views (n, 3) from random cameras."""
    yaws, pitches = sample_views(np.random.default_rng(seed), len(pairs))
    px, truth = [], []
    for pair, yaw, pitch in zip(pairs, yaws, pitches, strict=True):
        view = frame_take(pair, pair[:, 0], distance_m=distance_m, yaw_rad=yaw, pitch_rad=pitch)
        px.append(view.camera.project(pair).px)
        truth.append(true_direction(pair, view.camera))
    return np.array(px), np.array(truth)


def direction_of_angles(psi_rad: np.ndarray, phi_rad: np.ndarray) -> np.ndarray:
    """Return views (n, 3) of (psi, phi), lift eq. 4: the inverse of `angles_of_direction`."""
    psi, phi = np.broadcast_arrays(psi_rad, phi_rad)
    return np.stack([np.sin(phi) * np.cos(psi), np.cos(phi), np.sin(phi) * np.sin(psi)], axis=-1)


def block_indices(block: int) -> np.ndarray:
    """Return the parameters of a block of a pair."""
    person, joint = divmod(block, NUM_JOINTS)
    start = NUM_PER_PERSON * person
    return np.arange(start, start + 6) if joint == 0 else np.arange(start + 3 + 3 * joint, start + 6 + 3 * joint)


def with_hidden(rng: np.random.Generator, pairs: AnnotatedPairs, share: float) -> AnnotatedPairs:
    """Return the annotations that still show enough with a share of all joints hidden."""
    points = np.where(rng.random((*pairs.points_m.shape[:3], 1)) < share, np.nan, pairs.points_m)
    enough = shows_enough(points)
    return AnnotatedPairs(points[enough], pairs.directions[enough], pairs.annotation_index[enough])
