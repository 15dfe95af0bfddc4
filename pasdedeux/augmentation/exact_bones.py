"""Exact bone lengths for approximate points: along their directions, or by the least displacement."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.skeletons import BODY22, Skeleton

_STEPS_TO_NEAREST = 2
"""Newton steps; a third and more change mean errors of closed-form predictions by less than 0.1 %."""


def project_to_bones(
    points: Array, lengths_m: Array, skeleton: Skeleton = BODY22, *, is_nearest: bool = False
) -> Array:
    """Return the points (variant, T, n, 3) with their bone directions and exactly these lengths (variant, n).

    The pelvis stays; a bone without direction points up.  With `is_nearest`, all joints first move to the nearest
    places with these lengths, so that length errors do not add up along limbs, and motion with wrong bones comes nearer
    to the true one.
    """
    points = np.array(points, np.float64, order="C")
    if is_nearest:
        people = points.reshape(*points.shape[:2], -1, skeleton.num_joints, 3)
        lengths = np.asarray(lengths_m, np.float64).reshape(len(lengths_m), -1, skeleton.num_joints)
        _meet_lengths(people, np.array(skeleton.parents), np.array(skeleton.order)[:0:-1], lengths, _STEPS_TO_NEAREST)
    skeletons = (skeleton,) * (points.shape[2] // skeleton.num_joints)
    for variant, lengths in zip(points, lengths_m, strict=True):
        forest = BoneForest(skeletons, lengths)
        variant[...] = forest.positions(forest.state_of(variant))
    return points


@compiled()
def _meet_lengths(people: Array, parents: Integers, bones: Integers, lengths_m: Array, num_steps: int) -> None:
    """Move the joints of `people` as little as possible, over all joints, until bones have these lengths.

    With u the directions of the bones, a step moves joints by -J^T (J J^T)^-1 (error of lengths), where row e of J
    is u_e at the end of bone e and -u_e at its begin: Newton's step to the constraint of least squared displacement.
    J J^T is eliminated from the tips of the limbs on, so nothing is filled in beyond bones that share a joint.

    Args:
        people: Positions (variant, T, P, J, 3), metres.
        parents: Parent of each joint (J,), -1 for the root.
        bones: Child joints of the bones (E,), children first.
        lengths_m: Length of the bone that ends in each joint (variant, P, J), metres.
        num_steps: Number of steps.
    """
    count = len(bones)
    unit, matrix, off = np.empty((count, 3)), np.empty((count, count)), np.empty(count)
    sign = np.zeros((count, count))
    near, num_near = np.empty((count, count), np.int64), np.zeros(count, np.int64)
    for e in range(count):
        for f in range(e + 1, count):
            sign[f, e] = (parents[bones[e]] == parents[bones[f]]) * 1.0 - (parents[bones[e]] == bones[f])
            if sign[f, e] != 0.0:
                near[e, num_near[e]] = f
                num_near[e] += 1
    for v, t, p in np.ndindex(people.shape[:3]):
        body = people[v, t, p]
        for _ in range(num_steps):
            for e in range(count):
                child, parent = bones[e], parents[bones[e]]
                x = body[child, 0] - body[parent, 0]
                y = body[child, 1] - body[parent, 1]
                z = body[child, 2] - body[parent, 2]
                length = np.sqrt((x * x + y * y) + z * z)
                off[e] = length - lengths_m[v, p, child]
                length = max(length, 1e-12)
                unit[e, 0], unit[e, 1], unit[e, 2] = x / length, y / length, z / length
            for e in range(count):
                matrix[e, e] = 2.0
                for f in near[e, : num_near[e]]:
                    shared = unit[e, 0] * unit[f, 0] + unit[e, 1] * unit[f, 1] + unit[e, 2] * unit[f, 2]
                    matrix[f, e] = sign[f, e] * shared
            for e in range(count):
                for i in range(num_near[e]):
                    f = near[e, i]
                    share = matrix[f, e] / matrix[e, e]
                    off[f] -= share * off[e]
                    for j in range(i + 1):
                        matrix[f, near[e, j]] -= share * matrix[near[e, j], e]
            for e in range(count - 1, -1, -1):
                for f in near[e, : num_near[e]]:
                    off[e] -= matrix[f, e] * off[f]
                off[e] /= matrix[e, e]
                for axis in range(3):
                    body[bones[e], axis] -= off[e] * unit[e, axis]
                    body[parents[bones[e]], axis] += off[e] * unit[e, axis]
