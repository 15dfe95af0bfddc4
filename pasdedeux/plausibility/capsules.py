"""Bodies as capsules round the bones: radii, distances in closed form, penetration within and between people.

Penetration is eta of lift eq. 2 (Yin et al. 2018): the sum of the penetration depths over pairs of bones.  The paper
asks a physics engine; here the distance of two segments is a formula, and the compiled form skips pairs far apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import Skeleton

__all__ = [
    "RADIUS_PER_HEIGHT",
    "CapsuleModel",
    "Penetration",
    "body_height_m",
    "capsule_model",
    "penetration",
    "segment_distance",
]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEG_PER_HEIGHT = 0.491
"""Length of thigh and shank together, as a share of the stature (Drillis and Contini 1966: 0.245 + 0.246)."""

_TRUNK, _HIP, _GIRDLE, _NECK, _HEAD = 0.052, 0.040, 0.030, 0.030, 0.040
_UPPER_ARM, _FOREARM, _THIGH, _SHANK, _FOOT = 0.025, 0.020, 0.040, 0.026, 0.018

_TRUNK_BONES = dict.fromkeys(("spine", "chest", "spine1", "spine2", "spine3"), _TRUNK)
_SIDED = {
    "collar": _GIRDLE,
    "shoulder": _GIRDLE,
    "elbow": _UPPER_ARM,
    "wrist": _FOREARM,
    "hip": _HIP,
    "knee": _THIGH,
    "ankle": _SHANK,
    "toe": _FOOT,
}

RADIUS_PER_HEIGHT: Mapping[str, float] = {
    **_TRUNK_BONES,
    "neck": _NECK,
    "head": _HEAD,
    **{f"{side}_{bone}": radius for side in ("left", "right") for bone, radius in _SIDED.items()},
}
"""Radius of the capsule round each bone, named by its child joint, as a share of the stature.

About four fifths of the half depth of the trunk and of girth / 2 pi of the limbs of an adult (a median man at 1.75 m:
half depth of the chest 0.115, girth of upper arm 0.33, forearm 0.27, mid thigh 0.55, calf 0.38 m): limbs taper, and
flesh gives way by a centimetre or two before bodies penetrate.
"""


@dataclass(frozen=True)
class CapsuleModel:
    """Which bones of a skeleton may touch, and how thick they are.

    Args:
        skeleton: The skeleton; a bone is named by its child joint.
        bones: Child joints of all bones, (bone,).
        parents: Parent of every joint, (J,), -1 for the root.
        radius_per_height: Radius of each joint's bone as a share of the stature, (J,); 0 for the root.
        within: Pairs of bones of one person that are checked, by child joint, (pair, 2): at least two bones lie
            between them and they do not overlap when the person stands.
        between: Pairs of bones of two people that are checked, all of them, (pair, 2), person A's first.
    """

    skeleton: Skeleton
    bones: Indices
    parents: Indices
    radius_per_height: Array
    within: Indices
    between: Indices

    def radii_m(self, height_m: Array | float) -> Array:
        """Return radii (*batch, J) in metres of people of stature (*batch,)."""
        return np.asarray(height_m, dtype=np.float64)[..., None] * self.radius_per_height

    def radii_of(self, positions: Array) -> Array:
        """Return radii (person, J) of people seen in poses (*batch, person, J, 3): from their median leg lengths."""
        lengths = bone_lengths(self.skeleton, positions)
        typical = np.median(lengths.reshape(-1, *lengths.shape[-2:]), axis=0)
        return self.radii_m(body_height_m(self.skeleton, typical))


@dataclass(frozen=True)
class Penetration:
    """Sums of penetration depths, metres: within each person (*batch, person=2), and between them (*batch,)."""

    within_m: Array
    between_m: Array

    @property
    def total_m(self) -> Array:
        """Everything together, (*batch,): eta of lift eq. 2."""
        return np.asarray(self.within_m.sum(axis=-1) + self.between_m)


def body_height_m(skeleton: Skeleton, bone_lengths_m: Array) -> Array:
    """Return the stature (*batch,) of people with these bone lengths (*batch, J), from their legs, metres."""
    legs = skeleton.indices(("left_knee", "left_ankle", "right_knee", "right_ankle"))
    return np.asarray(bone_lengths_m[..., legs].sum(axis=-1) / (2.0 * LEG_PER_HEIGHT))


def segment_distance(start_a: Array, end_a: Array, start_b: Array, end_b: Array) -> Array:
    """Return the distance (*batch,) between segments a and b, all ends (*batch, 3); a segment may be a point.

    Closest points as in Ericson (2004), "Real-Time Collision Detection", section 5.1.9: the parameter on one segment is
    solved, clamped, and the other follows.
    """
    a, b, gap = end_a - start_a, end_b - start_b, start_a - start_b
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    ag, bg = (a * gap).sum(-1), (b * gap).sum(-1)
    tiny = 1e-18
    determinant = aa * bb - ab * ab
    # Parallel segments: any s does, 0 is taken.
    is_skew = determinant > 1e-12 * aa * bb + tiny
    s = np.where(is_skew, np.clip((ab * bg - ag * bb) / np.where(is_skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = np.where(bb > tiny, (ab * s + bg) / np.maximum(bb, tiny), 0.0)
    t_inside = np.clip(t, 0.0, 1.0)
    s = np.where((t != t_inside) | ~is_skew, np.clip((ab * t_inside - ag) / np.maximum(aa, tiny), 0.0, 1.0), s)
    s = np.where(aa > tiny, s, 0.0)
    return np.asarray(np.linalg.norm(gap + s[..., None] * a - t_inside[..., None] * b, axis=-1))


@lru_cache(maxsize=8)
def capsule_model(skeleton: Skeleton) -> CapsuleModel:
    """Return the default capsules of a skeleton whose joint names are those of pair17 or body22."""
    bones = [child for _, child in skeleton.bones]
    radii = np.array([RADIUS_PER_HEIGHT.get(name, 0.0) for name in skeleton.joint_names])
    stand = _standing(skeleton)
    within = []
    for position, one in enumerate(bones):
        for other in bones[position + 1 :]:
            ends = [stand[joint] for joint in (skeleton.parents[one], one, skeleton.parents[other], other)]
            is_apart = float(segment_distance(*ends)) > radii[one] + radii[other]
            if is_apart and _bones_between(skeleton, one, other) >= 2:
                within.append((one, other))
    return CapsuleModel(
        skeleton=skeleton,
        bones=np.array(bones, dtype=np.int64),
        parents=np.array(skeleton.parents, dtype=np.int64),
        radius_per_height=radii,
        within=np.array(within, dtype=np.int64).reshape(-1, 2),
        between=np.array([(one, other) for one in bones for other in bones], dtype=np.int64),
    )


def penetration(pair_m: Array, radii_m: Array, model: CapsuleModel) -> Penetration:
    """Return the penetration of pairs, plain form.

    Args:
        pair_m: Positions (*batch, person=2, J, 3), metres.
        radii_m: Radii of each person's bones, (person=2, J), metres.
        model: Which bones are checked.
    """
    within = np.stack(
        [
            _depths(
                pair_m[..., person, :, :],
                pair_m[..., person, :, :],
                radii_m[person],
                radii_m[person],
                model.within,
                model,
            )
            for person in range(2)
        ],
        axis=-1,
    )
    between = _depths(pair_m[..., 0, :, :], pair_m[..., 1, :, :], radii_m[0], radii_m[1], model.between, model)
    return Penetration(within_m=within, between_m=between)


def _depths(first: Array, second: Array, radii_a: Array, radii_b: Array, pairs: Indices, model: CapsuleModel) -> Array:
    one, other = pairs[:, 0], pairs[:, 1]
    distance = segment_distance(
        first[..., model.parents[one], :],
        first[..., one, :],
        second[..., model.parents[other], :],
        second[..., other, :],
    )
    return np.asarray(np.maximum(radii_a[one] + radii_b[other] - distance, 0.0).sum(axis=-1))


def _bones_between(skeleton: Skeleton, one: int, other: int) -> int:
    """Count the bones on the path between two bones: 0 when they share a joint."""

    def path(joint: int) -> list[int]:
        found = [joint]
        while skeleton.parents[found[-1]] >= 0:
            found.append(skeleton.parents[found[-1]])
        return found

    def steps(a: int, b: int) -> int:
        up_a, up_b = path(a), path(b)
        shared = next(joint for joint in up_a if joint in up_b)
        return up_a.index(shared) + up_b.index(shared)

    return min(steps(a, b) for a in (skeleton.parents[one], one) for b in (skeleton.parents[other], other))


def _standing(skeleton: Skeleton) -> Array:
    """A person of stature 1 who stands with the arms half out, joint positions after Drillis and Contini (1966)."""
    middle = {
        "pelvis": 0.56,
        "spine": 0.65,
        "chest": 0.75,
        "spine1": 0.61,
        "spine2": 0.68,
        "spine3": 0.75,
        "neck": 0.84,
        "head": 0.92,
    }
    sided = {
        "collar": (0.02, 0.80),
        "shoulder": (0.115, 0.818),
        "elbow": (0.246, 0.687),
        "wrist": (0.349, 0.584),
        "hip": (0.055, 0.530),
        "knee": (0.060, 0.285),
        "ankle": (0.060, 0.039),
        "toe": (0.060, 0.0),
    }
    place = {name: (0.0, height, 0.0) for name, height in middle.items()}
    for name, (out, height) in sided.items():
        forward = 0.1 if name == "toe" else 0.0
        place[f"left_{name}"], place[f"right_{name}"] = (out, height, forward), (-out, height, forward)
    return np.array([place[name] for name in skeleton.joint_names])
