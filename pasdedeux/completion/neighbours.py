"""Draws near a pair in 3D, over its known joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers, merge_axes
from pasdedeux.completion.kernels import fill_rigid_residuals
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import interaction_distances
from pasdedeux.kinematics import align_rigid

Draws = npt.NDArray[np.floating]

MIN_KNOWN = 5
"""Smallest number of known joints of both people together: fewer have hardly any tetrahedra."""


@dataclass(frozen=True)
class NearbyDraws:
    """Draws near a pair, nearest first, moved onto it.

    Args:
        pairs_m: The draws (k, person=2, joint=17, 3), metres, moved rigidly onto the known joints.
        draw: Their indices, (k,).
        distance_m: Their distances, (k,), metres.
    """

    pairs_m: Array
    draw: Integers
    distance_m: Array


def nearest_rigid(draws_m: Draws, pair_m: Array, *, count: int) -> NearbyDraws:
    """Return the draws nearest over the known joints: root mean square after the best proper rigid motion.

    Args:
        draws_m: Draws (draw, person=2, joint=17, 3), metres; single precision is fastest.
        pair_m: Pair (2, 17, 3), metres; NaN where a joint is not known.
        count: Number of draws, fewer if there are fewer.

    Raises:
        InputError: There is no draw, or fewer than 5 joints are known.
    """
    points = np.asarray(pair_m, dtype=np.float64).reshape(-1, 3)
    joints = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(draws_m):
        raise InputError("there are no draws to compare with")
    if len(joints) < MIN_KNOWN:
        raise InputError(f"{len(joints)} joints of the two people are known; comparing needs at least {MIN_KNOWN}")
    known = points[joints]
    squared = np.empty(len(draws_m))
    flat = merge_axes(np.ascontiguousarray(draws_m, dtype=np.float32), 1, -1)
    fill_rigid_residuals(flat, joints, known - known.mean(axis=0), squared)
    count = min(count, len(squared))
    near = np.argpartition(squared, count - 1)[:count]
    near = near[np.lexsort((near, squared[near]))]
    nearby = flat[near].astype(np.float64)
    moved = align_rigid(nearby[:, joints], np.broadcast_to(known, (count, *known.shape))).apply(nearby)
    return NearbyDraws(
        pairs_m=moved.reshape(count, *pair_m.shape),
        draw=near.astype(np.int64),
        distance_m=np.sqrt(np.maximum(squared[near], 0.0) / len(joints)),
    )


def nearest_by_interaction(draws_m: Draws, pair_m: Array, *, count: int, num_ranked: int) -> NearbyDraws:
    """Return the draws nearest in D_I (eq. 8 of Yin et al. 2018 over tetrahedra) over the known joints alone.

    D_I is measured for the `num_ranked` draws nearest by `nearest_rigid`; if `num_ranked` is the number of draws, the
    result is exact.

    Raises:
        InputError: As `nearest_rigid`.
    """
    ranked = nearest_rigid(draws_m, pair_m, count=max(num_ranked, count))
    is_known = np.isfinite(pair_m).all(axis=-1).ravel()
    known = np.asarray(pair_m, dtype=np.float64).reshape(-1, 3)[is_known]
    moved = merge_axes(ranked.pairs_m, 1, -1)[:, None, is_known]
    distance = interaction_distances(moved, known[None, None])[:, 0]
    order = np.argsort(distance, kind="stable")[:count]
    return NearbyDraws(pairs_m=ranked.pairs_m[order], draw=ranked.draw[order], distance_m=distance[order])
