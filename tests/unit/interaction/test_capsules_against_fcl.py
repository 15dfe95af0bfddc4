"""Compare penetration of capsules with the Flexible Collision Library."""

from __future__ import annotations

import fcl
import numpy as np
import pytest

from pasdedeux.kinematics.rotations import rotmat_from_unitquat, swing_between
from pasdedeux.plausibility.capsules import capsule_model, segment_distance
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import random_pairs

MODEL = capsule_model(PAIR17)
# What FCL's own tolerance leaves of a penetration depth.
TOLERANCE_M = 2e-6


def capsule(start: np.ndarray, end: np.ndarray, radius: float) -> fcl.CollisionObject:
    """Return a capsule of FCL, which lies along z around the origin before it is placed."""
    length = float(np.linalg.norm(end - start))
    turn = swing_between(np.array([[0.0, 0.0, 1.0]]), ((end - start) / length)[None])
    return fcl.CollisionObject(
        fcl.Capsule(radius, length), fcl.Transform(rotmat_from_unitquat(turn)[0], 0.5 * (start + end))
    )


def signed_distance(first: fcl.CollisionObject, second: fcl.CollisionObject) -> float:
    apart = float(fcl.distance(first, second, fcl.DistanceRequest(), fcl.DistanceResult()))
    if apart > 0.0:
        return apart
    # Only this finds how deep: with iterations, so not quite exactly.
    request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)
    return float(fcl.distance(first, second, request, fcl.DistanceResult()))


@pytest.mark.parametrize("spread_m", [0.15, 0.4])
def test_distances_and_depths_of_capsules_are_those_of_fcl(spread_m: float) -> None:
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(500):
        ends, radii = rng.normal(scale=spread_m, size=(4, 3)), rng.uniform(0.03, 0.1, 2)
        distance = float(segment_distance(*ends)) - radii.sum()
        by_fcl = signed_distance(capsule(ends[0], ends[1], radii[0]), capsule(ends[2], ends[3], radii[1]))
        assert distance == pytest.approx(by_fcl, abs=TOLERANCE_M)
        inside += distance < 0.0
    assert 20 < inside < 480


def test_penetration_of_pairs_is_that_of_fcl() -> None:
    pairs = random_pairs(3, 6)
    radii = MODEL.radii_of(pairs)
    sums = MODEL.penetration(pairs, radii)
    checks = ((0, 0, MODEL.within), (1, 1, MODEL.within), (0, 1, MODEL.between))
    for row, pair in enumerate(pairs):
        bodies = [
            {bone: capsule(person[MODEL.parents[bone]], person[bone], radii[index, bone]) for _, bone in PAIR17.bones}
            for index, person in enumerate(pair)
        ]

        for column, (first, second, checked) in enumerate(checks):
            distances = [signed_distance(bodies[first][a], bodies[second][b]) for a, b in checked.tolist()]
            depth = -sum(distance for distance in distances if distance < 0.0)
            assert sums[row, column] == pytest.approx(depth, abs=len(checked) * TOLERANCE_M)
    assert sums.sum(axis=1).max() > 0.05
