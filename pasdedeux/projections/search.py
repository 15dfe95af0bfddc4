"""Exact search of a projection database by the published metric, with joint masks and confidence weights.

The metric is eq. 1 of Yiannakides et al. 2019, the sum over joints of the 2D joint distances, with a weight per joint
(confidence; 0 where the joint was not seen) and divided by the sum of the weights, so that queries with different
joints missing compare.

`search_brute_force` is the plain form and the oracle.  `ProjectionIndex` gives the same answers, ties included, from a
tree of boxes:

**Bound.**  Every node of the tree keeps, per joint k, the box [cx - hx, cx + hx] x [cy - hy, cy + hy] that holds joint
k of every projection below the node.  For a query q and a projection p below the node, |qx - px| >=
max(|qx - cx| - hx, 0) because px lies in an interval of half-width hx about cx, and likewise in y; so

    sum_k w_k |q_k - p_k|  >=  sum_k w_k sqrt(max(|qx - cx| - hx, 0)^2 + max(|qy - cy| - hy, 0)^2)

for all w_k >= 0.  Nothing is assumed of the camera: the boxes are taken from the projections themselves, so the bound
holds for orthographic, pitched and pinhole cameras alike.  (For a level orthographic camera and the node "all yaws of
a frame" the box is [-r, r] x [y, y], which is the bound sqrt(max(|qx| - r, 0)^2 + dy^2) of one frame; splitting by
median where the projections spread most, across frames and yaws alike, gives far smaller boxes.)  Boxes are widened
and the bound is lowered by more than float32 rounding can raise it, so pruning never loses a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.skeletons import OP14

__all__ = ["Neighbours", "ProjectionIndex", "build_index", "prepare_query", "search_brute_force"]

_JOINTS = OP14.num_joints
_LANES = 16
"""Projections a leaf and children a node: wide enough for the processor's vector unit."""
_ROUNDING = np.float32(1.0 - 1e-5)
"""Factor on the bound: 14 float32 operations of relative error 6e-8 each stay below 1e-5."""

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


def prepare_query(query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> tuple[Floats32, Floats32]:
    """Give queries (*batch, 14, 2) and weights (*batch, 14) in float32, weight 0 where a joint is not finite.

    Raises:
        InputError: Wrong shapes, or a weight that is negative or not finite.
    """
    query = np.array(query_m, dtype=np.float32)
    if query.shape[-2:] != (_JOINTS, 2):
        raise InputError(f"query has shape {query.shape}, expected (..., {_JOINTS}, 2) metres about the mid-hip")
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


def search_brute_force(
    database: Database, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_neighbours: int = 50
) -> Neighbours:
    """Give the nearest projections by looking at all of them: the plain form, kept as oracle.

    Args:
        database: Database of n projections.
        query_m: Queries (*batch, 14, 2), metres, x right, y up, mid-hip at the origin; NaN where not seen.
        weights: Weights (*batch, 14) of the joints, 1 when not given.
        num_neighbours: Neighbours k wanted.

    Returns:
        Neighbours (*batch, k), ties by projection number; none where no joint was seen.
    """
    query, weight = prepare_query(query_m, weights)
    projections = database.project().reshape(-1, _JOINTS, 2)
    flat_query, flat_weight = query.reshape(-1, _JOINTS, 2), weight.reshape(-1, _JOINTS)
    found = np.full((len(flat_query), num_neighbours), -1, dtype=np.int64)
    distance = np.full((len(flat_query), num_neighbours), np.inf)
    for number, (one, joint_weight) in enumerate(zip(flat_query, flat_weight, strict=True)):
        total = _total(joint_weight)
        if total <= 0:
            continue
        summed = np.zeros(len(projections), dtype=np.float32)
        for joint in range(_JOINTS):
            dx = one[joint, 0] - projections[:, joint, 0]
            dy = one[joint, 1] - projections[:, joint, 1]
            summed += joint_weight[joint] * np.sqrt(dx * dx + dy * dy)
        count = min(num_neighbours, len(summed))
        cut = np.partition(summed, count - 1)[count - 1]
        near = np.flatnonzero(summed <= cut)
        order = near[np.lexsort((near, summed[near]))][:count]
        found[number, :count] = order
        distance[number, :count] = summed[order].astype(np.float64) / total
    shape = (*query.shape[:-2], num_neighbours)
    return Neighbours(found.reshape(shape), distance.reshape(shape), database.num_yaws)


@dataclass(frozen=True)
class ProjectionIndex:
    """A tree of boxes over all projections of a database; 16 projections a leaf, 16 children a node.

    Args:
        num_yaws: Yaw steps of the database.
        number: Projection number of each lane of each leaf (leaf, lane); -1 for an empty lane.
        leaves: Projections (leaf, 28, lane): x of the joints, then y; far away in empty lanes.
        centre: Middle of the boxes of the nodes under each node (node, 28, lane), all levels, root first.
        half: Their half-widths; -1 in empty lanes.
        level_start: First node of each level; child j of node i of level l is node lanes * i + j of level l + 1.
    """

    num_yaws: int
    number: Integers
    leaves: Floats32
    centre: Floats32
    half: Floats32
    level_start: Integers

    def search(
        self, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_neighbours: int = 50
    ) -> Neighbours:
        """Give exactly what `search_brute_force` gives; one query or a batch of them."""
        query, weight = prepare_query(query_m, weights)
        flat_query = np.ascontiguousarray(np.swapaxes(query.reshape(-1, _JOINTS, 2), 1, 2)).reshape(-1, 2 * _JOINTS)
        flat_weight = weight.reshape(-1, _JOINTS)
        found = np.full((len(flat_query), num_neighbours), -1, dtype=np.int64)
        summed = np.full((len(flat_query), num_neighbours), np.inf, dtype=np.float32)
        _search_batch(
            flat_query,
            np.ascontiguousarray(flat_weight),
            self.number,
            self.leaves,
            self.centre,
            self.half,
            self.level_start,
            found,
            summed,
        )
        total = np.array([_total(row) for row in flat_weight])[:, None]
        distance = np.full(summed.shape, np.inf)
        np.divide(summed.astype(np.float64), total, out=distance, where=total > 0)
        shape = (*query.shape[:-2], num_neighbours)
        return Neighbours(found.reshape(shape), distance.reshape(shape), self.num_yaws)


def build_index(database: Database) -> ProjectionIndex:
    """Give the exact search tree of a database: projections ordered by median splits, boxes bottom-up."""
    count = database.num_projections
    flat = np.empty((count, 2 * _JOINTS), dtype=np.float32)
    step = max(1, 100_000 // database.num_yaws)
    for first in range(0, database.num_rows, step):
        part = database.project(first, first + step).reshape(-1, _JOINTS, 2)
        begin = first * database.num_yaws
        flat[begin : begin + len(part), :_JOINTS] = part[..., 0]
        flat[begin : begin + len(part), _JOINTS:] = part[..., 1]
    order = np.arange(count, dtype=np.int64)
    _order_by_median_splits(flat, order, _LANES)
    num_leaves = -(-count // _LANES)
    number = np.full(num_leaves * _LANES, -1, dtype=np.int64)
    number[:count] = order
    leaves = np.full((num_leaves, 2 * _JOINTS, _LANES), np.float32(1e18), dtype=np.float32)
    low = np.empty((num_leaves, 2 * _JOINTS), dtype=np.float32)
    high = np.empty_like(low)
    _fill_leaves(flat, number, leaves, low, high)
    centres, halves = [], []
    while True:
        num_nodes = -(-len(low) // _LANES)
        centre = np.zeros((num_nodes, 2 * _JOINTS, _LANES), dtype=np.float32)
        half = np.full((num_nodes, 2 * _JOINTS, _LANES), -1.0, dtype=np.float32)
        low, high = _fill_nodes(low, high, centre, half)
        centres.append(centre)
        halves.append(half)
        if num_nodes == 1:
            break
    sizes = [len(centre) for centre in reversed(centres)]
    return ProjectionIndex(
        num_yaws=database.num_yaws,
        number=number.reshape(num_leaves, _LANES),
        leaves=leaves,
        centre=np.concatenate(centres[::-1]),
        half=np.concatenate(halves[::-1]),
        level_start=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
    )


def _total(weight: Floats32) -> float:
    """Sum the weights of one query the same way for every form of the search."""
    return float(np.sum(weight, dtype=np.float64))


@numba.njit(cache=True, nogil=True)
def _select(values: Floats32, order: Integers, first: int, last: int, middle: int) -> None:
    """Reorder `order[first:last]` so that positions before `middle` hold the least values (Hoare's selection)."""
    low, high = first, last - 1
    while low < high:
        a, b, c = values[order[low]], values[order[(low + high) // 2]], values[order[high]]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@numba.njit(cache=True, nogil=True)
def _order_by_median_splits(flat: Floats32, order: Integers, lanes: int) -> None:
    """Order projections so that every aligned run of lanes * 8^l of them is one cell of a median-split tree.

    Each range splits where its spread (variance) is greatest, at a power of two times the leaf size.
    """
    dims = flat.shape[1]
    values = np.empty(len(order), dtype=np.float32)
    stack = np.empty((128, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = 0, len(order)
    depth = 1
    total = np.empty(dims, dtype=np.float64)
    square = np.empty(dims, dtype=np.float64)
    while depth > 0:
        depth -= 1
        first, last = stack[depth, 0], stack[depth, 1]
        if last - first <= lanes:
            continue
        total[:] = 0.0
        square[:] = 0.0
        step = max(1, (last - first) // 2048)
        count = 0
        for at in range(first, last, step):
            row = order[at]
            count += 1
            for dim in range(dims):
                value = np.float64(flat[row, dim])
                total[dim] += value
                square[dim] += value * value
        widest, spread = 0, -1.0
        for dim in range(dims):
            variance = square[dim] / count - (total[dim] / count) ** 2
            if variance > spread:
                widest, spread = dim, variance
        left = lanes
        while 2 * left < last - first:
            left *= 2
        for at in range(first, last):
            values[order[at]] = flat[order[at], widest]
        _select(values, order, first, last, first + left)
        stack[depth, 0], stack[depth, 1] = first + left, last
        stack[depth + 1, 0], stack[depth + 1, 1] = first, first + left
        depth += 2


@numba.njit(cache=True, nogil=True)
def _fill_leaves(flat: Floats32, number: Integers, leaves: Floats32, low: Floats32, high: Floats32) -> None:
    """Copy projections into their leaves and take the leaves' boxes."""
    lanes = leaves.shape[2]
    for leaf in range(leaves.shape[0]):
        for dim in range(leaves.shape[1]):
            least, greatest = np.float32(np.inf), np.float32(-np.inf)
            for lane in range(lanes):
                row = number[leaf * lanes + lane]
                if row >= 0:
                    value = flat[row, dim]
                    leaves[leaf, dim, lane] = value
                    least = min(least, value)
                    greatest = max(greatest, value)
            low[leaf, dim] = least
            high[leaf, dim] = greatest


@numba.njit(cache=True, nogil=True)
def _fill_nodes(low: Floats32, high: Floats32, centre: Floats32, half: Floats32) -> tuple[Floats32, Floats32]:
    """Put the boxes of a level into the lanes of its parents, and give the parents' own boxes."""
    nodes, dims, lanes = centre.shape
    parent_low = np.full((nodes, dims), np.float32(np.inf), dtype=np.float32)
    parent_high = np.full((nodes, dims), np.float32(-np.inf), dtype=np.float32)
    for node in range(nodes):
        for lane in range(lanes):
            child = node * lanes + lane
            if child >= low.shape[0]:
                continue
            for dim in range(dims):
                least, greatest = low[child, dim], high[child, dim]
                middle = np.float32(0.5) * (least + greatest)
                centre[node, dim, lane] = middle
                # One part in a million more than the rounded half-width: the box still holds both ends.
                reach = max(greatest - middle, middle - least)
                half[node, dim, lane] = reach + np.float32(1e-6) * (abs(least) + abs(greatest))
                parent_low[node, dim] = min(parent_low[node, dim], least)
                parent_high[node, dim] = max(parent_high[node, dim], greatest)
    return parent_low, parent_high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bounds(query: Floats32, weight: Floats32, centre: Floats32, half: Floats32, out: Floats32) -> None:
    """Give the least weighted distance sums that the boxes of a node's children allow."""
    joints, lanes = weight.shape[0], centre.shape[1]
    zero = np.float32(0.0)
    for lane in range(lanes):
        out[lane] = zero
    for joint in range(joints):
        w, qx, qy = weight[joint], query[joint], query[joint + joints]
        for lane in range(lanes):
            dx = max(abs(qx - centre[joint, lane]) - half[joint, lane], zero)
            dy = max(abs(qy - centre[joint + joints, lane]) - half[joint + joints, lane], zero)
            out[lane] += w * np.sqrt(dx * dx + dy * dy)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distances(query: Floats32, weight: Floats32, leaf: Floats32, out: Floats32) -> None:
    """Give the weighted distance sums of the projections of a leaf, joint by joint as the plain form does."""
    joints, lanes = weight.shape[0], leaf.shape[1]
    for lane in range(lanes):
        out[lane] = np.float32(0.0)
    for joint in range(joints):
        w, qx, qy = weight[joint], query[joint], query[joint + joints]
        for lane in range(lanes):
            dx = qx - leaf[joint, lane]
            dy = qy - leaf[joint + joints, lane]
            out[lane] += w * np.sqrt(dx * dx + dy * dy)


@numba.njit(cache=True, nogil=True)
def _keep(found: Integers, summed: Floats32, number: int, value: np.float32) -> None:
    """Insert a projection into a sorted list of the best, ties by number; drops the last."""
    at = summed.shape[0] - 1
    if value > summed[at] or (value == summed[at] and found[at] >= 0 and number > found[at]):
        return
    while at > 0 and (summed[at - 1] > value or (summed[at - 1] == value and found[at - 1] > number)):
        summed[at] = summed[at - 1]
        found[at] = found[at - 1]
        at -= 1
    summed[at] = value
    found[at] = number


@numba.njit(cache=True, nogil=True)
def _search_batch(
    queries: Floats32,
    weights: Floats32,
    number: Integers,
    leaves: Floats32,
    centre: Floats32,
    half: Floats32,
    level_start: Integers,
    found: Integers,
    summed: Floats32,
) -> None:
    """Search each query best-first: the node of least bound is opened next, until no bound beats the k-th best."""
    num_levels = level_start.shape[0] - 1
    capacity = 4096
    heap_bound = np.empty(capacity, dtype=np.float32)
    heap_node = np.empty(capacity, dtype=np.int64)
    heap_level = np.empty(capacity, dtype=np.int64)
    lanes = leaves.shape[2]
    lane_value = np.empty(lanes, dtype=np.float32)
    for at in range(queries.shape[0]):
        query, weight = queries[at], weights[at]
        if weight.sum() <= 0:
            continue
        best, best_number = summed[at], found[at]
        last = best.shape[0] - 1
        heap_bound[0], heap_node[0], heap_level[0] = np.float32(0.0), 0, 0
        size = 1
        while size > 0:
            bound, node, level = heap_bound[0], heap_node[0], heap_level[0]
            if bound > best[last]:
                break
            size -= 1
            _sift_down(heap_bound, heap_node, heap_level, size)
            if level == num_levels:
                _distances(query, weight, leaves[node], lane_value)
                for lane in range(lanes):
                    if number[node, lane] >= 0 and lane_value[lane] <= best[last]:
                        _keep(best_number, best, number[node, lane], lane_value[lane])
                continue
            inner = level_start[level] + node
            _bounds(query, weight, centre[inner], half[inner], lane_value)
            if size + lanes >= capacity:
                capacity *= 2
                heap_bound = _grown(heap_bound, capacity)
                heap_node = _grown(heap_node, capacity)
                heap_level = _grown(heap_level, capacity)
            for lane in range(lanes):
                lowered = lane_value[lane] * _ROUNDING
                if half[inner, 0, lane] >= 0 and lowered <= best[last]:
                    _sift_up(heap_bound, heap_node, heap_level, size, lowered, node * lanes + lane, level + 1)
                    size += 1


@numba.njit(cache=True, nogil=True)
def _grown(array: npt.NDArray, capacity: int) -> npt.NDArray:
    """Give a longer copy of an array."""
    longer = np.empty(capacity, dtype=array.dtype)
    longer[: array.shape[0]] = array
    return longer


@numba.njit(cache=True, nogil=True)
def _sift_up(
    bound: Floats32, node: Integers, level: Integers, at: int, value: np.float32, new_node: int, new_level: int
) -> None:
    """Put an entry into a binary heap of `at` entries."""
    while at > 0:
        parent = (at - 1) // 2
        if bound[parent] <= value:
            break
        bound[at], node[at], level[at] = bound[parent], node[parent], level[parent]
        at = parent
    bound[at], node[at], level[at] = value, new_node, new_level


@numba.njit(cache=True, nogil=True)
def _sift_down(bound: Floats32, node: Integers, level: Integers, size: int) -> None:
    """Replace the top of a binary heap by its last entry, number `size`, and restore the order."""
    value, moved, moved_level = bound[size], node[size], level[size]
    at = 0
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and bound[child + 1] < bound[child]:
            child += 1
        if bound[child] >= value:
            break
        bound[at], node[at], level[at] = bound[child], node[child], level[child]
        at = child
    bound[at], node[at], level[at] = value, moved, moved_level
