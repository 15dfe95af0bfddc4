"""Refine yaws between the steps of the database: turn each candidate until its image is nearest to the query.

A yaw step of 12 degrees leaves an error of up to 6, which moves a hand 0.7 m from the axis by 7 cm.  Along the yaw of
one pose, the metric is a sum of distances between points and smooth curves.  It is evaluated at a few places up to one
step to either side, then by golden section about the best of them.  The original yaw is one of the places, so the cost
never grows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Floats32, Integers
from pasdedeux.compiled import compiled
from pasdedeux.projections.database import Database
from pasdedeux.projections.search import Neighbours, prepare_query
from pasdedeux.skeletons import OP14

_NUM_PLACES = 9
"""Places evaluated over two steps; the candidate's own yaw is in the middle."""
_NUM_SECTIONS = 14
"""Golden sections: 0.618^14 of a quarter step is 0.06 mrad."""


def refine_yaws(
    database: Database, neighbours: Neighbours, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None
) -> tuple[Neighbours, Array]:
    """Turn each neighbour (*batch, k) of queries (*batch, 14, 2) to the yaw of least distance, up to one step away.

    Args:
        database: Database searched.
        neighbours: Neighbours of the queries.
        query_m: The queries.
        weights: Their weights (*batch, 14).

    Returns:
        The neighbours with their new distances, nearest first, and their yaws (*batch, k) in steps of the database, as
        `Database.turned` takes them; not reduced to one turn.
    """
    query, weight = prepare_query(query_m, weights)
    shape = neighbours.projection.shape
    row = np.ascontiguousarray(neighbours.row.reshape(-1, shape[-1]))
    yaw = neighbours.yaw_index.reshape(row.shape).astype(np.float64)
    projection = np.array(neighbours.projection).reshape(row.shape)
    distance = np.full(row.shape, np.inf)
    camera = database.camera
    _refine(
        query.reshape(-1, OP14.num_joints, 2).astype(np.float64),
        weight.reshape(-1, OP14.num_joints).astype(np.float64),
        database.poses_m,
        row,
        database.yaw_step_rad,
        np.array([np.cos(camera.pitch_rad), np.sin(camera.pitch_rad)]),
        projection,
        yaw,
        distance,
    )
    refined = replace(neighbours, projection=projection.reshape(shape), distance_m=distance.reshape(shape))
    return refined, yaw.reshape(shape)


@compiled()
def _cost(yaw: float, pose: Floats32, query: Array, weight: Array, total: float, rays: Array) -> float:
    """Return the metric between a query and a pose at a yaw; `rays`: cosine and sine of the pitch."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    summed = 0.0
    for joint in range(query.shape[0]):
        if weight[joint] <= 0:
            continue
        x = cosine * pose[joint, 0] + sine * pose[joint, 2]
        z = cosine * pose[joint, 2] - sine * pose[joint, 0]
        dx = query[joint, 0] - x
        dy = query[joint, 1] - (rays[0] * pose[joint, 1] - rays[1] * z)
        summed += weight[joint] * np.sqrt(dx * dx + dy * dy)
    return summed / total


@compiled()
def _refine(
    query: Array,
    weight: Array,
    poses: Floats32,
    row: Integers,
    step: float,
    rays: Array,
    projection: Integers,
    yaw: Array,
    distance: Array,
) -> None:
    """Refine `yaw` (in steps), write `distance`, and sort by distance; ties keep their order."""
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    width = 2.0 * step / (_NUM_PLACES - 1)
    for at in range(query.shape[0]):
        total = weight[at].sum()
        if total <= 0:
            continue
        for rank in range(row.shape[1]):
            if row[at, rank] < 0:
                continue
            pose = poses[row[at, rank]]
            start = yaw[at, rank] * step
            best = start
            least = _cost(start, pose, query[at], weight[at], total, rays)
            for place in range(_NUM_PLACES):
                here = start + (place - _NUM_PLACES // 2) * width
                cost = _cost(here, pose, query[at], weight[at], total, rays)
                if cost < least:
                    best, least = here, cost
            low, high = best - width, best + width
            a, b = high - golden * (high - low), low + golden * (high - low)
            cost_a = _cost(a, pose, query[at], weight[at], total, rays)
            cost_b = _cost(b, pose, query[at], weight[at], total, rays)
            for _ in range(_NUM_SECTIONS):
                if cost_a < cost_b:
                    high, b, cost_b = b, a, cost_a
                    a = high - golden * (high - low)
                    cost_a = _cost(a, pose, query[at], weight[at], total, rays)
                else:
                    low, a, cost_a = a, b, cost_b
                    b = low + golden * (high - low)
                    cost_b = _cost(b, pose, query[at], weight[at], total, rays)
            if min(cost_a, cost_b) < least:
                least = min(cost_a, cost_b)
                best = a if cost_a < cost_b else b
            to, number = rank, projection[at, rank]
            while to > 0 and distance[at, to - 1] > least:
                yaw[at, to], distance[at, to] = yaw[at, to - 1], distance[at, to - 1]
                projection[at, to] = projection[at, to - 1]
                to -= 1
            projection[at, to], yaw[at, to], distance[at, to] = number, best / step, least
