"""A tree of boxes over points that are images of joints: the points nearest to a query, ties included.

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

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.compiled import compiled

_LANES = 16
"""Projections a leaf and children a node: wide enough for the processor's vector unit."""
_ROUNDING = np.float32(1.0 - 1e-5)
"""Factor on the bound: 28 float32 operations of relative error 6e-8 each stay below 1e-5."""

Floats32 = npt.NDArray[np.float32]
Integers32 = npt.NDArray[np.int32]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tree:
    """A tree of boxes; 16 projections of J joints a leaf, 16 children a node.

    Args:
        number: Number of the projection in each lane of each leaf (leaf, lane); -1 for none.
        leaves: Projections (leaf, 2 J, lane): x of the joints, then y; far away in empty lanes.
        centre: Middle of the boxes of the nodes under each node (node, 2 J, lane), all levels, root first.
        half: Their half-widths; -1 in empty lanes.
        level_start: First node of each level; child j of node i of level l is node lanes * i + j of level l + 1.
    """

    number: Integers32
    leaves: Floats32
    centre: Floats32
    half: Floats32
    level_start: Integers


def build_tree(flat: Floats32) -> Tree:
    """Return the tree of projections (n, 2 J), n at least 1: ordered by median splits, boxes bottom-up.

    Args:
        flat: Projections, x of the joints, then y, metres.
    """
    count, dims = flat.shape
    order = np.arange(count, dtype=np.int32)
    _order_by_median_splits(flat, order, _LANES)
    num_leaves = -(-count // _LANES)
    number = np.full(num_leaves * _LANES, -1, dtype=np.int32)
    number[:count] = order
    leaves = np.full((num_leaves, dims, _LANES), np.float32(1e18), dtype=np.float32)
    low = np.empty((num_leaves, dims), dtype=np.float32)
    high = np.empty_like(low)
    _fill_leaves(flat, number, leaves, low, high)
    centres, halves = [], []
    while True:
        num_nodes = -(-len(low) // _LANES)
        centre = np.zeros((num_nodes, dims, _LANES), dtype=np.float32)
        half = np.full((num_nodes, dims, _LANES), -1.0, dtype=np.float32)
        low, high = _fill_nodes(low, high, centre, half)
        centres.append(centre)
        halves.append(half)
        if num_nodes == 1:
            break
    sizes = [len(centre) for centre in reversed(centres)]
    return Tree(
        number=number.reshape(num_leaves, _LANES),
        leaves=leaves,
        centre=np.concatenate(centres[::-1]),
        half=np.concatenate(halves[::-1]),
        level_start=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
    )


def search_tree(tree: Tree, query: Floats32, weight: Floats32, *, num_neighbours: int) -> tuple[Integers, Floats32]:
    """Return the numbers (n, k) of the best projections, ties by number, and their weighted sums of distances (n, k).

    Args:
        tree: Tree of projections of J joints.
        query: Queries (n, 2 J), x of the joints, then y.
        weight: Weights (n, J), not negative; a query without any weight finds nothing.
        num_neighbours: k.

    Returns:
        Numbers, -1 where there is none, and sums, ascending, inf where there is none.
    """
    found = np.full((len(query), num_neighbours), -1, dtype=np.int64)
    summed = np.full((len(query), num_neighbours), np.inf, dtype=np.float32)
    _search(query, weight, tree.number, tree.leaves, tree.centre, tree.half, tree.level_start, found, summed)
    return found, summed


@compiled()
def select(values: Floats32, order: Integers32, first: int, last: int, middle: int) -> None:
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


@compiled()
def _order_by_median_splits(flat: Floats32, order: Integers32, lanes: int) -> None:
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
        select(values, order, first, last, first + left)
        stack[depth, 0], stack[depth, 1] = first + left, last
        stack[depth + 1, 0], stack[depth + 1, 1] = first, first + left
        depth += 2


@compiled()
def _fill_leaves(flat: Floats32, number: Integers32, leaves: Floats32, low: Floats32, high: Floats32) -> None:
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


@compiled()
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


@compiled(error_model="numpy")
def _bounds(query: Floats32, weight: Floats32, centre: Floats32, half: Floats32, out: Floats32) -> None:
    """Return the least weighted distance sums that the boxes of a node's children allow."""
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


@compiled(error_model="numpy")
def _distances(query: Floats32, weight: Floats32, leaf: Floats32, out: Floats32) -> None:
    """Return the weighted distance sums of the projections of a leaf, joint by joint as the plain form does."""
    joints, lanes = weight.shape[0], leaf.shape[1]
    for lane in range(lanes):
        out[lane] = np.float32(0.0)
    for joint in range(joints):
        w, qx, qy = weight[joint], query[joint], query[joint + joints]
        for lane in range(lanes):
            dx = qx - leaf[joint, lane]
            dy = qy - leaf[joint + joints, lane]
            out[lane] += w * np.sqrt(dx * dx + dy * dy)


@compiled()
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


@compiled()
def _search(
    queries: Floats32,
    weights: Floats32,
    number: Integers32,
    leaves: Floats32,
    centre: Floats32,
    half: Floats32,
    level_start: Integers,
    found: Integers,
    summed: Floats32,
) -> None:
    """Search each query best-first: the node of least bound is opened next, until no bound beats the k-th best."""
    num_levels = level_start.shape[0] - 1
    lanes = leaves.shape[2]
    lane_value = np.empty(lanes, dtype=np.float32)
    for at in range(queries.shape[0]):
        query, weight = queries[at], weights[at]
        if weight.sum() <= 0:
            continue
        best, best_number = summed[at], found[at]
        last = best.shape[0] - 1
        heap = [(np.float32(0.0), 0, 0)]
        while heap:
            bound, level, node = heapq.heappop(heap)
            if bound > best[last]:
                break
            if level == num_levels:
                _distances(query, weight, leaves[node], lane_value)
                for lane in range(lanes):
                    if number[node, lane] >= 0 and lane_value[lane] <= best[last]:
                        _keep(best_number, best, int(number[node, lane]), lane_value[lane])
                continue
            inner = level_start[level] + node
            _bounds(query, weight, centre[inner], half[inner], lane_value)
            for lane in range(lanes):
                lowered = lane_value[lane] * _ROUNDING
                if half[inner, 0, lane] >= 0 and lowered <= best[last]:
                    heapq.heappush(heap, (lowered, level + 1, node * lanes + lane))
