"""Search of a projection database by the published metric, with joint masks and confidence weights.

The metric is eq. 1 of Yiannakides et al. 2019, the sum over joints of the 2D joint distances, with a weight per joint
(confidence; 0 where the joint was not seen) and divided by the sum of the weights, so that queries with different
joints missing compare.

`ProjectionIndex` gives the same answers as looking at every projection, ties included, from trees of boxes (`tree`,
where the bound is proven), one per cell of the space of projections.  Over `EXACT_UP_TO`
projections it takes a slack: then the i-th projection given is at most 1 + slack times as far as the i-th nearest, and
`measure_recall` says how many of the nearest are found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.tree import Tree, build_tree, search_trees, sort_into_cells
from pasdedeux.skeletons import OP14

EXACT_UP_TO = 5_000_000
"""Projections up to which the search is exact where nothing else is asked for."""
SLACK_BEYOND = 0.1
"""Slack of the search of more projections: of many variants of the same poses it finds 95 % of the 50 nearest."""

_CELL_SIZE = 1_000_000
"""Projections of a tree, about: only those of one are held besides the trees while building."""
_SAMPLE = 50_000
"""Projections that the cells are laid out by."""

_RECALL_QUERIES = 100
_RECALL_NOISE_M = 0.03
"""Standard deviation of the noise of each coordinate."""

Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Neighbours:
    """The best projections of each query, best first.

    Args:
        projection: Projection numbers (*batch, k), row * num_yaws + yaw index; -1 where there are fewer than k.
        distance_m: Weighted mean distance per seen joint (*batch, k), metres; inf where there are fewer than k.
        num_yaws: Yaw steps of the database.
    """

    projection: Integers
    distance_m: npt.NDArray[np.float64]
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
    if weights is None:
        weight = np.ones(is_seen.shape, dtype=np.float32)
    else:
        weight = np.array(np.broadcast_to(np.asarray(weights, dtype=np.float32), is_seen.shape))
    if not (np.isfinite(weight).all() and (weight >= 0).all()):
        raise InputError("joint weights must be finite and not negative")
    weight[~is_seen] = 0.0
    query[~is_seen] = 0.0
    return query, weight


@dataclass(frozen=True)
class ProjectionIndex:
    """The search trees of a database.

    Args:
        num_yaws: Yaw steps of the database.
        trees: One per cell of the space of projections.
        slack: 0 for the exact search.
    """

    num_yaws: int
    trees: tuple[Tree, ...]
    slack: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a slack without meaning."""
        if not (np.isfinite(self.slack) and self.slack >= 0):
            raise InputError(f"the slack of the search is {self.slack}; it must be finite and not negative")

    def search(
        self, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_neighbours: int = 50
    ) -> Neighbours:
        """Return the nearest projections of one query or a batch of them.

        Args:
            query_m: Queries (*batch, J, 2), metres, x right, y up, mid-hip at the origin; NaN where not seen.
            weights: Weights (*batch, J) of the joints, 1 when not given.
            num_neighbours: Neighbours k wanted.

        Returns:
            Neighbours (*batch, k), ties by projection number; none where no joint was seen.
        """
        joints = self.trees[0].leaves.shape[1] // 2
        query, weight = prepare_query(query_m, weights, num_joints=joints)
        flat_query = np.ascontiguousarray(np.swapaxes(query.reshape(-1, joints, 2), 1, 2)).reshape(-1, 2 * joints)
        flat_weight = np.ascontiguousarray(weight.reshape(-1, joints))
        found, summed = search_trees(
            self.trees, flat_query, flat_weight, num_neighbours=num_neighbours, slack=self.slack
        )
        total = flat_weight.sum(axis=1, dtype=np.float64)[:, None]
        distance = np.full(summed.shape, np.inf)
        np.divide(summed.astype(np.float64), total, out=distance, where=total > 0)
        shape = (*query.shape[:-2], num_neighbours)
        return Neighbours(found.reshape(shape), distance.reshape(shape), self.num_yaws)

    def with_slack(self, slack: float) -> ProjectionIndex:
        """Return the same trees searched with another slack; 0 is exact."""
        return replace(self, slack=slack)


def build_index(
    database: Database,
    *,
    exact_up_to: int = EXACT_UP_TO,
    slack_beyond: float = SLACK_BEYOND,
    cell_size: int = _CELL_SIZE,
) -> ProjectionIndex:
    """Return the search trees of a database.

    The projections of many poses are sorted into cells first and made anew for each cell's tree, so that only one
    cell's are held besides the trees.

    Args:
        database: Database.
        exact_up_to: Projections up to which the search is exact.
        slack_beyond: Slack of the search of more.
        cell_size: Projections of a tree, about; more than twice as many are divided.
    """
    slack = 0.0 if database.num_projections <= exact_up_to else slack_beyond
    return ProjectionIndex(database.num_yaws, _trees_of(database, cell_size), slack)


def _trees_of(database: Database, cell_size: int) -> tuple[Tree, ...]:
    """Return one tree of a database's projections, or of many one for every cell of about `cell_size` of them."""
    count = database.num_projections
    step = max(1, 100_000 // database.num_yaws)
    starts = range(0, database.num_rows, step)
    if count <= 2 * cell_size:
        flat = np.empty((count, 2 * database.num_joints), dtype=np.float32)
        for row in starts:
            part = _flat(database.project(row, row + step))
            flat[row * database.num_yaws :][: len(part)] = part
        return (build_tree(flat),)
    sample = np.unique(np.linspace(0, count - 1, _SAMPLE).astype(np.int64))
    cell_of = sort_into_cells(_flat(database.projections(sample)), int(np.log2(count / cell_size)))
    cell = np.concatenate([cell_of(_flat(database.project(row, row + step))).astype(np.int16) for row in starts])
    trees = []
    for one in np.unique(cell):
        number = np.flatnonzero(cell == one)
        pieces = np.array_split(number, -(-len(number) // 100_000))
        flat = np.empty((len(number), 2 * database.num_joints), dtype=np.float32)
        np.concatenate([_flat(database.projections(piece)) for piece in pieces], out=flat)
        trees.append(build_tree(flat, number.astype(np.int32)))
    return tuple(trees)


def _flat(projections: Floats32) -> Floats32:
    """Return projections (*batch, J, 2) as rows (n, 2 J), x of the joints, then y."""
    points = projections.reshape(-1, *projections.shape[-2:])
    return np.concatenate([points[..., 0], points[..., 1]], axis=-1)


def recall(found: Neighbours, exact: Neighbours, *, num_best: int = 1) -> float:
    """Return the share of the `num_best` true neighbours of each query that were found; NaN without any query."""
    hits = [
        np.isin(true[:num_best], some[some >= 0]).mean()
        for some, true in zip(
            found.projection.reshape(-1, found.projection.shape[-1]),
            exact.projection.reshape(-1, exact.projection.shape[-1]),
            strict=True,
        )
        if true[0] >= 0
    ]
    return float(np.mean(hits)) if hits else float("nan")


def measure_recall(database: Database, index: ProjectionIndex, rng: np.random.Generator) -> float:
    """Return the share of the 50 nearest that an index finds, against its own trees searched exactly.

    Queries are projections of the database between its yaw steps with noise on every joint: about as far from their
    nearest projections as images of motion that the database does not hold.

    Args:
        database: Database of the index.
        index: Index, with its slack.
        rng: Draws queries and noise.
    """
    rows = rng.integers(0, database.num_rows, _RECALL_QUERIES)
    yaw = rng.uniform(0.0, database.num_yaws, _RECALL_QUERIES)
    query = np.array(database.camera.project(database.turned(rows, yaw)), dtype=np.float64)
    query += rng.normal(0.0, _RECALL_NOISE_M, query.shape)
    return recall(index.search(query), index.with_slack(0.0).search(query), num_best=50)
