"""Filling: new pairs between grown pairs that are alike.

Growth gives one pair for each annotation and leaves gaps between them.  A filled pair is a random mean of a grown pair
and its nearest pairs by D_C.  The mean is taken over the parameters of the grown pair (turns of bones, changes of
lengths, places of roots), so that it is a body again; errors of single pairs average out.  Implausible means and near
duplicates are refused.  Our own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.interaction.nearest import cartesian_distances
from pasdedeux.kinematics import align_rigid
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.prior import DEFAULT_PRIOR, PriorSettings
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import PairSelector

NUM_PARENTS = 7
"""Number of pairs in a mean: a grown pair and its six nearest ones."""
MIN_FILLED_LOG_PRIOR = -100.0
"""Log prior below which a filled pair is refused: half of the limit for selected pairs."""
_CONCENTRATION = 0.7
"""Concentration of the Dirichlet distribution of the weights: below 1, a few parents dominate."""
_NUM_ROWS = 500
"""Number of pairs whose distances to all others are in memory together: 80 MB for 10,000 others."""
_MAX_TRIES = 20
"""Most means drawn per requested pair."""
_MIN_KEPT_SHARE = 0.05
"""Filling ends after a round over all pairs that keeps a smaller share of its means: the gaps are filled."""


@dataclass(frozen=True)
class Filling:
    """Filled pairs in the order in which they were drawn.

    Args:
        pairs_m: Pairs (n, person=2, joint=17, 3), metres, gauge-fixed.
        parents: Rows of the pairs that each is a mean of, the one whose parameters were used first, (n, 7).
        weights: Weights of the parents, (n, 7), summing to 1.
        log_prior: Log of eq. 2 (Yin et al. 2018) with the pair's own bone lengths, (n,).
        num_refused: Means that were not plausible, or nearly equal to an existing pair.
    """

    pairs_m: Array
    parents: npt.NDArray[np.int64]
    weights: Array
    log_prior: Array
    num_refused: int


def pairs_between(
    pairs_m: Array,
    num: int,
    rng: np.random.Generator,
    limits: JointLimits,
    prior: PriorSettings = DEFAULT_PRIOR,
) -> Filling:
    """Return up to `num` pairs between pairs (pair, person=2, joint=17, 3), metres.

    Each pair is used equally often, in turn.  There are fewer than requested where most means are refused, and
    none where there are fewer pairs than a mean is made of.
    """
    count = len(pairs_m)
    if count < NUM_PARENTS:
        none = np.zeros((0, NUM_PARENTS))
        return Filling(pairs_m[:0], none.astype(np.int64), none, np.zeros(0), 0)
    parents = _with_nearest(pairs_m)
    charts = [PairChart(pair) for pair in pairs_m]
    parameters = [_parameters(chart, pairs_m[rows]) for chart, rows in zip(charts, parents, strict=True)]
    selector = PairSelector(1, min_room=count + num)
    selector.add(pairs_m, np.ones(count))
    rounds: list[tuple[npt.NDArray[Any], ...]] = []
    num_filled = num_tried = 0
    is_full = False
    while num_filled < num and num_tried < _MAX_TRIES * num and not is_full:
        # All of a round is drawn at once, so that the first pairs are the same whatever `num` is.
        order = rng.permutation(count)
        shares = rng.dirichlet(np.full(NUM_PARENTS, _CONCENTRATION), count)
        at, num_before = 0, num_filled
        while at < count and num_filled < num:
            block = slice(at, at + num - num_filled)
            rows, weights = order[block], shares[block]
            means = np.stack(
                [
                    gauge_fix(charts[row].positions(weight @ parameters[row]))
                    for row, weight in zip(rows, weights, strict=True)
                ]
            )
            quality = seed_quality(means, limits, prior)
            kept = np.flatnonzero(quality.is_possible & (quality.log_prior >= MIN_FILLED_LOG_PRIOR))
            kept = kept[selector.add(means[kept], np.ones(len(kept)))]
            rounds.append((means[kept], parents[rows[kept]], weights[kept], quality.log_prior[kept]))
            num_filled += len(kept)
            num_tried += len(rows)
            at += len(rows)
        is_full = at == count and num_filled - num_before < _MIN_KEPT_SHARE * count
    means, origins, weights, log_prior = map(np.concatenate, zip(*rounds, strict=True))
    return Filling(means, origins, weights, log_prior, num_tried - num_filled)


def _with_nearest(pairs_m: Array) -> npt.NDArray[np.int64]:
    """Return each pair, even if it has duplicates, and the six nearest others, (pair, 7)."""
    parents = []
    for first in range(0, len(pairs_m), _NUM_ROWS):
        nearest = np.argsort(cartesian_distances(pairs_m[first : first + _NUM_ROWS], pairs_m), axis=1, kind="stable")
        parents += [np.r_[row, near[near != row][: NUM_PARENTS - 1]] for row, near in enumerate(nearest, first)]
    return np.stack(parents)


def _parameters(chart: PairChart, parents_m: Array) -> Array:
    """Return the parameters (parent, 108) of parents (parent, 2, 17, 3), turned rigidly onto the first."""
    points = parents_m.reshape(len(parents_m), -1, 3)
    aligned = align_rigid(points, points[0]).apply(points)
    return chart.parameters_of(aligned.reshape(parents_m.shape))
