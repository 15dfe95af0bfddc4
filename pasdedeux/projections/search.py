"""Search a projection database by the published metric, with joint masks and confidence weights.

The metric is eq. 1 of Yiannakides et al. 2019, the sum over joints of the 2D joint distances, with a weight per joint
(confidence; 0 if the joint was not seen), divided by the sum of the weights, so that queries with different missing
joints are comparable.

`ProjectionIndex` gives the same results as a search of all projections, including ties, by a tree of boxes (`tree`,
which proves the bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Floats32, Integers
from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.tree import SearchTree, build_tree, search_tree
from pasdedeux.skeletons import OP14


@dataclass(frozen=True)
class Neighbours:
    """The best projections of each query, best first.

    Args:
        projection: Projection numbers (*batch, k), row * num_yaws + yaw index; -1 where there are fewer than k.
        distance_m: Weighted mean distance per seen joint (*batch, k), metres; inf where there are fewer than k.
        num_yaws: Yaw steps of the database.
    """

    projection: Integers
    distance_m: Array
    num_yaws: int

    @property
    def row(self) -> Integers:
        """Database rows (*batch, k); -1 where there is none."""
        return np.where(self.projection >= 0, self.projection // self.num_yaws, -1)

    @property
    def yaw_index(self) -> Integers:
        """Yaw steps (*batch, k); 0 where there is none."""
        return np.where(self.projection >= 0, self.projection % self.num_yaws, 0)


def prepare_query(
    query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_joints: int = OP14.num_joints
) -> tuple[Floats32, Floats32]:
    """Return queries (*batch, J, 2) and weights (*batch, J) in float32, weight 0 where a joint is not finite.

    Raises:
        InputError: Wrong shapes, or a weight that is negative or not finite.
    """
    query = np.array(query_m, dtype=np.float32)
    if query.shape[-2:] != (num_joints, 2):
        raise InputError(f"query has shape {query.shape}, expected (..., {num_joints}, 2) metres about the mid-hip")
    is_seen = np.isfinite(query).all(axis=-1)
    weight = np.ones(is_seen.shape, dtype=np.float32)
    weight[...] = 1.0 if weights is None else weights
    if not (np.isfinite(weight).all() and (weight >= 0).all()):
        raise InputError("joint weights must be finite and not negative")
    weight[~is_seen] = 0.0
    query[~is_seen] = 0.0
    return query, weight


@dataclass(frozen=True)
class ProjectionIndex:
    """The search tree of a database of `num_yaws` yaw steps."""

    num_yaws: int
    tree: SearchTree

    def search(
        self, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_neighbours: int = 50
    ) -> Neighbours:
        """Return the nearest projections of one query or a batch of them.

        Args:
            query_m: Queries (*batch, J, 2), metres, x right, y up, mid-hip at the origin; NaN where not seen.
            weights: Weights (*batch, J) of the joints, 1 when not given.
            num_neighbours: Number of neighbours k.

        Returns:
            Neighbours (*batch, k), ties by projection number; none where no joint was seen.
        """
        joints = self.tree.leaves.shape[1] // 2
        query, weight = prepare_query(query_m, weights, num_joints=joints)
        flat_query = np.ascontiguousarray(np.swapaxes(query.reshape(-1, joints, 2), 1, 2)).reshape(-1, 2 * joints)
        flat_weight = np.ascontiguousarray(weight.reshape(-1, joints))
        rows, summed = search_tree(self.tree, flat_query, flat_weight, num_neighbours)
        total = flat_weight.sum(axis=1, dtype=np.float64)[:, None]
        distance = np.full(summed.shape, np.inf)
        np.divide(summed.astype(np.float64), total, out=distance, where=total > 0)
        shape = (*query.shape[:-2], num_neighbours)
        return Neighbours(rows.reshape(shape), distance.reshape(shape), self.num_yaws)


def build_index(database: Database) -> ProjectionIndex:
    """Return the search tree of a database; building it needs memory for twice the projections."""
    flat = np.empty((database.num_projections, 2 * database.num_joints), dtype=np.float32)
    step = max(1, 100_000 // database.num_yaws)
    for row in range(0, database.num_rows, step):
        points = database.project(row, row + step).reshape(-1, database.num_joints, 2)
        part = np.concatenate([points[..., 0], points[..., 1]], axis=-1)
        flat[row * database.num_yaws :][: len(part)] = part
    return ProjectionIndex(database.num_yaws, build_tree(flat))
