"""Coverage of real pairs by draws: C(G, S) of eq. 13 (Yin et al. 2018), as a running curve over the draws.

C is the mean over the real pairs G of the smallest dissimilarity to any draw in S, in D_I (interaction coordinates over
Delaunay tetrahedra), in D_C (mean joint distance after one proper rigid alignment of the pair) and in D_S (3D shape
contexts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import Coverage
from pasdedeux.interaction.shape_context import ShapeCoverage


@dataclass(frozen=True)
class CoverageCurve:
    """Coverage against the number of draws.

    Args:
        num_draws: Draws taken so far, (point,).
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
    points = sorted({int(point) for point in num_draws if 1 <= point <= len(draws_m)})
    if not points:
        raise InputError(f"no point of the curve lies between 1 and the {len(draws_m)} draws")
    is_new = _is_first(draws_m)
    coverage, by_shape = Coverage(real_m), ShapeCoverage(real_m)
    interaction, cartesian, shape = [], [], []
    for start, point in pairwise([0, *points]):
        part = draws_m[start:point][is_new[start:point]]
        by_shape.add(part)
        coverage.add(part)
        shape.append(float(by_shape.shape.mean()))
        interaction.append(float(coverage.interaction_m.mean()))
        cartesian.append(float(coverage.cartesian_m.mean()))
    return CoverageCurve(
        num_draws=np.array(points, dtype=np.int64),
        interaction_m=np.array(interaction),
        cartesian_m=np.array(cartesian),
        shape=np.array(shape),
        min_cartesian_m=coverage.cartesian_m,
    )


def _is_first(draws_m: Array) -> npt.NDArray[np.bool_]:
    """Return which draws (draw, ...) are not there before, (draw,): a chain that stays repeats its draw."""
    rows = np.ascontiguousarray(draws_m).reshape(len(draws_m), -1)
    whole = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    is_first = np.zeros(len(rows), dtype=bool)
    is_first[np.unique(whole, return_index=True)[1]] = True
    return is_first
