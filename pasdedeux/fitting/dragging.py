"""Pull a joint of a person to a place: the body moves the least and keeps its bone lengths."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import fit_bones
from pasdedeux.fitting.terms import PointTerm
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import Skeleton

_PULL = 1e3
"""Weight of the target of the pulled joint; each other joint is held in place with weight 1."""


def pull_joint(skeleton: Skeleton, people_m: Array, person: int, joint: int, target_m: Array) -> Array:
    """Pull a joint of one person as near to a place (3,) as bones of fixed length allow; return all (person, joint, 3).

    The other people stay.  A joint that is pulled out of reach takes the body along.

    Args:
        skeleton: Skeleton of everybody.
        people_m: Positions before, metres, finite.
        person: Number of the person.
        joint: The pulled joint.
        target_m: Its target, metres.
    """
    person_m = np.asarray(people_m[person], dtype=np.float64)[None]
    forest = BoneForest((skeleton,), bone_lengths(skeleton, person_m[0]))
    targets, weights = person_m.copy(), np.ones((1, skeleton.num_joints, 1))
    targets[0, joint], weights[0, joint] = target_m, _PULL
    pulled = np.array(people_m, dtype=np.float64)
    pulled[person] = fit_bones(forest, forest.state_of(person_m), [PointTerm(targets, weights)]).positions_m[0]
    return pulled
