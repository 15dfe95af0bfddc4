"""How close two people are: the distances between their joints."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["CONTACT_M", "closest_joint_distance", "joint_pair_distances"]

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
