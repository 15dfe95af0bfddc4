"""Pairs looked up as one: a row is both people of a frame in their place to each other, a projection is both images.

Two people in close contact hide and bend one another, and what one does says much of what the other can do.  A row
keeps the place of the two to each other, so a query is both images about the middle of both mid-hips, 28 joints in all,
by the metric, masks, weights and trees of one person's search.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.camera import DatabaseCamera, OrthographicCamera
from pasdedeux.projections.retarget import body_heading, mid_hip, retarget_proportions
from pasdedeux.projections.search import (
    EXACT_UP_TO,
    SLACK_BEYOND,
    Neighbours,
    look_at_all,
    prepare_query,
    search_index,
)
from pasdedeux.projections.tree import Tree, build_tree
from pasdedeux.skeletons import OP14

__all__ = [
    "PairDatabase",
    "PairIndex",
    "PairNeighbours",
    "build_pair_index",
    "centre_pairs",
    "search_pairs_brute_force",
]

_PEOPLE = 2
_JOINTS = _PEOPLE * OP14.num_joints

Array = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


def centre_pairs(pairs_m: Array) -> Array:
    """Return pairs (*batch, person, 14, 3) on the reference body about the middle of their mid-hips, B on the +X side.

    Each person keeps bone directions and mid-hip; so hands that held each other may part by what their arms' lengths
    changed.  Where B stands over A and there is no direction from one to the other, A faces +Z.

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


@dataclass(frozen=True)
class PairDatabase:
    """Pairs seen by a camera at every yaw step; projection number = row * num_yaws + yaw index.

    Args:
        pairs_m: Pairs (row, person, 14, 3) as `centre_pairs` gives them, metres; kept in float32.
        num_yaws: Yaw steps over the full turn.
        camera: The camera that sees them; it looks at the middle of both mid-hips.

    Raises:
        InputError: Another shape, no row, no yaw, or a value that is not finite.
    """

    pairs_m: Floats32
    num_yaws: int = 30
    camera: DatabaseCamera = field(default_factory=OrthographicCamera)

    def __post_init__(self) -> None:
        """Check shapes and values."""
        pairs = np.ascontiguousarray(self.pairs_m, dtype=np.float32)
        if pairs.ndim != 4 or pairs.shape[1:] != (_PEOPLE, OP14.num_joints, 3) or len(pairs) == 0:
            raise InputError(
                f"database pairs have shape {pairs.shape}; expected (rows, {_PEOPLE}, {OP14.num_joints}, 3) and a row"
            )
        if not np.isfinite(pairs).all():
            raise InputError(f"pair row {int(np.argwhere(~np.isfinite(pairs))[0][0])}: a value is not finite")
        if self.num_yaws < 1:
            raise InputError(f"num_yaws is {self.num_yaws}; at least 1 is needed")
        object.__setattr__(self, "pairs_m", pairs)

    @property
    def num_projections(self) -> int:
        """Number of projections, each of both people."""
        return len(self.pairs_m) * self.num_yaws

    def turned(self, rows: npt.ArrayLike, yaw_index: npt.ArrayLike) -> Array:
        """Return the pairs (*batch, person, 14, 3) of these rows at these yaws, which count in steps."""
        yaw = np.asarray(yaw_index) * (2.0 * np.pi / self.num_yaws)
        pairs = self.pairs_m[np.asarray(rows)].astype(np.float64)
        return np.asarray(np.einsum("...ij,...pnj->...pni", yaw_rotmat(yaw), pairs))

    def project(self, first_row: int = 0, last_row: int | None = None) -> Floats32:
        """Return the projections (row, yaw, person, 14, 2) of some rows, about the middle of both mid-hips, metres."""
        rows = np.arange(len(self.pairs_m))[first_row:last_row]
        turned = self.turned(*np.broadcast_arrays(rows[:, None], np.arange(self.num_yaws)))
        return np.asarray(self.camera.project(turned), dtype=np.float32)


@dataclass(frozen=True)
class PairNeighbours:
    """The best pairs of each query, best first.

    Args:
        neighbours: Projections and distances (*batch, k); distances are means over the joints seen of both people.
        is_exchanged: Image 0 was taken for person B and image 1 for A (*batch, k).
    """

    neighbours: Neighbours
    is_exchanged: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PairIndex:
    """The search tree of a pair database; see `search.ProjectionIndex` for the slack."""

    num_yaws: int
    tree: Tree
    slack: float = 0.0

    def search(
        self,
        query_m: npt.ArrayLike,
        weights: npt.ArrayLike | None = None,
        *,
        num_neighbours: int = 50,
        is_order_known: bool = False,
    ) -> PairNeighbours:
        """Return exactly what `search_pairs_brute_force` gives when the slack is 0; one query or a batch of them."""
        query, weight = _prepare(query_m, weights)

        def look(query: Floats32, weight: Floats32) -> Neighbours:
            return search_index(
                (self.tree,),
                query,
                weight,
                num_neighbours=num_neighbours,
                slack=self.slack,
                num_yaws=self.num_yaws,
            )

        straight = look(query, weight)
        return _merged(straight, None if is_order_known else look(_exchanged(query), _exchanged(weight)))


def build_pair_index(
    database: PairDatabase, *, exact_up_to: int = EXACT_UP_TO, slack_beyond: float = SLACK_BEYOND
) -> PairIndex:
    """Return the search tree of a pair database; exact up to `exact_up_to` projections."""
    flat = np.empty((database.num_projections, 2 * _JOINTS), dtype=np.float32)
    step = max(1, 50_000 // database.num_yaws)
    for row in range(0, len(database.pairs_m), step):
        points = database.project(row, row + step).reshape(-1, _JOINTS, 2)
        part = flat[row * database.num_yaws :][: len(points)]
        part[:, :_JOINTS], part[:, _JOINTS:] = points[..., 0], points[..., 1]
    slack = 0.0 if database.num_projections <= exact_up_to else slack_beyond
    return PairIndex(database.num_yaws, build_tree(flat), slack)


def search_pairs_brute_force(
    database: PairDatabase,
    query_m: npt.ArrayLike,
    weights: npt.ArrayLike | None = None,
    *,
    num_neighbours: int = 50,
    is_order_known: bool = False,
) -> PairNeighbours:
    """Return the nearest pairs by looking at all of them: the plain form, kept as oracle.

    Args:
        database: Database of n projections.
        query_m: Queries (*batch, person, 14, 2), metres, x right, y up, the middle of both mid-hips at the origin; NaN
            where not seen.
        weights: Weights (*batch, person, 14), 1 when not given.
        num_neighbours: Neighbours k wanted.
        is_order_known: Image 0 is person A; otherwise both ways are looked at and a row may be found each way.

    Returns:
        Neighbours (*batch, k), ties by way and projection number; none where no joint was seen.
    """
    query, weight = _prepare(query_m, weights)
    projections = database.project().reshape(-1, _JOINTS, 2)

    def look(query: Floats32, weight: Floats32) -> Neighbours:
        return look_at_all(projections, query, weight, num_neighbours=num_neighbours, num_yaws=database.num_yaws)

    return _merged(look(query, weight), None if is_order_known else look(_exchanged(query), _exchanged(weight)))


def _prepare(query_m: npt.ArrayLike, weights: npt.ArrayLike | None) -> tuple[Floats32, Floats32]:
    """Return both people's joints as 28 joints of one query (*batch, 28, 2), and their weights (*batch, 28)."""
    query = np.asarray(query_m)
    if query.shape[-3:] != (_PEOPLE, OP14.num_joints, 2):
        raise InputError(f"pair query has shape {query.shape}, expected (..., {_PEOPLE}, {OP14.num_joints}, 2) metres")
    flat = query.reshape(*query.shape[:-3], _JOINTS, 2)
    if weights is not None:
        weights = np.broadcast_to(np.asarray(weights), query.shape[:-1]).reshape(flat.shape[:-1])
    return prepare_query(flat, weights, num_joints=_JOINTS)


def _exchanged(values: Floats32) -> Floats32:
    """Return queries (*batch, 28, 2) or weights (*batch, 28) with the people exchanged."""
    order = np.roll(np.arange(_JOINTS), OP14.num_joints)
    return values[..., order, :] if values.shape[-1] == 2 else values[..., order]


def _merged(straight: Neighbours, exchanged: Neighbours | None) -> PairNeighbours:
    """Return the best of both ways, as many as of one."""
    if exchanged is None:
        return PairNeighbours(straight, np.zeros(straight.projection.shape, dtype=bool))
    count = straight.projection.shape[-1]
    distance = np.concatenate([straight.distance_m, exchanged.distance_m], axis=-1)
    projection = np.concatenate([straight.projection, exchanged.projection], axis=-1)
    order = np.argsort(distance, axis=-1, kind="stable")[..., :count]
    best = Neighbours(
        np.take_along_axis(projection, order, axis=-1),
        np.take_along_axis(distance, order, axis=-1),
        straight.num_yaws,
    )
    return PairNeighbours(best, np.logical_and(order >= count, best.projection >= 0))
