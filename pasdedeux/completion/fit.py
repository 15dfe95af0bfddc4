"""The last step of lifting: fit a retrieved pair to the seen joints, with exact bone lengths.

Seen joints follow the image; vectors of bones and depths of people follow the retrieved pair.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import BoneVectorTerm
from pasdedeux.fitting.terms import PointTerm
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import PAIR17

_PARENTS = np.array([parent if parent >= 0 else joint for joint, parent in enumerate(PAIR17.parents)])


_IMAGE_DEVIATION_M = 0.015
"""Error of a seen joint in the final fit."""
BONE_DEVIATION_M = 0.03
"""Error of each coordinate of a retrieved bone's vector."""
_DEPTH_DEVIATION_M = 0.1
"""Error of the retrieved depth of a joint against the whole pair."""
_FIT = FitSettings(max_iterations=10, tolerance=1e-4)


def fit_pair(image_m: Array, pair_m: Array, lengths_m: Array) -> Array:
    """Return the pair (person=2, joint=17, 3), metres, that fits the joints seen, with exact bone lengths.

    Args:
        image_m: Image points (person=2, joint=17, 2), metres; NaN where not seen.
        pair_m: Retrieved pair (2, 17, 3), metres, camera axes; it is also the first guess.
        lengths_m: Bone lengths (2, 17), metres; those of roots are unused.

    Raises:
        InputError: A position or length is not finite.
    """
    targets = np.concatenate([image_m, pair_m[..., 2:]], axis=-1)
    deviation = np.array([_IMAGE_DEVIATION_M, _IMAGE_DEVIATION_M, _DEPTH_DEVIATION_M])
    return fit_people(targets, deviation, pair_m, lengths_m)


def fit_people(
    targets_m: Array, deviation_m: Array, pair_m: Array, lengths_m: Array, *, bone_deviation_m: float = BONE_DEVIATION_M
) -> Array:
    """Return the pair (person=2, joint=17, 3), metres, nearest to targets and to the bone vectors of a pair.

    Args:
        targets_m: Where joints should be, (2, 17, 3), metres; NaN leaves a coordinate free.
        deviation_m: Errors of the targets, (2, 17, 3) or broadcasts to it, metres.
        pair_m: Pair (2, 17, 3), metres, whose bone vectors decide where there is no target; also the first guess.
        lengths_m: Bone lengths (2, 17), metres, kept exactly; those of roots are unused.
        bone_deviation_m: Error of each coordinate of a bone's vector, metres.

    Raises:
        InputError: A position or length is not finite.
    """
    weights = np.broadcast_to(np.asarray(deviation_m, dtype=np.float64) ** -2, targets_m.shape)
    bones = pair_m - pair_m[:, _PARENTS]
    bone_weight = np.array(bone_deviation_m**-2)
    fitted = np.empty(pair_m.shape)
    for person in range(2):
        forest = BoneForest((PAIR17,), np.asarray(lengths_m[person], dtype=np.float64))
        who = slice(person, person + 1)
        terms = [PointTerm(targets_m[who], weights[who]), BoneVectorTerm(PAIR17, bones[who], bone_weight)]
        fitted[person] = fit_bones(forest, forest.state_of(pair_m[who]), terms, _FIT).positions_m[0]
    return fitted


def pooled_lengths(pairs_m: Array, weight: Array) -> Array:
    """Return the bone lengths (person=2, joint=17), metres, of pairs (k, 2, 17, 3): their weighted mean, sides tied."""
    lengths = np.tensordot(weight, bone_lengths(PAIR17, pairs_m), axes=1)
    return np.asarray(0.5 * (lengths + lengths[..., list(PAIR17.mirror)]))
