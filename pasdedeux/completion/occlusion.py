"""Complete occluded joints from draws (Yin et al. 2018, section 6, Fig. 12).

The draws nearest to an incomplete pair in D_I over its visible joints give a median pair.  The median is deformed onto
the visible joints by Gaussian-weighted linear blending.  Our final fit makes bone lengths exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.completion.fit import fit_people
from pasdedeux.completion.neighbours import Draws, NearbyDraws, nearest_by_interaction
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import PAIR17

NUM_NEAREST = 100
"""Number of draws in the median (Yin et al. 2018: 100)."""
BLEND_DEVIATION_M = 0.2
"""Width of the Gaussian weights of visible joints, metres; the paper states none."""
_VISIBLE_DEVIATION_M, _BLENDED_DEVIATION_M = 0.005, 0.05


@dataclass(frozen=True)
class Completion:
    """A completed pair.

    Args:
        pair_m: Visible joints as given, the others blended, (person=2, joint=17, 3), metres, the axes of the input.
        fitted_m: The same with exact bone lengths, (2, 17, 3), metres; visible joints may move by millimetres.
        median_m: Median of the draws, moved onto the visible joints, (2, 17, 3), metres.
        neighbours: The draws.
    """

    pair_m: Array
    fitted_m: Array
    median_m: Array
    neighbours: NearbyDraws


def complete_pair(
    pair_m: Array, draws_m: Draws, *, num_nearest: int = NUM_NEAREST, num_ranked: int | None = None
) -> Completion:
    """Complete the joints of a pair that are NaN.

    Args:
        pair_m: Pair (person=2, joint=17, 3), metres; NaN where a joint is hidden.
        draws_m: Draws (draw, 2, 17, 3), metres.
        num_nearest: Number of draws in the median, fewer if there are fewer.
        num_ranked: Number of draws for which D_I is measured; by default twice as many.

    Raises:
        InputError: There is no draw, or fewer than 5 joints are visible.
    """
    nearest = nearest_by_interaction(draws_m, pair_m, count=num_nearest, num_ranked=num_ranked or 2 * num_nearest)
    median = np.median(nearest.pairs_m, axis=0)
    blended = blend_onto(median, pair_m)
    lengths = _known_lengths(pair_m, nearest.pairs_m)
    deviation = np.where(np.isfinite(pair_m).all(axis=-1, keepdims=True), _VISIBLE_DEVIATION_M, _BLENDED_DEVIATION_M)
    fitted = fit_people(blended, deviation, blended, lengths)
    return Completion(pair_m=blended, fitted_m=fitted, median_m=median, neighbours=nearest)


def blend_onto(median_m: Array, pair_m: Array) -> Array:
    """Deform a pair (person=2, joint=17, 3) onto the visible joints of another, metres.

    A visible joint moves to where it is seen.  A hidden joint moves by the mean displacement of visible joints,
    weighted by exp(-d^2 / (2 s^2)), s = 0.2 m, of their distances d in the median; far from all of them, the nearest
    decides. At least one joint must be visible.
    """
    is_visible = np.isfinite(pair_m).all(axis=-1).ravel()
    points, target = median_m.reshape(-1, 3), np.asarray(pair_m, dtype=np.float64).reshape(-1, 3)
    moves = target[is_visible] - points[is_visible]
    squared = np.sum((points[:, None] - points[None, is_visible]) ** 2, axis=-1)
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / BLEND_DEVIATION_M**2)
    moved = points + (weight / weight.sum(axis=1, keepdims=True)) @ moves
    return np.where(is_visible[:, None], target, moved).reshape(median_m.shape)


def in_depth_order(pair_m: Array, other_m: Array) -> Array:
    """Return a pair (person=2, joint=17, 3) whose people have the order in depth (z) of another pair.

    If the order of the pelvises differs, both people are moved along z to the distance of those of the other pair;
    their image, without perspective, stays the same.

    >>> pair = np.zeros((2, 17, 3)) + np.array([0.0, 0.2])[:, None, None]
    >>> in_depth_order(pair, -2.0 * pair)[:, 0, 2].round(2).tolist()
    [0.3, -0.1]
    """
    apart, wanted = (float(pair[1, PAIR17.root, 2] - pair[0, PAIR17.root, 2]) for pair in (pair_m, other_m))
    if not apart * wanted < 0.0:
        return pair_m
    moved_z = 0.5 * (wanted - apart) * np.array([-1.0, 1.0])
    return np.asarray(pair_m + moved_z[:, None, None] * [0.0, 0.0, 1.0])


def _known_lengths(pair_m: Array, pairs_m: Array) -> Array:
    """Return bone lengths (person=2, joint=17), metres: of the pair, its other side, or the median of other pairs."""
    pair_lengths = bone_lengths(PAIR17, np.asarray(pair_m, dtype=np.float64))
    other = pair_lengths[:, list(PAIR17.mirror)]
    usual = np.median(bone_lengths(PAIR17, pairs_m), axis=0)
    lengths = np.where(np.isfinite(pair_lengths), pair_lengths, np.where(np.isfinite(other), other, usual))
    lengths[:, PAIR17.root] = 0.0
    return np.asarray(lengths)
