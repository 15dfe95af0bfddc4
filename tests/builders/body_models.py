"""Made-up body models of the layout of SMPL, SMPL-H and SMPL-X, and parameters as data sets have them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from pasdedeux.formats.smpl import JOINTS
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import t_pose

NUM_BETAS = 4


def npz(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def parents_of(kind: str) -> list[int]:
    """Return the parents of the joints of a kind of model."""
    names = JOINTS[kind]
    above = {"pelvis": "", "spine1": "pelvis", "spine2": "spine1", "spine3": "spine2", "neck": "spine3", "head": "neck"}
    for side in ("left", "right"):
        for chain in (("pelvis", "hip", "knee", "ankle", "toe"), ("spine3", "collar", "shoulder", "elbow", "wrist")):
            before = chain[0]
            for part in chain[1:]:
                above[f"{side}_{part}"] = before
                before = f"{side}_{part}"
    parents = []
    for name in names:
        if name not in above:
            side, knuckle = name.partition("_")[0], name[-1]
            is_first = name.endswith("1") or not knuckle.isdigit()
            hand = "head" if name == "jaw" or name.endswith("eye") else f"{side}_wrist"
            above[name] = hand if is_first else f"{name[:-1]}{int(knuckle) - 1}"
        parents.append(names.index(above[name]) if above[name] else -1)
    return parents


def body_model(kind: str = "SMPL-H", **changed: Any) -> bytes:
    """Return a model whose joints are means of three vertices; betas: legs, arms, trunk and size, as no real one's."""
    names, parents, rng = JOINTS[kind], parents_of(kind), np.random.default_rng(3)
    places = np.zeros((len(names), 3))
    for joint, name in enumerate(names):
        is_of_body = name in BODY22.joint_names
        places[joint] = (
            1.7 * np.array(t_pose(name)) if is_of_body else places[parents[joint]] + rng.uniform(0.01, 0.03, 3)
        )
    places -= [0.0, 1.2, 0.0]
    vertices = np.repeat(places, 3, axis=0) + np.tile(rng.normal(0.0, 0.02, (3, 3)), (len(names), 1))
    shapes = np.zeros((len(vertices), 3, NUM_BETAS))
    groups = (("hip", "knee", "ankle", "toe"), ("shoulder", "elbow", "wrist"), ("spine", "neck"), tuple(names))
    for beta, parts in enumerate(groups):
        moved = np.zeros_like(places)
        for joint, parent in enumerate(parents):
            if parent >= 0:
                is_part = any(part in names[joint] for part in parts)
                moved[joint] = moved[parent] + (0.05 * (places[joint] - places[parent]) if is_part else 0.0)
        shapes[:, :, beta] = np.repeat(moved, 3, axis=0)
    regressor = np.kron(np.eye(len(names)), np.full((1, 3), 1 / 3))
    tree = np.array([[2**32 - 1, *parents[1:]], range(len(names))], dtype=np.uint32)
    arrays = {"J_regressor": regressor, "v_template": vertices, "shapedirs": shapes, "kintree_table": tree}
    # As the real ones have: objects, which only a pickle holds.
    others = {"part2num": np.array({"a": 1}, dtype=object), "f": np.zeros((1, 3), np.uint32)}
    return npz(**arrays | others | changed)


def amass(kind: str = "SMPL-H", *, num_frames: int = 12, seed: int = 0, is_z_up: bool = True, **changed: Any) -> bytes:
    """Return parameters of one person who stands, walks and waves, as AMASS has them."""
    rng, count = np.random.default_rng(seed), len(JOINTS[kind])
    poses = rng.normal(0.0, 0.12, (1, count, 3)) + 0.02 * rng.normal(size=(num_frames, count, 3)).cumsum(axis=0)
    poses[:, 0] = [np.pi / 2, 0.0, 0.0] if is_z_up else 0.0
    path = np.linspace([0.0, 0.0, 0.0], [0.3, 0.5, 0.0], num_frames)
    trans = path + np.array([0.0, 0.0, 1.2]) if is_z_up else path[:, [0, 2, 1]] + np.array([0.0, 1.2, 0.0])
    arrays = {
        "gender": np.array("neutral"),
        "betas": rng.normal(0.0, 1.0, NUM_BETAS),
        "mocap_framerate": np.array(30.0),
        "trans": trans,
        "poses": poses.reshape(num_frames, -1),
    }
    return npz(**{name: value for name, value in (arrays | changed).items() if value is not None})
