"""A tree of boxes over images of joints, for the images nearest to a query, including ties.

**Bound.**  Every node of the tree keeps, per joint k, the box [cx - hx, cx + hx] x [cy - hy, cy + hy] that holds joint
k of every projection below the node.  For a query q and a projection p below the node, |qx - px| >=
max(|qx - cx| - hx, 0) because px lies in an interval of half-width hx about cx, and likewise in y; so

    sum_k w_k |q_k - p_k|  >=  sum_k w_k sqrt(max(|qx - cx| - hx, 0)^2 + max(|qy - cy| - hy, 0)^2)

for all w_k >= 0.  The boxes are taken from the projections, so the bound holds for any pitch of the camera.  Median
splits where projections spread most, across frames and yaws alike, give far smaller boxes than one for all yaws of a
frame.  Boxes are widened and the bound is lowered by more than float32 rounding can raise it, so pruning never loses a
neighbour.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Floats32, Integers
from pasdedeux.compiled import compiled, inner_kernel

_LANES = 16
"""Projections per leaf and children per node, to fill the processor's vector unit."""
_ROUNDING = np.float32(1.0 - 1e-5)
"""Factor on the bound: 28 float32 operations of relative error 6e-8 each stay below 1e-5."""

Integers32 = npt.NDArray[np.int32]


class SearchTree(NamedTuple):
    """A tree of boxes; 16 projections of J joints per leaf, 16 children per node.

    Args:
        number: Number of the projection in each lane of each leaf (leaf, lane); -1 for none.
        leaves: Projections (leaf, 2 J, lane): x of the joints, then y; any values in empty lanes.
        centre: Middle of the boxes of the nodes under each node (node, 2 J, lane), all levels, root first.
        half: Their half-widths; -1 in empty lanes.
        level_start: First node of each level; child j of node i of level l is node lanes * i + j of level l + 1.
    """

    number: Integers32
    leaves: Floats32
    centre: Floats32
    half: Floats32
    level_start: Integers


def build_tree(flat: Floats32) -> SearchTree:
    """Return the tree of projections (n, 2 J), n at least 1: ordered by median splits, boxes bottom-up.

    Args:
        flat: Projections, x of the joints, then y, metres.
    """
    count, dims = flat.shape
    number = np.full(-(-count // _LANES) * _LANES, -1, dtype=np.int32)
    number[:count] = np.arange(count)
    _order_by_median_splits(flat, number[:count], _LANES)
    leaves = np.empty((len(number) // _LANES, dims, _LANES), dtype=np.float32)
    _fill_leaves(flat, number, leaves)
    boxes = [_boxes_above(leaves.min(axis=2), leaves.max(axis=2))]
    while len(boxes[-1].centre) > 1:
        boxes.append(_boxes_above(boxes[-1].low, boxes[-1].high))
    boxes.reverse()
    return SearchTree(
        number=number.reshape(-1, _LANES),
        leaves=leaves,
        centre=np.concatenate([level.centre for level in boxes]),
        half=np.concatenate([level.half for level in boxes]),
        level_start=np.cumsum([0, *(len(level.centre) for level in boxes)]),
    )


class _TreeLevel(NamedTuple):
    """Nodes of a level: the boxes under each (node, 2 J, lane), middle and half-width, and their own (node, 2 J)."""

    centre: Floats32
    half: Floats32
    low: Floats32
    high: Floats32


def _boxes_above(low: Floats32, high: Floats32) -> _TreeLevel:
    """Return the level above boxes (n, 2 J); empty lanes of its last node repeat the last box."""
    missing = -len(low) % _LANES
    low, high = (
        np.concatenate([ends, np.repeat(ends[-1:], missing, axis=0)]).reshape(-1, _LANES, ends.shape[1]).swapaxes(1, 2)
        for ends in (low, high)
    )
    middle = np.float32(0.5) * (low + high)
    # Add one part in a million to the rounded half-width, so that the box contains both ends.
    half = np.maximum(high - middle, middle - low) + np.float32(1e-6) * (np.abs(low) + np.abs(high))
    half[-1, :, _LANES - missing :] = -1.0
    return _TreeLevel(np.ascontiguousarray(middle), np.ascontiguousarray(half), low.min(axis=2), high.max(axis=2))


@compiled()
def _order_by_median_splits(flat: Floats32, order: Integers32, lanes: int) -> None:
    """Order projections so that every aligned run of lanes * 8^l of them is one cell of a median-split tree.

    Each range splits where its spread (variance) is greatest, at a power of two times the leaf size.
    """
    dims = flat.shape[1]
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
        part, values = order[first:last], np.empty(last - first, dtype=np.float32)
        for at in range(last - first):
            values[at] = flat[part[at], widest]
        _split(values, part, left)
        stack[depth, 0], stack[depth, 1] = first + left, last
        stack[depth + 1, 0], stack[depth + 1, 1] = first, first + left
        depth += 2


@inner_kernel()
def _split(values: Floats32, order: Integers32, left: int) -> None:
    """Order values and their numbers until none of the first `left` is greater than any other [Hoare 1961].

    Ties end up where `np.argpartition` in a kernel puts them, which takes 6 s to compile.
    """
    low, high = 0, len(values) - 1
    while True:
        middle = (low + high) >> 1
        # The pivot is the median of three.
        for lower, upper in ((low, middle), (middle, high), (low, middle)):
            if values[upper] < values[lower]:
                _swap(values, order, lower, upper)
        pivot = values[middle]
        _swap(values, order, middle, high)
        at, end = low, high - 1
        while True:
            while at < high and values[at] < pivot:
                at += 1
            while end >= low and pivot < values[end]:
                end -= 1
            if at >= end:
                break
            _swap(values, order, at, end)
            at += 1
            end -= 1
        _swap(values, order, at, high)
        if at == left:
            break
        if at < left:
            low = at + 1
        else:
            high = at - 1


@inner_kernel()
def _swap(values: Floats32, order: Integers32, one: int, other: int) -> None:
    values[one], values[other] = values[other], values[one]
    order[one], order[other] = order[other], order[one]


@compiled()
def _fill_leaves(flat: Floats32, number: Integers32, leaves: Floats32) -> None:
    """Copy projections into their leaves; empty lanes repeat the last projection."""
    lanes, last = leaves.shape[2], flat.shape[0] - 1
    for leaf in range(leaves.shape[0]):
        for lane in range(lanes):
            at = min(leaf * lanes + lane, last)
            for dim in range(leaves.shape[1]):
                leaves[leaf, dim, lane] = flat[number[at], dim]


@inner_kernel()
def _bounds(query: Floats32, weight: Floats32, centre: Floats32, half: Floats32, out: Floats32) -> None:
    """Write lower bounds on the weighted distance sums within the boxes of a node's children."""
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


@compiled()
def _distances(query: Floats32, weight: Floats32, leaf: Floats32, out: Floats32) -> None:
    """Write the weighted distance sums of the projections of a leaf, joint by joint as in the plain form."""
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
def _keep(numbers: Integers, summed: Floats32, number: int, value: np.float32) -> None:
    """Insert a projection into the sorted list of the best, ties by number; drop the last."""
    at = summed.shape[0] - 1
    if value > summed[at] or (value == summed[at] and numbers[at] >= 0 and number > numbers[at]):
        return
    while at > 0 and (summed[at - 1] > value or (summed[at - 1] == value and numbers[at - 1] > number)):
        summed[at] = summed[at - 1]
        numbers[at] = numbers[at - 1]
        at -= 1
    summed[at] = value
    numbers[at] = number


@compiled()
def search_tree(
    tree: SearchTree, queries: Floats32, weights: Floats32, num_neighbours: int
) -> tuple[Integers, Floats32]:
    """Return the numbers (n, k) of the best projections, ties by number, and their weighted sums of distances (n, k).

    Best-first: the node of least bound is opened next, until no bound beats the k-th best.

    Args:
        tree: Tree of projections of J joints.
        queries: Queries (n, 2 J), x of the joints, then y.
        weights: Weights (n, J), not negative; a query without any weight finds nothing.
        num_neighbours: k.

    Returns:
        Numbers, -1 where there is none, and sums, ascending, inf where there is none.
    """
    numbers = np.full((queries.shape[0], num_neighbours), -1, dtype=np.int64)
    summed = np.full((queries.shape[0], num_neighbours), np.inf, dtype=np.float32)
    num_levels = tree.level_start.shape[0] - 1
    lanes = tree.leaves.shape[2]
    lane_value = np.empty(lanes, dtype=np.float32)
    for at in range(queries.shape[0]):
        query, weight = queries[at], weights[at]
        if weight.sum() <= 0:
            continue
        best, best_number = summed[at], numbers[at]
        last = best.shape[0] - 1
        heap = [(np.float32(0.0), 0, 0)]
        while heap:
            bound, level, node = heapq.heappop(heap)
            if bound > best[last]:
                break
            if level == num_levels:
                _distances(query, weight, tree.leaves[node], lane_value)
                for lane in range(lanes):
                    if tree.number[node, lane] >= 0 and lane_value[lane] <= best[last]:
                        _keep(best_number, best, int(tree.number[node, lane]), lane_value[lane])
                continue
            inner = tree.level_start[level] + node
            _bounds(query, weight, tree.centre[inner], tree.half[inner], lane_value)
            for lane in range(lanes):
                lowered = lane_value[lane] * _ROUNDING
                if tree.half[inner, 0, lane] >= 0 and lowered <= best[last]:
                    heapq.heappush(heap, (lowered, level + 1, node * lanes + lane))
    return numbers, summed
