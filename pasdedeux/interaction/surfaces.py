"""Distances of people's surfaces: a body is capsules round its bones, and a bone is named by its child joint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import closest_on_segments, dot, length, row_of, subtract
from pasdedeux.skeletons import Skeleton

Indices = npt.NDArray[np.int64]

_BESIDE_M = 0.005
"""If a next bone is closer by this, the weight of a pair of bones is 1/e."""
_AT_END = 0.2
"""Within this share of a bone from its end, a pair that is closest there gives way to the next bone."""


def closest_joint_distance(pair_m: Array) -> Array:
    """Return the distance (*batch,) of the closest joints of A and B of pairs (*batch, person=2, joint, 3), metres.

    NaN joints do not count.
    """
    difference = pair_m[..., 0, :, None, :] - pair_m[..., 1, None, :, :]
    return np.asarray(np.nanmin(np.linalg.norm(difference, axis=-1), axis=(-2, -1)))


def fade(value: Array, full: float, none: float) -> Array:
    """Return 1 up to `full`, 0 from `none` on, and a smooth step (3t^2 - 2t^3) between."""
    t = np.clip((none - value) / (none - full), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


@dataclass(frozen=True)
class Gaps:
    """Distances of the surfaces of two people, bone by bone; a bone is named by its child joint.

    Args:
        gap_m: (*batch, bone of A, bone of B), metres; negative where they pass through each other.
        share: Where on each of the two bones they are closest (*batch, bone of A, bone of B, 2): 0 at the parent
            joint, 1 at the child.
        bones: Child joints of the bones (bone,).
    """

    gap_m: Array
    share: Array
    bones: Indices

    @property
    def closest_m(self) -> Array:
        """The gap (*batch,) of the two people."""
        return np.asarray(self.gap_m.min(axis=(-2, -1)))


def surface_gaps(pair_m: Array, radii_m: Array, skeleton: Skeleton) -> Gaps:
    """Return the distances of the surfaces of two people.

    Args:
        pair_m: Pairs (*batch, person=2, joint, 3), metres; NaN gives NaN.
        radii_m: Radius of the bone that ends in each joint (person=2, joint), metres.
        skeleton: Whose joints.
    """
    bones, half = np.array([child for _, child in skeleton.bones]), skeleton.num_joints
    flat = np.ascontiguousarray(pair_m, dtype=np.float64).reshape(-1, 2 * half, 3)
    pairs = np.stack(np.broadcast_arrays(bones[:, None], bones + half), axis=-1).reshape(-1, 2)
    share, gap = nearest_on_bones(flat, pairs, parents_of(skeleton, 2), np.ravel(np.asarray(radii_m, dtype=np.float64)))
    shape = (*np.shape(pair_m)[:-3], len(bones), len(bones))
    return Gaps(gap.reshape(shape), share.reshape(*shape, 2), bones)


def parents_of(skeleton: Skeleton, num_people: int) -> Indices:
    """Return the parent of each joint of all people (P J,), joints numbered through; a root is its own."""
    parents = np.maximum(np.array(skeleton.parents), skeleton.root * (np.array(skeleton.parents) < 0))
    return np.concatenate([parents + person * skeleton.num_joints for person in range(num_people)])


@compiled()
def nearest_on_bones(points: Array, pairs: Indices, parents: Indices, radii: Array) -> tuple[Array, Array]:
    """Return where on their bones (T, pair, 2) the nearest points are, 0 at the parent, and the gap of the surfaces.

    Args:
        points: Joints (T, n, 3), metres.
        pairs: Child joints of two bones (pair, 2).
        parents: Parent of each joint (n,).
        radii: Radius of the bone that ends in each joint (n,), metres.
    """
    share, gap = np.empty((len(points), len(pairs), 2)), np.empty((len(points), len(pairs)))
    for at in range(len(points)):
        for row in range(len(pairs)):
            first, other = pairs[row, 0], pairs[row, 1]
            a, b = row_of(points[at], parents[first]), row_of(points[at], parents[other])
            u, v, g = subtract(row_of(points[at], first), a), subtract(row_of(points[at], other), b), subtract(a, b)
            # Parallel bones: all places are equally near, and the middle does not jump.
            s, t = closest_on_segments(dot(u, u), dot(v, v), dot(u, v), dot(u, g), dot(v, g), 0.5)
            apart = (g[0] + s * u[0] - t * v[0], g[1] + s * u[1] - t * v[1], g[2] + s * u[2] - t * v[2])
            share[at, row, 0], share[at, row, 1] = s, t
            gap[at, row] = length(apart) - radii[first] - radii[other]
    return share, gap


def standing_out(bones: Indices, share: Array, gap_m: Array, skeleton: Skeleton) -> Array:
    """Return the degree to which two bones touch and not neighbouring ones (T, pair), from 0 to 1.

    If they are closest at a joint, and the next bone from there is closer still, that bone has the contact.

    Args:
        bones: Child joints of two bones (pair, 2), joints of all people numbered through.
        share: Where on them the nearest points are (T, pair, 2).
        gap_m: Gaps of the surfaces (T, pair), metres.
        skeleton: Whose joints.
    """
    weight, pairs = np.ones(gap_m.shape), tuple(map(tuple, bones.tolist()))
    for side in (0, 1):
        for end in (0, 1):
            closest = gap_m[:, _beside(pairs, side, end, skeleton)].min(axis=-1)
            at_end = fade(np.abs(share[..., side] - end), 0.0, _AT_END)
            weight *= 1.0 + at_end * np.expm1((closest - gap_m) / _BESIDE_M)
    return weight


@lru_cache(maxsize=64)
def _beside(pairs: tuple[tuple[int, int], ...], side: int, end: int, skeleton: Skeleton) -> Indices:
    """Return which pairs have a next bone, at the beginning (0) or end of the pair's, and the pair itself (pair, k)."""
    joints, places = skeleton.num_joints, {pair: place for place, pair in enumerate(pairs)}
    meeting = [[edge[1] for edge in skeleton.bones if joint in edge] for joint in range(joints)]
    beside = []
    for pair in places:
        person, child = divmod(pair[side], joints)
        joint = child if end else skeleton.parents[child]
        others = (person * joints + bone for bone in (meeting[joint] if person >= 0 else [child]))
        beside.append(
            [places[other] for other in ((pair[0], b) if side else (b, pair[1]) for b in others) if other in places]
        )
    most = max(map(len, beside), default=1)
    filled = [[*rows, *[place] * (most - len(rows))] for place, rows in enumerate(beside)]
    return np.array(filled, dtype=np.int64).reshape(-1, most)
