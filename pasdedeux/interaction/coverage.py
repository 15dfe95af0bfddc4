"""Coverage of real pairs by draws: C(G, S) of eq. 13 (Yin et al. 2018), as a running curve over the draws.

C is the mean over the real pairs G of the smallest dissimilarity to any draw in S, in D_I (interaction coordinates over
Delaunay tetrahedra), in D_C (mean joint distance after one proper rigid alignment of the pair) and in D_S (3D shape
contexts).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import Coverage, PairTable, pair_table
from pasdedeux.interaction.shape_context import Bins, ShapeCoverage, shape_bins

_CHUNK = 512
"""Draws prepared at a time; limits the memory for their edges."""


@dataclass(frozen=True)
class CoverageCurve:
    """Coverage against the number of draws.

    Args:
        num_draws: Number of draws so far, (point,).
        interaction_m: C(G, S) in D_I, (point,), metres.
        cartesian_m: C(G, S) in D_C, (point,), metres.
        shape: C(G, S) in D_S, (point,), from 0 to 1.
        min_cartesian_m: Smallest D_C of each real pair to any of the draws, (real,), metres; empty where not kept.
    """

    num_draws: npt.NDArray[np.int64]
    interaction_m: Array
    cartesian_m: Array
    shape: Array
    min_cartesian_m: Array = field(default_factory=lambda: np.empty(0))


def coverage_curve(real_m: Array, draws_m: Array, num_draws: Sequence[int]) -> CoverageCurve:
    """Return coverage of real pairs (real, 2, joint, 3) after the first n draws (draw, 2, joint, 3), for several n.

    Args:
        real_m: Real pairs, metres.
        draws_m: Draws in the order in which they are to count, metres.
        num_draws: Points of the curve; sorted, repeated ones and those beyond the draws there are dropped.

    Raises:
        InputError: There is no real pair, no point is between 1 and the number of draws, or a coordinate is not finite.
    """
    return curve_of_parts(real_m, draw_parts(draws_m, num_draws))


class DrawPart(NamedTuple):
    """Some of the draws, prepared: 12 kB each.

    Args:
        table: For D_I and D_C.
        bins: For D_S.
        point: Number of draws so far if the curve has a point here; else 0.
    """

    table: PairTable
    bins: Bins
    point: int


def draw_parts(draws_m: Array, num_draws: Sequence[int]) -> Iterator[DrawPart]:
    """Yield the input of `curve_of_parts`, a few hundred draws at a time; for the arguments see `coverage_curve`."""
    points = sorted({int(point) for point in num_draws if 1 <= point <= len(draws_m)})
    if not points:
        raise InputError(f"no point of the curve lies between 1 and the {len(draws_m)} draws")
    is_new = _is_first(draws_m)
    for start, point in pairwise([0, *points]):
        new = draws_m[start:point][is_new[start:point]]
        for at in range(0, max(len(new), 1), _CHUNK):
            part = new[at : at + _CHUNK]
            yield DrawPart(pair_table(part), shape_bins(part), point if at + _CHUNK >= len(new) else 0)


def curve_of_parts(real_m: Array, parts: Iterable[DrawPart]) -> CoverageCurve:
    """Return the result of `coverage_curve` for draws that `draw_parts` prepared."""
    coverage, by_shape = Coverage(real_m), ShapeCoverage(real_m)
    points, curves = list[int](), list[list[float]]()
    for part in parts:
        by_shape.add(part.bins)
        coverage.add(part.table)
        if part.point:
            points.append(part.point)
            curves.append(
                [float(curve.mean()) for curve in (coverage.interaction_m, coverage.cartesian_m, by_shape.shape)]
            )
    interaction_m, cartesian_m, shape = np.transpose(curves)
    return CoverageCurve(np.array(points, dtype=np.int64), interaction_m, cartesian_m, shape, coverage.cartesian_m)


def _is_first(draws_m: Array) -> npt.NDArray[np.bool_]:
    """Return which draws (draw, ...) are the first of their value, (draw,): a chain that stays repeats its draw."""
    rows = merge_axes(np.ascontiguousarray(draws_m), 1)
    whole = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    is_first = np.zeros(len(rows), dtype=bool)
    is_first[np.unique(whole, return_index=True)[1]] = True
    return is_first
