"""Coverage of real pairs by draws: C(G, S) of eq. 13 (Yin et al. 2018), as a running curve over the draws.

C is the mean over the real pairs G of the smallest dissimilarity to any draw in S, in D_I (interaction coordinates over
Delaunay tetrahedra), in D_C (mean joint distance after one proper rigid alignment of the pair) and in D_S (3D shape
contexts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import lower_minima, pair_table
from pasdedeux.interaction.shape_context import ShapeCoverage

_CHUNK = 512
"""Draws taken at a time: bounds the memory for their edges."""


@dataclass(frozen=True)
class CoverageCurve:
    """Coverage against the number of draws.

    Args:
        num_draws: Draws taken so far, (point,).
        interaction_m: C(G, S) in D_I, (point,), metres.
        cartesian_m: C(G, S) in D_C, (point,), metres.
        shape: C(G, S) in D_S, (point,), from 0 to 1.
        min_cartesian_m: Smallest D_C of each real pair to any of the draws, (truth,), metres; empty where not kept.
    """

    num_draws: npt.NDArray[np.int64]
    interaction_m: Array
    cartesian_m: Array
    shape: Array
    min_cartesian_m: Array = field(default_factory=lambda: np.empty(0))


class Coverage:
    """Running minima over draws that arrive in batches: memory does not grow with their number.

    Args:
        truth_m: Real pairs (truth, person=2, joint, 3), metres; at least one.

    Raises:
        InputError: There is no real pair, or a coordinate is not finite.
    """

    def __init__(self, truth_m: Array) -> None:
        if len(truth_m) == 0:
            raise InputError("coverage needs at least one real pair")
        self._truth = pair_table(truth_m)
        self._best = np.full((2, len(self._truth)), np.inf)
        self.num_draws = 0

    def add(self, draws_m: Array) -> None:
        """Take more draws (draw, person=2, joint, 3), metres, into account.

        Raises:
            InputError: A coordinate is not finite.
        """
        for start in range(0, len(draws_m), _CHUNK):
            part = pair_table(draws_m[start : start + _CHUNK])
            lower_minima(self._truth, part, self._best)
            self.num_draws += len(part)

    @property
    def interaction_m(self) -> Array:
        """Smallest D_I of each real pair to any draw so far, (truth,), metres; inf before the first."""
        return self._best[0].copy()

    @property
    def cartesian_m(self) -> Array:
        """Smallest D_C of each real pair to any draw so far, (truth,), metres; inf before the first."""
        return self._best[1].copy()


def coverage_curve(truth_m: Array, draws_m: Array, num_draws: Sequence[int]) -> CoverageCurve:
    """Return coverage of real pairs (truth, 2, joint, 3) after the first n draws (draw, 2, joint, 3), for several n.

    Args:
        truth_m: Real pairs, metres.
        draws_m: Draws in the order in which they are to count, metres.
        num_draws: Points of the curve; sorted, repeated ones and those beyond the draws there are dropped.

    Raises:
        InputError: There is no real pair, no point is between 1 and the number of draws, or a coordinate is not finite.
    """
    points = sorted({int(point) for point in num_draws if 1 <= point <= len(draws_m)})
    if not points:
        raise InputError(f"no point of the curve lies between 1 and the {len(draws_m)} draws")
    coverage, by_shape = Coverage(truth_m), ShapeCoverage(truth_m)
    interaction, cartesian, shape = [], [], []
    for point in points:
        by_shape.add(draws_m[coverage.num_draws : point])
        coverage.add(draws_m[coverage.num_draws : point])
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
