"""The shape of a body: round cones along its bones, and cones of head, hands, heels and flanks outside them.

Tapered limbs differ from their capsules by less than a centimetre.  Sizes of head, hands and heels are proportional to
the bone that ends there, those of flanks to the radius of the trunk, so that bodies of any size keep their proportions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import Skeleton

_TAPERS: Mapping[str, tuple[float, float]] = {
    "neck": (1.0, 0.85),
    "head": (0.85, 0.95),
    "hip": (1.0, 1.05),
    "knee": (1.1, 0.85),
    "ankle": (1.15, 0.8),
    "toe": (1.1, 0.9),
    "shoulder": (0.9, 1.0),
    "elbow": (1.12, 0.88),
    "wrist": (1.15, 0.8),
}
"""Radii at the start and the end of the bone that ends in a joint, in radii of its capsule; (1, 1) for the others."""
_THINNER_M, _THICKER_M = 0.009, 0.003
"""Largest decrease and increase of a capsule's radius."""
_FLANKS: Mapping[str, tuple[float, float]] = {
    "pelvis": (0.5, 0.9),
    "spine": (0.4, 0.85),
    "spine1": (0.4, 0.85),
    "spine2": (0.5, 0.85),
    "spine3": (0.75, 0.8),
    "chest": (0.75, 0.8),
    "neck": (0.3, 0.55),
}
"""Flanks, beside the bones of the trunk: offsets to the sides of a joint, and radii, in radii of the trunk."""
_HEAD = ((0.0, 0.45, 0.02, 0.62), (0.0, 0.75, -0.05, 0.62)), ((0.0, 0.1, 0.25, 0.42), (0.0, 0.35, 0.3, 0.45))
"""Skull and jaw: two ends each, left, up and forward of the head joint, and their radii, in lengths of neck to head."""
_HAND = (
    ((0.0, 0.0, 0.0, 0.07), (0.36, 0.0, 0.06, 0.065)),
    ((0.0, 0.0, 0.0, 0.07), (0.36, 0.0, -0.06, 0.065)),
    ((0.36, 0.0, 0.06, 0.065), (0.64, 0.0, 0.05, 0.055)),
    ((0.36, 0.0, -0.06, 0.065), (0.62, 0.0, -0.05, 0.055)),
    ((0.08, 0.0, 0.06, 0.055), (0.36, 0.0, 0.19, 0.05)),
)
"""Palm, fingers and thumb: two ends each, away from the elbow, up and forward of the wrist in a T-pose, and their
radii, in lengths of the forearm."""
_HEEL = ((0.0, -0.05, -0.05, 0.2), (0.0, -0.2, -0.25, 0.17))
"""Heel: two ends, left, up and forward of the ankle, and their radii, in lengths of ankle to toe."""


@dataclass(frozen=True)
class Cones:
    """Round cones: the space swept by a ball that moves from one end to the other while its radius changes.

    Args:
        ends_m: Ends (cone, 2, 3) in the rest pose, metres.
        radii_m: Radii at the ends (cone, 2), metres.
        joints: Joint with which each moves (cone,).
        is_beside: Whether two of them meet in a joint (cone, cone); each meets itself.
    """

    ends_m: Array
    radii_m: Array
    joints: Integers
    is_beside: Flags


def cones_of(skeleton: Skeleton, rest_m: Array, radii_m: Array) -> Cones:
    """Return the cones of a body in its rest pose.

    Args:
        skeleton: Its joints.
        rest_m: Positions of the joints in the rest pose (J, 3), metres.
        radii_m: Radius of the capsule around the bone that ends in each joint (J,), metres; 0 for none.
    """
    names = skeleton.joint_names
    axes = _axes(rest_m, {name: joint for joint, name in enumerate(names)})
    shapes: list[tuple[Array, Array, int, frozenset[int]]] = []  # ends, radii, joint, joints in which it meets others
    for parent, child in skeleton.bones:
        radius, meets = float(radii_m[child]), frozenset((parent, child))
        if radius > 0:
            taper = np.array(_TAPERS.get(names[child].rpartition("_")[2], (1.0, 1.0)))
            radii = radius + np.clip(radius * (taper - 1.0), -_THINNER_M, _THICKER_M)
            shapes.append((rest_m[[parent, child]], radii, parent, meets))
        if axes is None:
            continue
        if names[parent] in _FLANKS and names[child] in _FLANKS:
            shape = np.array([_FLANKS[names[parent]], _FLANKS[names[child]]])
            width = float(radii_m[[parent, child]].max())
            for side in (-1.0, 1.0):
                beside = rest_m[[parent, child]] + side * width * shape[:, :1] * axes[0]
                shapes.append((beside, width * shape[:, 1], parent, meets))
        joint, frame, parts = _outside(rest_m, parent, child, names[child], axes)
        length = float(np.linalg.norm(rest_m[child] - rest_m[parent]))
        for ends in length * np.array(parts):
            shapes.append((rest_m[joint] + ends[:, :3] @ frame, ends[:, 3], joint, frozenset((joint,))))
    return Cones(
        np.array([ends for ends, *_ in shapes]).reshape(-1, 2, 3),
        np.array([radii for _, radii, *_ in shapes]).reshape(-1, 2),
        np.array([joint for *_, joint, _ in shapes], dtype=np.int64),
        _beside(tuple(meets for *_, meets in shapes)).copy(),
    )


@lru_cache(maxsize=8)
def _beside(meets: tuple[frozenset[int], ...]) -> Flags:
    """Tell which cones meet in a joint (cone, cone); cached, because bodies on one skeleton share it."""
    return np.array([[bool(meet & other) for other in meets] for meet in meets]).reshape(len(meets), -1)


def _outside(rest_m: Array, parent: int, child: int, name: str, axes: Array) -> tuple[int, Array, Any]:
    """Return the parts outside the capsules at the end of a bone: their joint, axes (3, 3) and cones."""
    kind = name.rpartition("_")[2]
    if kind == "head":
        return child, axes, _HEAD
    if kind not in ("wrist", "toe"):
        return child, axes, ()
    bone = normalise(rest_m[child] - rest_m[parent], fallback=axes[1])
    if kind == "wrist":
        forward = normalise(axes[2] - bone * (axes[2] @ bone), fallback=axes[1])
        return child, np.stack([bone, np.cross(forward, bone), forward]), _HAND
    forward = normalise(bone - axes[1] * (bone @ axes[1]), fallback=axes[2])
    return parent, np.stack([np.cross(axes[1], forward), axes[1], forward]), (_HEEL,)


def _axes(rest_m: Array, joints: Mapping[str, int]) -> Array | None:
    """Return left, up and forward of a body in its rest pose (3, 3); None if its joints do not determine them."""
    sides = [(joints[name], joints[f"right_{name[5:]}"]) for name in joints if name.startswith("left_")]
    middle = [joints[name] for name in ("head", "neck") if name in joints]
    hips = [joints[name] for name in ("left_hip", "right_hip") if name in joints]
    if not (sides and middle and len(hips) == 2):
        return None
    up = normalise(rest_m[middle[0]] - rest_m[hips].mean(axis=0))
    left = np.sum([rest_m[left_joint] - rest_m[right_joint] for left_joint, right_joint in sides], axis=0)
    left = left - up * (left @ up)
    if not (np.isfinite(left).all() and np.linalg.norm(left) > 1e-6):
        return None
    left = normalise(left)
    return np.stack([left, up, np.cross(left, up)])
