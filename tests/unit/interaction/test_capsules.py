"""Check capsules round bones and their penetration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m, capsule_model, pair_penetration, segment_distance
from pasdedeux.skeletons import BODY22, PAIR17, Skeleton
from tests.builders.poses import random_pairs, standing

MODEL = capsule_model(PAIR17)


def brute_distance(ends: np.ndarray, steps: int = 400) -> float:
    """Return the distance of two segments over a fine grid of their points."""
    at = np.linspace(0.0, 1.0, steps + 1)[:, None]
    a = ends[0] + at * (ends[1] - ends[0])
    b = ends[2] + at * (ends[3] - ends[2])
    return float(np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1)).min())


@given(st.integers(0, 2**31))
def test_segment_distance_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = rng.normal(size=(4, 3))
    kind = rng.integers(5)
    if kind == 1:
        ends[1] = ends[0]
    elif kind == 2:
        ends[3] = ends[2] = ends[0]
    elif kind == 3:
        ends[3] = ends[2] + 0.7 * (ends[1] - ends[0])
    elif kind == 4:
        ends[2:] = ends[:2] + 0.4 * (ends[1] - ends[0])
    exact = float(segment_distance(*ends))
    brute = brute_distance(ends)
    # The grid overestimates by at most half a step on each segment.
    slack = (np.linalg.norm(ends[1] - ends[0]) + np.linalg.norm(ends[3] - ends[2])) / 800
    assert exact <= brute + 1e-9
    assert brute <= exact + slack + 1e-9


def test_penetration_is_the_sum_of_depths_of_the_pairs_that_are_checked() -> None:
    pairs = random_pairs(0, 20)
    radii = MODEL.radii_of(pairs)

    def total(pair: np.ndarray, first: int, second: int, checked: np.ndarray) -> float:
        depth = 0.0
        for a, b in checked:
            ends = pair[first, [MODEL.parents[a], a]], pair[second, [MODEL.parents[b], b]]
            depth += max(float(radii[first, a] + radii[second, b] - segment_distance(*ends[0], *ends[1])), 0.0)
        return depth

    checks = ((0, 0, MODEL.within), (1, 1, MODEL.within), (0, 1, MODEL.between))
    expected = [[total(pair, *check) for check in checks] for pair in pairs]
    sums = MODEL.penetration(pairs, radii)
    np.testing.assert_allclose(sums, expected, atol=1e-12)
    assert (sums[:, 2] > 0).mean() > 0.3
    out = np.zeros(3)
    depth = pair_penetration(pairs[0], radii, MODEL.parents, MODEL.within, MODEL.between, out)
    assert depth == pytest.approx(sums[0].sum())
    np.testing.assert_array_equal(
        MODEL.penetration(pairs[0]), MODEL.penetration(pairs[:1], MODEL.radii_of(pairs[:1]))[0]
    )


def test_penetration_is_symmetric_in_the_people_and_ignores_rigid_motion() -> None:
    pairs = random_pairs(2, 50)
    radii = MODEL.radii_of(pairs)
    sums = MODEL.penetration(pairs, radii)
    swapped = MODEL.penetration(pairs[:, ::-1], radii[::-1])
    np.testing.assert_allclose(swapped[:, [1, 0, 2]], sums, atol=1e-12)
    np.testing.assert_allclose(MODEL.penetration(pairs + np.array([1.0, 2.0, 3.0]), radii), sums, atol=1e-9)


def test_standing_people_do_not_penetrate_until_they_are_pushed_into_each_other() -> None:
    pose = standing()
    radii = MODEL.radii_of(np.stack([pose, pose])[None])
    height = body_height_m(PAIR17, bone_lengths(PAIR17, pose))
    assert height == pytest.approx(1.72, abs=0.02)
    facing = pose * [-1, 1, -1]
    sums = [MODEL.penetration(np.stack([pose, facing + np.array([0, 0, gap])]), radii) for gap in (1.0, 0.15, 0.1)]
    assert not sums[0].any()
    assert 0 < sums[1][2] < sums[2][2]


@pytest.mark.parametrize("skeleton", [PAIR17, BODY22])
def test_every_bone_has_a_radius_and_neighbours_are_not_checked(skeleton: Skeleton) -> None:
    model = capsule_model(skeleton)
    assert (model.radius_per_height[[child for _, child in skeleton.bones]] > 0).all()
    assert len(model.between) == (skeleton.num_joints - 1) ** 2
    for first, second in model.within:
        assert len({first, second, skeleton.parents[first], skeleton.parents[second]}) == 4
    index = skeleton.index
    pairs = {tuple(pair) for pair in model.within.tolist()}
    assert tuple(sorted((index("left_knee"), index("right_knee")))) in pairs
    assert tuple(sorted((index("left_wrist"), index("right_ankle")))) in pairs
