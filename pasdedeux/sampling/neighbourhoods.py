"""Filling: new pairs between grown pairs that are alike.

Growth gives a pair for each annotation, and leaves room between them.  A filled pair is a random mean of a grown pair
and those nearest to it by D_C, over the parameters of the first: turns of bones, changes of lengths, places of roots.
What the mean makes of a body is a body again, and errors of single pairs go down in it; what is not plausible, or is
like a pair that is there, is refused.  Our own.
"""

from __future__ import annotations

from dataclasses import dataclass

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
"""Pairs that a filled one is a mean of: a grown pair and its six nearest ones."""
MIN_FILLED_LOG_PRIOR = -100.0
"""Log prior below which a filled pair is refused: half of what a selected pair may have."""
_CONCENTRATION = 0.7
"""Of the Dirichlet distribution of the weights: below 1 a few parents count more than the others."""
_MAX_TRIES = 20
"""Means that are drawn for each pair that is asked for, at most."""
_MIN_KEPT_SHARE = 0.05
"""When less of the means with each pair first is kept than this, there is no more room between them."""


@dataclass(frozen=True)
class Filling:
    """Filled pairs in the order in which they were drawn.

    Args:
        pairs_m: Pairs (n, person=2, joint=17, 3), metres, gauge-fixed.
        parents: Rows of the pairs that each is a mean of, the one whose parameters were used first, (n, 7).
        weights: What each parent counts, (n, 7), summing to 1.
        log_prior: Log of eq. 2 (Yin et al. 2018) with the pair's own bone lengths, (n,).
        num_refused: Means that were not plausible, or like a pair that was there.
    """

    pairs_m: Array
    parents: npt.NDArray[np.int64]
    weights: Array
    log_prior: Array
    num_refused: int


def fill(
    pairs_m: Array,
    num: int,
    rng: np.random.Generator,
    limits: JointLimits,
    prior: PriorSettings = DEFAULT_PRIOR,
) -> Filling:
    """Return up to `num` pairs between pairs (pair, person=2, joint=17, 3), metres.

    Each pair is used in turn, as often as any other.  There are fewer than asked for where most means are refused, and
    none where there are fewer pairs than a mean is made of.
    """
    count = len(pairs_m)
    if count < NUM_PARENTS:
        none = np.zeros((0, NUM_PARENTS))
        return Filling(pairs_m[:0], none.astype(np.int64), none, np.zeros(0), 0)
    nearest = np.argsort(cartesian_distances(pairs_m, pairs_m), axis=1, kind="stable")
    # A pair comes first among its own parents, also where another one is just like it.
    parents = np.stack([np.r_[row, near[near != row][: NUM_PARENTS - 1]] for row, near in enumerate(nearest)])
    charts = [PairChart(pair) for pair in pairs_m]
    parameters = [_parameters(chart, pairs_m[own]) for chart, own in zip(charts, parents, strict=True)]
    selector = PairSelector(1, min_room=count + num)
    selector.add(pairs_m, *np.ones((2, count)))
    found: list[Filling] = []
    num_found = num_tried = 0
    is_full = False
    while num_found < num and num_tried < _MAX_TRIES * num and not is_full:
        rows = rng.permutation(count)[: num - num_found]
        weights = rng.dirichlet(np.full(NUM_PARENTS, _CONCENTRATION), len(rows))
        means = [
            gauge_fix(charts[row].positions(own @ parameters[row])) for row, own in zip(rows, weights, strict=True)
        ]
        quality = seed_quality(np.stack(means), limits, prior)
        kept = np.flatnonzero(quality.is_possible & (quality.log_prior >= MIN_FILLED_LOG_PRIOR))
        kept = kept[selector.add(np.stack(means)[kept], *np.ones((2, len(kept))))]
        found.append(Filling(np.stack(means)[kept], parents[rows[kept]], weights[kept], quality.log_prior[kept], 0))
        num_found += len(kept)
        num_tried += len(rows)
        is_full = len(rows) == count and len(kept) < _MIN_KEPT_SHARE * count
    return Filling(
        np.concatenate([one.pairs_m for one in found]),
        np.concatenate([one.parents for one in found]),
        np.concatenate([one.weights for one in found]),
        np.concatenate([one.log_prior for one in found]),
        num_tried - num_found,
    )


def _parameters(chart: PairChart, parents_m: Array) -> Array:
    """Return the parameters (parent, 108) of parents (parent, 2, 17, 3), turned rigidly onto the first."""
    points = parents_m.reshape(len(parents_m), -1, 3)
    aligned = align_rigid(points, points[0]).apply(points)
    return chart.parameters_of(aligned.reshape(parents_m.shape))
