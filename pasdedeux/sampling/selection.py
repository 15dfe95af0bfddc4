"""Selection of representative pairs: greedy medoids among any number of pairs, in bounded memory.

Pairs are compared by D_C, by which coverage is judged.  A pair within a radius of a kept pair is dropped, and its
weight is added there.  If more are kept than there is room for, the radius doubles (Charikar et al. 2004), so that no
pair is farther than two radii from all that are kept.  Of these, time and again that one is chosen which most reduces
the mean distance of all pairs from the nearest chosen one (Nemhauser, Wolsey and Fisher 1978, by lazy evaluation as
Minoux 1978 has it): asking for more keeps the first ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heapify, heappop, heapreplace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.errors import InputError
from pasdedeux.interaction.kernels import best_turn, turned_gap
from pasdedeux.spread import evenly_spread

DUPLICATE_M = 0.02
"""D_C below which two pairs count as one: the error of an annotated joint."""
MIN_LOG_PRIOR = -200.0
"""Log prior below which a pair is not plausible: every joint 17 cm off, where sigma_p is 5 cm."""
MIN_ROOM = 16384
"""Least number of kept pairs: with more room the radius grows less, and frequent pairs are thinned out less."""
_ROOM_FOR_EACH = 4
_NUM_REPRESENTED = 1024
"""Most pairs whose mean distance from the chosen ones is reduced, evenly spread over the kept ones."""
_SLACK_M = 1e-9
"""Rounding error allowed for a bound."""


@dataclass(frozen=True)
class Selection:
    """Chosen pairs, in the order in which they were chosen.

    Args:
        index: Which of all the pairs that were added, (n,), from 0.
        distance_m: D_C to the nearest one chosen before, (n,), metres; inf for the first.
        weight: Sum of the weights of all pairs that are nearest to each, (n,).
        radius_m: Pairs nearer to each other than this, metres, counted as one.
    """

    index: npt.NDArray[np.int64]
    distance_m: Array
    weight: Array
    radius_m: float


class _Kept(NamedTuple):
    """Centred pairs (pair, n, 3), metres, with the distances of their joints from the centre (pair, n)."""

    points: Array
    lengths: Array
    weight: Array
    number: npt.NDArray[np.int64]


class PairSelector:
    """Selection of pairs that arrive in batches; it depends on their order, not on how they are cut into batches.

    Args:
        num_selected: Most pairs to choose.
        min_room: Room for pairs to choose from; there is more for very many.

    Raises:
        InputError: None is to be chosen.
    """

    def __init__(self, num_selected: int, *, min_room: int = MIN_ROOM) -> None:
        if num_selected < 1:
            raise InputError(f"{num_selected} pairs were asked for; at least 1 can be selected")
        self._num_selected = num_selected
        self._room = max(min_room, _ROOM_FOR_EACH * num_selected)
        self._radius_m = DUPLICATE_M
        self._kept: _Kept | None = None
        self._num_kept = self._num_added = 0

    def add(self, pairs_m: npt.NDArray[np.floating], weight: Array) -> npt.NDArray[np.bool_]:
        """Add pairs (pair, person=2, joint, 3), metres; return which differ from all before, (pair,).

        Args:
            pairs_m: Pairs, all with the same joints.
            weight: Weight of each, (pair,).

        Raises:
            InputError: A coordinate is not finite.
        """
        if not np.isfinite(pairs_m).all():
            raise InputError("pairs to select from have a coordinate that is not finite")
        points = np.asarray(pairs_m, dtype=np.float64).reshape(len(pairs_m), pairs_m.shape[1] * pairs_m.shape[2], 3)
        points = points - points.mean(axis=1, keepdims=True)
        number = self._num_added + np.arange(len(points))
        new = _kept(points, weight, number)
        if self._kept is None:
            empty = np.zeros(self._room + 1)
            self._kept = _kept(np.zeros((len(empty), *points.shape[1:])), empty, empty.astype(np.int64))
        is_new = np.zeros(len(points), dtype=bool)
        row = 0
        while row < len(points):
            row, self._num_kept = _keep(new, row, len(points), self._kept, self._num_kept, self._radius_m, is_new)
            while self._num_kept > self._room:
                self._radius_m *= 2.0
                scratch = np.zeros(self._num_kept, dtype=bool)
                _, self._num_kept = _keep(self._kept, 0, self._num_kept, self._kept, 0, self._radius_m, scratch)
        self._num_added += len(points)
        return is_new

    def selection(self) -> Selection:
        """Choose among the pairs so far; fewer than requested if fewer differ, none if there are none."""
        count = min(self._num_selected, self._num_kept)
        if self._kept is None or not count:
            return Selection(np.empty(0, dtype=np.int64), np.empty(0), np.empty(0), self._radius_m)
        points, lengths, weight, number = self._kept
        rows = slice(self._num_kept)
        kept = _Kept(points[rows], lengths[rows], weight[rows], number[rows])
        chosen, distance_m = _representatives(kept, count), np.empty(count)
        nearest = np.zeros(self._num_kept, dtype=np.int64)
        _compare_chosen(kept, chosen, distance_m, nearest)
        total = np.asarray(np.bincount(nearest, kept.weight, count), dtype=np.float64)
        return Selection(kept.number[chosen], distance_m, total, self._radius_m)


def _kept(points: Array, weight: Array, number: npt.NDArray[np.int64]) -> _Kept:
    return _Kept(np.ascontiguousarray(points), np.linalg.norm(points, axis=-1), np.array(weight, float), number)


def _representatives(kept: _Kept, count: int) -> npt.NDArray[np.int64]:
    """Return `count` rows, each the one that then most reduces the weighted mean distance from the nearest chosen."""
    represented = evenly_spread(len(kept.points), _NUM_REPRESENTED)
    apart = np.empty((len(kept.points), len(represented)), dtype=np.float32)
    _measure(kept, represented, apart)
    weight = kept.weight[represented]
    nearest = np.full(len(represented), apart.max(initial=0.0))

    def gain(row: int) -> float:
        return float(np.sum(weight * np.maximum(nearest - apart[row], 0.0)))

    # A gain never grows, so the first one that is still the greatest after it is computed anew is the greatest of all.
    waiting = [(-gain(row), row) for row in range(len(apart))]
    heapify(waiting)
    chosen = np.empty(count, dtype=np.int64)
    for place in range(count):
        while (known := (-gain(waiting[0][1]), waiting[0][1])) != waiting[0]:
            heapreplace(waiting, known)
        _, chosen[place] = heappop(waiting)
        nearest = np.minimum(nearest, apart[chosen[place]])
    return chosen


@compiled()
def _keep(new, row, stop, kept, count, radius_m, is_new):  # type: ignore[no-untyped-def]
    """Add rows of `new` until one too many is kept; return the next row and the number kept.

    `new` may be `kept` itself, emptied: a row is read before anything is written there.
    """
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    room, last = kept.points.shape[0] - 1, 0
    while row < stop and count <= room:
        nearest = -1
        if count and _is_within(radius_m, new, row, kept, last, key, m, q, rotmat):
            nearest = last
        other = 0
        while nearest < 0 and other < count:
            if _is_within(radius_m, new, row, kept, other, key, m, q, rotmat):
                nearest = other
            other += 1
        if nearest >= 0:
            kept.weight[nearest] += new.weight[row]
            last = nearest
        else:
            # Loops: in kernels, an array assigned to another takes seconds to compile, for its error message.
            for k in range(new.lengths.shape[1]):
                kept.lengths[count, k] = new.lengths[row, k]
                for axis in range(3):
                    kept.points[count, k, axis] = new.points[row, k, axis]
            kept.weight[count], kept.number[count] = new.weight[row], new.number[row]
            is_new[row] = True
            last = count
            count += 1
        row += 1
    return row, count


@inner_kernel()
def _is_within(limit_m, one, row, other, column, key, m, q, rotmat):  # type: ignore[no-untyped-def]
    return _least_gap(limit_m, one, row, other, column, key, m, q, rotmat) < limit_m


@inner_kernel()
def _least_gap(limit_m, one, row, other, column, key, m, q, rotmat):  # type: ignore[no-untyped-def]
    """Return D_C of two pairs, or infinity where a bound shows that it is not below a limit.

    The bound is the mean difference of the distances of their joints from the centre, which no turn changes.
    """
    first, second = one.lengths[row], other.lengths[column]
    num_points = len(first)
    bound, limit = 0.0, (limit_m + _SLACK_M) * num_points
    for k in range(num_points):
        bound += abs(first[k] - second[k])
        if bound > limit:
            return np.inf
    moving, fixed = one.points[row], other.points[column]
    best_turn(moving, fixed, key, m, q, rotmat)
    total = 0.0
    for k in range(num_points):
        u, v, w = turned_gap(rotmat, moving, fixed, k)
        total += np.sqrt(u * u + v * v + w * w)
    return total / num_points


@compiled()
def _measure(kept, columns, apart):  # type: ignore[no-untyped-def]
    """Write D_C of every row and some (row, column)."""
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    for row in range(apart.shape[0]):
        for column in range(apart.shape[1]):
            apart[row, column] = _least_gap(np.inf, kept, row, kept, columns[column], key, m, q, rotmat)


@compiled()
def _compare_chosen(kept, chosen, distance_m, nearest):  # type: ignore[no-untyped-def]
    """Write how far each chosen row is from those before, and the chosen one nearest to each row."""
    key, m, q, rotmat = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    count = kept.points.shape[0]
    gap = np.full(count, np.inf)
    for place in range(len(chosen)):
        latest = chosen[place]
        distance_m[place] = gap[latest]
        for row in range(count):
            distance = _least_gap(gap[row], kept, row, kept, latest, key, m, q, rotmat)
            if distance < gap[row]:
                gap[row], nearest[row] = distance, place
        gap[latest], nearest[latest] = 0.0, place
