"""How close two people are: distances between their joints, and between the surfaces of their bodies.

A body is capsules round its bones; people touch where the surface of one meets that of the other, anywhere along a
bone, not only at joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from pasdedeux.kinematics.rotation_kernels import closest_on_segments, dot, length, row_of, subtract
from pasdedeux.skeletons import Skeleton

__all__ = ["CONTACT_M", "Gaps", "closest_joint_distance", "joint_pair_distances", "surface_gaps"]

Array = npt.NDArray[np.float64]

CONTACT_M = 0.2
"""Joints of two people closer than this are in contact where variants are measured."""


def joint_pair_distances(pair_m: Array) -> Array:
    """Return the distances (*batch, joint of A, joint of B), metres, of pairs (*batch, person=2, joint, 3)."""
    difference = pair_m[..., 0, :, None, :] - pair_m[..., 1, None, :, :]
    return np.asarray(np.linalg.norm(difference, axis=-1))


def closest_joint_distance(pair_m: Array) -> Array:
    """Return the distance (*batch,) of the closest joints of A and B of pairs (*batch, person=2, joint, 3), metres.

    NaN joints are left out.
    """
    return np.asarray(np.nanmin(joint_pair_distances(pair_m), axis=(-2, -1)))


@dataclass(frozen=True)
class Gaps:
    """How far the surfaces of two people are apart, bone by bone; a bone is named by its child joint.

    Args:
        gap_m: (*batch, bone of A, bone of B), metres; negative where they pass through each other.
        share: Where on each of the two bones they are closest (*batch, bone of A, bone of B, 2): 0 at the parent
            joint, 1 at the child.
        bones: Child joints of the bones (bone,).
    """

    gap_m: Array
    share: Array
    bones: npt.NDArray[np.int64]

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
    bones = np.array([child for _, child in skeleton.bones])
    flat = np.ascontiguousarray(pair_m, dtype=np.float64).reshape(-1, 2, skeleton.num_joints, 3)
    gap, share = _gaps(flat, np.asarray(radii_m, dtype=np.float64), np.array(skeleton.parents), bones)
    batch = np.shape(pair_m)[:-3]
    return Gaps(gap.reshape(*batch, *gap.shape[1:]), share.reshape(*batch, *share.shape[1:]), bones)


@njit(cache=True, nogil=True, error_model="numpy")
def _gaps(
    pairs: Array, radii: Array, parents: npt.NDArray[np.int64], bones: npt.NDArray[np.int64]
) -> tuple[Array, Array]:
    count = bones.shape[0]
    gap, share = np.empty((pairs.shape[0], count, count)), np.empty((pairs.shape[0], count, count, 2))
    for at in range(pairs.shape[0]):
        for i in range(count):
            a = row_of(pairs[at, 0], parents[bones[i]])
            u = subtract(row_of(pairs[at, 0], bones[i]), a)
            for j in range(count):
                b = row_of(pairs[at, 1], parents[bones[j]])
                v = subtract(row_of(pairs[at, 1], bones[j]), b)
                g = subtract(a, b)
                s, t = closest_on_segments(dot(u, u), dot(v, v), dot(u, v), dot(u, g), dot(v, g), 0.5)
                apart = (g[0] + s * u[0] - t * v[0], g[1] + s * u[1] - t * v[1], g[2] + s * u[2] - t * v[2])
                gap[at, i, j] = length(apart) - radii[0, bones[i]] - radii[1, bones[j]]
                share[at, i, j, 0], share[at, i, j, 1] = s, t
    return gap, share
