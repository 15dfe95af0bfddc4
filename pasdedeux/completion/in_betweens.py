"""Pairs between two given pairs, guided by draws.

A straight line between the joints of two poses shortens limbs and passes through implausible poses.  Draws near the
line show where plausible pairs lie, up to their difference from the two poses.  The path is a smooth compromise of
both, with exact bone lengths.  Draws that are far from both give the straight line, with exact bones.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.completion.neighbours import Draws, nearest_rigid
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.terms import AccelerationTerm, PointTerm
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import PAIR17

_NUM_NEAREST = 16
"""Number of nearest draws for each pair between."""
_LINE_DEVIATION_M = 0.05
"""Distance of a true pair from the straight line half-way."""
_DRAW_DEVIATION_M = 0.1
"""Smallest distance assumed of a true pair from the mean of its nearest draws; that of the ends is known."""
_BEND_M = 0.005
"""Second difference of a joint's path between neighbouring frames."""
_NUM_ROUNDS = 2
"""Number of rounds; each searches draws near the path and updates it."""


def straight_between(first_m: Array, last_m: Array, num_between: int) -> Array:
    """Return the pairs on the straight lines between two pairs (person=2, joint=17, 3), without the ends.

    Returns:
        Pairs (num_between, 2, 17, 3), metres, evenly spaced in time.
    """
    share = (np.arange(1, num_between + 1) / (num_between + 1))[:, None, None, None]
    return np.asarray((1.0 - share) * first_m + share * last_m)


def fill_between(first_m: Array, last_m: Array, num_between: int, draws_m: Draws) -> Array:
    """Return the pairs between two pairs (person=2, joint=17, 3) of one scene, without the ends.

    Args:
        first_m: Pair before, metres.
        last_m: Pair after, metres, in the same axes.
        num_between: Number of pairs, evenly spaced in time.
        draws_m: Draws (draw, 2, 17, 3), metres.

    Returns:
        Pairs (num_between, 2, 17, 3), metres; bone lengths are the means of the two ends.

    Raises:
        InputError: There is no draw, or too few joints are known.
    """
    line = straight_between(first_m, last_m, num_between)
    share = np.arange(1, num_between + 1) / (num_between + 1)
    # As in a Brownian bridge, the line is surest near the ends.
    line_weight = (4.0 * share * (1.0 - share) * _LINE_DEVIATION_M**2) ** -1
    ends = np.stack([first_m, last_m])
    lengths = bone_lengths(PAIR17, ends).mean(axis=0)
    # Assume that draws differ from the pairs between as they do from the ends.
    missed = ends - np.stack([_local_mean(draws_m, end) for end in ends])
    draw_weight = max(_DRAW_DEVIATION_M**2, float(np.mean(np.sum(missed**2, axis=-1)))) ** -1
    path = line
    for _ in range(_NUM_ROUNDS):
        shown = np.stack([_local_mean(draws_m, pair) for pair in path]) + straight_between(
            missed[0], missed[1], num_between
        )
        path = np.stack(
            [_lead(ends[:, p], line[:, p], shown[:, p], line_weight, draw_weight, lengths[p]) for p in (0, 1)], 1
        )
    return path


def _local_mean(draws_m: Draws, pair_m: Array) -> Array:
    """Return the mean of the draws nearest to a pair, moved onto it, weighted by their distances."""
    near = nearest_rigid(draws_m, pair_m, count=_NUM_NEAREST)
    squared = near.distance_m**2
    scale = max(float(squared[0]), 1e-8)
    weight = np.exp(-0.5 * (squared - squared[0]) / scale)
    return np.tensordot(weight / weight.sum(), near.pairs_m, axes=1)


def _lead(
    ends_m: Array, line_m: Array, shown_m: Array, line_weight: Array, draw_weight: float, lengths_m: Array
) -> Array:
    """Return one person's path (frame, joint, 3) between two poses: near line and draws, smooth, bone lengths exact."""
    total = line_weight + draw_weight
    middle = (line_weight[:, None, None] * line_m + draw_weight * shown_m) / total[:, None, None]
    targets = np.concatenate([ends_m[:1], middle, ends_m[1:]])
    weights = np.concatenate([[1e8], total, [1e8]])[:, None, None]
    forest = BoneForest((PAIR17,), lengths_m)
    smooth = AccelerationTerm(np.array(_BEND_M**-2))
    result = fit_bones(forest, forest.state_of(targets), [PointTerm(targets, weights), smooth], FitSettings(10, 1e-4))
    return result.positions_m[1:-1]
