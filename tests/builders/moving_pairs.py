"""Two invented people who hold hands and sway, for tests that need a pair in motion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics import place_bones
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.skeletons import BODY22

_MIDDLE = {"spine1": 0.10, "spine2": 0.12, "spine3": 0.13, "neck": 0.22, "head": 0.14}


def standing_person() -> npt.NDArray[np.float64]:
    """Return a person (22, 3) who stands on the floor, faces +Z and holds both arms out in front, metres."""
    place = {"pelvis": np.array([0.0, 0.95, 0.0])}
    height = 0.95
    for name, step in _MIDDLE.items():
        height += step
        place[name] = np.array([0.0, height, 0.01])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        place[f"{side}_hip"] = np.array([0.09 * sign, 0.88, 0.0])
        place[f"{side}_knee"] = np.array([0.10 * sign, 0.48, 0.03])
        place[f"{side}_ankle"] = np.array([0.10 * sign, 0.08, 0.0])
        place[f"{side}_toe"] = np.array([0.11 * sign, 0.02, 0.14])
        place[f"{side}_collar"] = np.array([0.05 * sign, 1.45, 0.01])
        place[f"{side}_shoulder"] = np.array([0.18 * sign, 1.47, 0.0])
        place[f"{side}_elbow"] = np.array([0.22 * sign, 1.22, 0.12])
        place[f"{side}_wrist"] = np.array([0.14 * sign, 1.20, 0.36])
    return np.stack([place[name] for name in BODY22.joint_names])


def swaying_pair(num_frames: int = 24, *, apart_m: float = 0.72, seed: int = 0) -> npt.NDArray[np.float64]:
    """Return a pair (frame, 2, 22, 3) that sways on planted feet, B facing A, bone lengths constant, metres."""
    return swaying_people(2, num_frames, apart_m=apart_m, seed=seed)


def swaying_people(
    count: int, num_frames: int = 24, *, apart_m: float = 0.72, seed: int = 0
) -> npt.NDArray[np.float64]:
    """Return people (frame, person, 22, 3) who sway as a pair does; from the third on each stands behind the other."""
    generator = np.random.default_rng(seed)
    phase = np.linspace(0.0, 2.0 * np.pi * num_frames / 60.0, num_frames)
    people = []
    for size in 1.0 - 0.06 * np.arange(count):
        # Nobody is quite symmetric, and Delaunay tetrahedra of cospherical joints are decided by rounding.
        rest = standing_person() * size + generator.normal(0.0, 0.005, (BODY22.num_joints, 3))
        offsets = rest - rest[[max(parent, 0) for parent in BODY22.parents]]
        lengths = np.linalg.norm(offsets, axis=-1)
        sway = generator.normal(0.0, 0.12, (BODY22.num_joints, 3))
        lean = np.where(np.isin(range(22), BODY22.indices(["left_hip", "right_hip"])), 0.0, 1.0)[:, None]
        directions = offsets + 0.5 * lengths[:, None] * (lean * sway) * np.sin(phase)[:, None, None]
        for foot in ("left", "right"):
            legs = BODY22.indices([f"{foot}_knee", f"{foot}_ankle", f"{foot}_toe"])
            directions[:, legs] = offsets[legs]
        directions /= np.where(lengths > 0, np.linalg.norm(directions, axis=-1), 1.0)[..., None]
        root = np.repeat(rest[None, BODY22.root], num_frames, axis=0)
        people.append(place_bones(BODY22, root, directions, lengths))
    for person in range(1, count):
        people[person] = people[person] @ yaw_rotmat(np.pi).T + np.array([0.0, 0.0, person * apart_m])
    return np.stack(people, axis=1)
