"""Search pairs as one: a row holds both people of a frame, a projection both images.

Two people in close contact hide and bend each other, and the pose of one constrains that of the other.  A row keeps
their relative place, so a query consists of both images about the middle of both mid-hips, 28 joints in all, and
metric, masks, weights and trees are those of the search for one person.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.retarget import body_heading, mid_hip, retarget_proportions
from pasdedeux.projections.search import Neighbours, ProjectionIndex
from pasdedeux.skeletons import OP14

_PEOPLE = 2
_JOINTS = _PEOPLE * OP14.num_joints


def centre_pairs(pairs_m: Array) -> Array:
    """Return pairs (*batch, person, 14, 3) on the reference body about the middle of their mid-hips, B on the +X side.

    Each person keeps bone directions and mid-hip, so hands that held each other may part by the change of arm lengths.
    If B is straight above A, so that there is no direction from one to the other, A faces +Z.

    Raises:
        InputError: See `retarget_proportions`.
    """
    if pairs_m.shape[-3:] != (_PEOPLE, OP14.num_joints, 3):
        raise InputError(f"pairs have shape {pairs_m.shape}, expected (..., {_PEOPLE}, {OP14.num_joints}, 3)")
    pairs = retarget_proportions(pairs_m)
    hips = mid_hip(pairs)
    across = hips[..., 1, :] - hips[..., 0, :]
    is_apart = np.hypot(across[..., 0], across[..., 2]) > 1e-6
    # Yaw a turns +X to (cos a, 0, -sin a).
    yaw = np.where(is_apart, np.arctan2(-across[..., 2], across[..., 0]), body_heading(pairs[..., 0, :, :]))
    centred = pairs - hips.mean(axis=-2)[..., None, None, :]
    return np.asarray(np.einsum("...ij,...pnj->...pni", yaw_rotmat(-yaw), centred))


def pair_database(pairs_m: npt.NDArray[np.floating], *, camera: DatabaseCamera, num_yaws: int = 30) -> Database:
    """Return the database of pairs (row, person, 14, 3) from `centre_pairs`; both people are one pose.

    The camera looks at the middle of both mid-hips.
    """
    poses = np.asarray(pairs_m, dtype=np.float32).reshape(-1, _JOINTS, 3)
    return Database(poses, np.ones(len(poses), dtype=bool), num_yaws=num_yaws, camera=camera)


def search_pairs(
    index: ProjectionIndex, query_m: npt.ArrayLike, weights: npt.ArrayLike, *, num_neighbours: int = 50
) -> tuple[Neighbours, Flags]:
    """Return the nearest pairs in either order of the people; a row may appear in both.

    Args:
        index: Index of a database of pairs.
        query_m: Images of both (*batch, person, 14, 2), metres, x right, y up, the middle of both mid-hips at the
            origin; NaN where not seen.
        weights: Weights (*batch, person, 14).
        num_neighbours: Neighbours k wanted.

    Returns:
        Neighbours (*batch, k), distances over the joints seen of both people, ties as given first, then by projection
        number, none where no joint was seen; and whether image 0 was taken for person B, and image 1 for A.

    Raises:
        InputError: A query of another shape.
    """
    query = np.asarray(query_m)
    if query.shape[-3:] != (_PEOPLE, OP14.num_joints, 2):
        raise InputError(f"pair query has shape {query.shape}, expected (..., {_PEOPLE}, {OP14.num_joints}, 2) metres")
    weight = np.broadcast_to(np.asarray(weights), query.shape[:-1])
    batch = query.shape[:-3]
    straight, exchanged = (
        index.search(
            query[..., order, :, :].reshape(*batch, _JOINTS, 2),
            weight[..., order, :].reshape(*batch, _JOINTS),
            num_neighbours=num_neighbours,
        )
        for order in ([0, 1], [1, 0])
    )
    distance = np.concatenate([straight.distance_m, exchanged.distance_m], axis=-1)
    projection = np.concatenate([straight.projection, exchanged.projection], axis=-1)
    order = np.argsort(distance, axis=-1, kind="stable")[..., :num_neighbours]
    best = Neighbours(
        np.take_along_axis(projection, order, axis=-1), np.take_along_axis(distance, order, axis=-1), straight.num_yaws
    )
    return best, np.logical_and(order >= num_neighbours, best.projection >= 0)
