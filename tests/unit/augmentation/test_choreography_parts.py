"""Facts about what the duets are built from: reach, curves, feet, bodies."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.choreography.anthropometry import CAPSULE_RADII, make_body
from pasdedeux.choreography.curves import blend, bump, curve_through, moves, saturate, soft_minimum
from pasdedeux.choreography.geometry import STRETCH, reach
from pasdedeux.choreography.steps import Plant, clear_other_foot, spread_feet, walk_foot
from pasdedeux.plausibility.capsules import RADIUS_PER_HEIGHT
from pasdedeux.skeletons import BODY22


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def test_reach_meets_targets_in_range_with_exact_lengths(rng):
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    distance = rng.uniform(0.35, STRETCH, 200)[:, None] * 0.55
    root, pole = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    target = root + direction * distance
    arm = reach(root, target, pole, 0.30, 0.25)
    np.testing.assert_allclose(arm.end_m, target, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(arm.middle_m - root, axis=-1), 0.30, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(arm.end_m - arm.middle_m, axis=-1), 0.25, atol=1e-12)
    square = pole - np.sum(pole * direction, axis=-1, keepdims=True) * direction
    assert (np.sum((arm.middle_m - root) * square, axis=-1) > 0).all()
    np.testing.assert_allclose(np.sum(arm.bend * arm.upper, axis=-1), 0.0, atol=1e-12)
    assert (np.sum(arm.bend * arm.lower, axis=-1) > 0).all()


@pytest.mark.parametrize("distance", [0.01, 0.56, 5.0])
def test_reach_outside_the_limb_stays_on_the_line_with_exact_lengths(distance):
    arm = reach(np.zeros((1, 3)), np.array([[0.0, -distance, 0.0]]), np.array([[0.0, 0.0, 1.0]]), 0.30, 0.25)
    assert np.abs(arm.end_m[0, [0, 2]]).max() < 1e-12
    assert 0.1 < -arm.end_m[0, 1] < 0.55
    assert np.linalg.norm(arm.end_m - arm.middle_m) == pytest.approx(0.25)


def test_a_curve_passes_through_its_keys_and_has_two_continuous_derivatives(rng):
    keys = rng.normal(size=(12, 2))
    at = 0.5 * np.arange(2, 10)
    np.testing.assert_allclose(curve_through(at, 0.0, 0.5, keys), keys[2:-2], atol=1e-12)
    step = 1e-4
    for order in (1, 2):
        before = np.diff(
            curve_through(at[1:-1] + step * np.arange(-3.0, 1.0)[:, None], 0.0, 0.5, keys), n=order, axis=0
        )
        after = np.diff(curve_through(at[1:-1] + step * np.arange(0.0, 4.0)[:, None], 0.0, 0.5, keys), n=order, axis=0)
        np.testing.assert_allclose(before[-1] / step**order, after[0] / step**order, atol=0.5)


def test_a_curve_through_a_straight_line_is_straight():
    keys = np.arange(10.0)[:, None] * [1.0, -2.0]
    time_s = np.linspace(2.0, 7.0, 50)
    np.testing.assert_allclose(curve_through(time_s, 0.0, 1.0, keys), time_s[:, None] * [1.0, -2.0], atol=1e-12)


def test_blends_rest_exactly_outside_and_rise_between():
    time_s = np.linspace(-1.0, 3.0, 401)
    rise = blend(time_s, 0.0, 2.0)
    assert (rise[time_s <= 0.0] == 0.0).all()
    assert (rise[time_s >= 2.0] == 1.0).all()
    assert (np.diff(rise) >= 0).all()
    assert bump(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 1.0, 0.0]
    stops = moves(time_s, 1.0, [(0.0, 1.0, 3.0), (1.5, 2.0, -1.0)])
    assert stops[0] == 1.0
    assert stops[-1] == -1.0
    np.testing.assert_allclose(stops[(time_s >= 1.0) & (time_s <= 1.5)], 3.0)


def test_soft_limits_keep_their_side():
    values = np.linspace(-2.0, 4.0, 61)
    bent = saturate(values, 1.0, 0.5)
    assert (bent[values <= 1.0] == values[values <= 1.0]).all()
    assert bent.max() < 1.5
    least = soft_minimum([values, 1.0 - values], 0.1)
    assert (least <= np.minimum(values, 1.0 - values)).all()
    assert least[np.argmin(np.abs(values - 0.5))] == pytest.approx(0.5 - 0.1 * np.log(2.0))


def test_a_planted_foot_is_still_and_a_swinging_one_clears_the_floor():
    body = make_body(1.75)
    plants = [Plant(0.1, 0.0, 0.0, -1.0, 0.5), Plant(0.1, 0.6, 0.4, 1.1, 9.0)]
    time_s = np.arange(120) / 60.0
    foot = walk_foot(time_s, body, plants)
    standing = (time_s <= 0.5) | (time_s >= 1.1)
    assert np.unique(foot.ankle_m[standing], axis=0).shape[0] == 2
    assert foot.ankle_m[~standing, 1].min() >= body.standing_m("left_ankle") - 1e-12
    np.testing.assert_allclose(foot.ankle_m[-1], [0.1, body.standing_m("left_ankle"), 0.6], atol=1e-12)


def test_feet_are_spread_and_swings_bow_round_the_standing_foot():
    body = make_body(1.75)
    left = [Plant(0.0, 0.0, 0.0, -1.0, 1.0), Plant(0.0, 0.8, 0.0, 1.6, 9.0)]
    right = [Plant(-0.02, 0.4, 0.0, 0.8, 2.0)]
    left, right = spread_feet(body, left, right)
    assert right[0].x_m == pytest.approx(-0.02)  # far ahead of the left foot: nothing to spread
    bowed = clear_other_foot(body, left, right)
    assert bowed[0].bow_m == 0.0
    assert bowed[1].bow_m > 0.05  # to the left, away from the right foot
    near = spread_feet(body, left[:1], [Plant(-0.02, 0.0, 0.0, 0.8, 2.0)])[1]
    assert near[0].x_m == pytest.approx(-0.085 * 1.75)


def test_a_body_stands_as_tall_as_it_should_and_is_symmetric():
    body = make_body(1.8)
    legs = body.length_m("left_knee") + body.length_m("left_ankle")
    assert legs == pytest.approx(0.491 * 1.8)  # Drillis and Contini: thigh 0.245 and shank 0.246 of the height
    mirrored = body.rest_offsets_m[list(BODY22.mirror)] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(mirrored, body.rest_offsets_m, atol=1e-12)


def test_girths_are_at_least_those_of_the_capsule_model():
    """A duet that is free of penetration by these girths is free of it in the capsule model."""
    for name, radius in RADIUS_PER_HEIGHT.items():
        if name in BODY22.joint_names:
            assert CAPSULE_RADII[name.removeprefix("left_").removeprefix("right_")] >= radius, name
