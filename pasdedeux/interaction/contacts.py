"""Contacts: which joints of the two people are closest to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

__all__ = ["Contacts", "closest_joint_pairs", "gap_m", "joint_pair_distances"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contacts:
    """Joint pairs between two people, nearest first.

    Args:
        joint_a: Joint of person A, (*batch, k).
        joint_b: Joint of person B, (*batch, k).
        distance_m: Distance between them, (*batch, k), metres, rising.
    """

    joint_a: npt.NDArray[np.int64]
    joint_b: npt.NDArray[np.int64]
    distance_m: Array


def joint_pair_distances(pair_m: Array) -> Array:
    """Return the distances (*batch, joint of A, joint of B), metres, of pairs (*batch, person=2, joint, 3)."""
    difference = pair_m[..., 0, :, None, :] - pair_m[..., 1, None, :, :]
    return np.asarray(np.linalg.norm(difference, axis=-1))


def closest_joint_pairs(pair_m: Array, *, num_pairs: int = 5) -> Contacts:
    """Return the `num_pairs` closest joint pairs between the people of pairs (*batch, person=2, joint, 3).

    Ties go to the lower joint of A, then of B; NaN distances come last.

    Raises:
        InputError: There are not two people, or `num_pairs` is not positive.
    """
    if pair_m.shape[-3] != 2:
        raise InputError(f"contacts need two people, found {pair_m.shape[-3]}")
    if num_pairs < 1:
        raise InputError(f"at least one joint pair must be asked for, found {num_pairs}")
    distances = joint_pair_distances(pair_m)
    num_joints = distances.shape[-1]
    flat = distances.reshape(*distances.shape[:-2], -1)
    order = np.argsort(flat, axis=-1, kind="stable")[..., :num_pairs]
    return Contacts(
        joint_a=order // num_joints,
        joint_b=order % num_joints,
        distance_m=np.take_along_axis(flat, order, axis=-1),
    )


def gap_m(pair_m: Array) -> Array:
    """Return the distance (*batch,), metres, between the closest joints of the two people; NaN joints are left out."""
    distances = joint_pair_distances(pair_m)
    return np.asarray(np.nanmin(distances, axis=(-2, -1)))
