"""A joint of a pair is pulled somewhere: the pair follows as little as it can, its bones as long as they were."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import fit_bones
from pasdedeux.fitting.terms import PointTerm
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import Skeleton

_PULL = 1e3
"""Weight of the place that a joint is pulled to, where each other joint holds its own with 1."""


def pull_joint(skeleton: Skeleton, people_m: Array, person: int, joint: int, target_m: Array) -> Array:
    """Return people (person, joint, 3) of whom one has a joint as near to a place (3,) as bones of fixed length allow.

    Everybody else stays where they are.  A joint that is pulled out of reach takes the body along.

    Args:
        skeleton: Of everybody.
        people_m: Before, metres, finite.
        person: Who is pulled.
        joint: By which joint.
        target_m: Where to, metres.
    """
    person_m = np.asarray(people_m[person], dtype=np.float64)[None]
    forest = BoneForest((skeleton,), bone_lengths(skeleton, person_m[0]))
    targets, weights = person_m.copy(), np.ones((1, skeleton.num_joints, 1))
    targets[0, joint], weights[0, joint] = target_m, _PULL
    pulled = np.array(people_m, dtype=np.float64)
    pulled[person] = fit_bones(forest, forest.state_of(person_m), [PointTerm(targets, weights)]).positions_m[0]
    return pulled
