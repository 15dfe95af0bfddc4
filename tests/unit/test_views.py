"""View estimation of annotated pairs, and the density of views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.cameras import view_density
from pasdedeux.cameras.frames import angle_between_directions, true_direction
from pasdedeux.cameras.orthographic import metres_from_pixels
from pasdedeux.cameras.torso import TORSO_INDICES
from pasdedeux.cameras.view_density import draw_views
from pasdedeux.cameras.views import DEPTH_RULES, ViewEstimates, ViewOptions, estimate_views, pair_in_metres
from pasdedeux.cameras.virtual_video import frame_take
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import BASIS, dancers, direction_of_angles, filmed, standing


@dataclass(frozen=True)
class ViewAccuracy:
    """Angles in radians between estimated and true views, one per annotation that has an estimate, (m,).

    `best` is the likeliest hypothesis, `nearest` the best of all hypotheses (what weighing could reach at most), and
    `baseline` the mean of the true views, given for everything: an estimate worse than that is worth nothing.
    """

    best_rad: np.ndarray
    nearest_rad: np.ndarray
    baseline_rad: np.ndarray


def view_accuracy(estimates: ViewEstimates, true_directions: np.ndarray) -> ViewAccuracy:
    """Compare estimates with the true views (n, 3) of the same annotations, as `frames.true_direction` gives them."""
    truth = normalise(np.asarray(true_directions, dtype=np.float64))
    error = angle_between_directions(estimates.direction, truth[estimates.annotation])
    nearest = np.full(len(truth), np.inf)
    np.minimum.at(nearest, estimates.annotation, error)
    best = np.flatnonzero(estimates.hypothesis == 0)
    shown = estimates.annotation[best]
    mean = normalise(truth.mean(axis=0)) if len(truth) else np.zeros(3)
    return ViewAccuracy(
        best_rad=error[best],
        nearest_rad=nearest[shown],
        baseline_rad=angle_between_directions(np.broadcast_to(mean, (len(shown), 3)), truth[shown]),
    )


def test_views_of_filmed_pairs_are_found_and_apparent_size_is_what_finds_them() -> None:
    px, truth = filmed(dancers(0, 300), 1)
    accuracy = view_accuracy(estimate_views(px, BASIS), truth)
    assert np.rad2deg(np.median(accuracy.best_rad)) < 8
    assert (accuracy.nearest_rad <= accuracy.best_rad).all()
    assert np.median(accuracy.baseline_rad) > np.deg2rad(60)
    blind = view_accuracy(estimate_views(px, BASIS, options=ViewOptions(distance_m=None)), truth)
    assert np.median(blind.best_rad) > 2 * np.median(accuracy.best_rad)


def test_trust_is_higher_where_the_error_is_lower() -> None:
    px, truth = filmed(dancers(1, 400), 2)
    px = px + np.random.default_rng(3).normal(scale=3.0, size=px.shape)
    estimates = estimate_views(px, BASIS)
    error = view_accuracy(estimates, truth).best_rad
    trust = estimates.trust[estimates.annotation[np.flatnonzero(estimates.hypothesis == 0)]]
    is_trusted = trust > np.median(trust)
    assert np.median(error[is_trusted]) < np.median(error[~is_trusted])
    assert trust.min() > 0
    assert trust.max() <= 1


def test_hypotheses_are_sorted_weighted_and_unit() -> None:
    px, _ = filmed(dancers(2, 40), 4)
    estimates = estimate_views(px, BASIS)
    np.testing.assert_allclose(np.bincount(estimates.annotation, estimates.weight), 1.0)
    np.testing.assert_allclose(np.linalg.norm(estimates.direction, axis=-1), 1.0)
    for annotation in range(40):
        mine = estimates.annotation == annotation
        np.testing.assert_array_equal(estimates.hypothesis[mine], np.arange(mine.sum()))
        assert (np.diff(estimates.weight[mine]) <= 0).all()
    assert (np.diff(estimates.annotation) >= 0).all()
    assert set(estimates.depth_rule) <= set(range(len(DEPTH_RULES)))
    np.testing.assert_allclose(direction_of_angles(*estimates.angles()), estimates.direction, atol=1e-9)
    np.testing.assert_array_equal(estimates.depth_rule[estimates.hypothesis == 0], DEPTH_RULES.index("size"))


def test_swapping_the_people_swaps_the_view() -> None:
    px, _ = filmed(dancers(3, 60), 5)
    one, other = estimate_views(px, BASIS), estimate_views(px[:, ::-1], BASIS)
    np.testing.assert_allclose(one.size_ratio * other.size_ratio, 1.0)
    # i and k turn round.
    turned = other.direction[np.flatnonzero(other.hypothesis == 0)] * [-1.0, 1.0, -1.0]
    assert angle_between_directions(one.direction[np.flatnonzero(one.hypothesis == 0)], turned).max() < 1e-6
    np.testing.assert_allclose(one.trust, other.trust, atol=1e-9)


def test_a_smaller_partner_is_not_taken_for_a_farther_one() -> None:
    pairs = dancers(4, 300)
    root = pairs[:, 1, :1].copy()
    pairs[:, 1] = root + 0.85 * (pairs[:, 1] - root)
    px, truth = filmed(pairs, 6)
    estimates = estimate_views(px, BASIS)
    assert estimates.size_ratio == pytest.approx(1 / 0.85, rel=0.04)
    assert np.rad2deg(np.median(view_accuracy(estimates, truth).best_rad)) < 8
    scale = estimates.metres_per_pixel[np.flatnonzero(estimates.hypothesis == 0)]
    heights = np.linalg.norm(np.diff(px[:, :, [0, 3]], axis=2), axis=-1)[..., 0] * scale
    assert np.median(heights[:, 1] / heights[:, 0]) == pytest.approx(0.85, rel=0.05)


def test_one_camera_alone_does_not_make_the_nearer_person_the_larger() -> None:
    pose = standing()
    pairs = np.stack([np.stack([pose, pose + np.array([0.3, 0, -0.5 + 0.01 * step])]) for step in range(60)])
    view = frame_take(pairs, pairs[:, :, 0], distance_m=4.0, yaw_rad=0.0, pitch_rad=0.1)
    px = view.camera.project(pairs).px
    truth = true_direction(pairs, view.camera)
    one = estimate_views(px, BASIS, camera_index=np.zeros(60, dtype=np.int64))
    assert one.size_ratio == pytest.approx(1.0, abs=0.02)
    assert np.rad2deg(np.median(view_accuracy(one, truth).best_rad)) < 12
    assert abs(estimate_views(px, BASIS).size_ratio - 1.0) > 0.04


def test_annotations_without_a_torso_have_no_view_and_no_trust() -> None:
    px, _ = filmed(dancers(5, 6), 7)
    px[2, 1] = np.nan
    px[4, 0, PAIR17.indices(("neck", "left_shoulder", "right_shoulder"))] = np.nan
    estimates = estimate_views(px, BASIS)
    np.testing.assert_array_equal(estimates.is_lifted, [True, True, False, True, False, True])
    assert set(estimates.annotation) == {0, 1, 3, 5}
    assert (estimates.trust[[2, 4]] == 0).all()
    nothing = estimate_views(np.full((3, 2, 17, 2), np.nan), BASIS)
    assert len(nothing.weight) == 0
    assert (nothing.trust == 0).all()
    assert len(estimate_views(np.zeros((0, 2, 17, 2)), BASIS).weight) == 0


def test_with_a_hidden_torso_joint_of_each_person_a_hypothesis_stays_as_near_and_the_likeliest_loses_some() -> None:
    px, truth = filmed(dancers(11, 300), 12)
    some = px.copy()
    rng = np.random.default_rng(5)
    for pair in some:
        for person in pair:
            person[rng.choice(TORSO_INDICES)] = np.nan
    whole, part = (view_accuracy(estimate_views(points, BASIS), truth) for points in (px, some))
    assert len(part.best_rad) == 300
    assert np.median(part.nearest_rad) < 1.4 * np.median(whole.nearest_rad)
    # Without the neck or a shoulder the scale of a person, and with it who is nearer, is known less well.
    assert np.rad2deg(np.median(part.best_rad)) < 20
    assert np.median(part.best_rad) < 0.3 * np.median(part.baseline_rad)


def test_a_joint_without_confidence_does_not_count() -> None:
    px, _ = filmed(dancers(6, 10), 8)
    neck = PAIR17.index("neck")
    confidence = np.ones(px.shape[:-1])
    confidence[:, :, neck] = 0.0
    spoiled = px.copy()
    spoiled[:, :, neck] += 500.0
    missing = px.copy()
    missing[:, :, neck] = np.nan
    one, other = estimate_views(spoiled, BASIS, confidence=confidence), estimate_views(missing, BASIS)
    # Steps of the fit are accepted by their cost, whose rounding (1e-16) hides differences of its square root.
    np.testing.assert_allclose(one.direction, other.direction, atol=1e-6)


def test_hugging_people_get_contact_hypotheses_when_the_distance_is_unknown() -> None:
    pose = standing()
    pair = np.stack([pose, pose * [-1, 1, -1] + [0, 0, 0.35]])
    view = frame_take(pair, pair[:, 0], distance_m=4.0, yaw_rad=0.1, pitch_rad=0.1)
    estimates = estimate_views(view.camera.project(pair).px[None], BASIS, options=ViewOptions(distance_m=None))
    rules = {DEPTH_RULES[rule] for rule in estimates.depth_rule}
    assert {"contact_near", "contact_far"} <= rules
    assert "size" not in rules
    is_contact = [DEPTH_RULES[rule].startswith("contact") for rule in estimates.depth_rule]
    assert (np.abs(estimates.root_depth_m[is_contact]) > 0.3).all()
    nearest = view_accuracy(estimates, true_direction(pair, view.camera)[None]).nearest_rad
    assert np.rad2deg(nearest) < 12


def test_pairs_in_metres_keep_the_own_scale_of_each_person_and_the_mean_between_them() -> None:
    rng = np.random.default_rng(9)
    px = rng.uniform(0, 500, size=(4, 2, 17, 2))
    same = pair_in_metres(px, np.full((4, 2), 0.01))
    middle = px[:, :, 0].mean(axis=1)
    np.testing.assert_allclose(same.reshape(4, -1, 2), metres_from_pixels(px.reshape(4, -1, 2), 0.01, middle))
    scaled = pair_in_metres(px, np.array([[0.01, 0.02]] * 4))
    np.testing.assert_allclose(scaled[:, :, 0].mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(scaled[:, 1] - scaled[:, 1, :1], 2 * (same[:, 1] - same[:, 1, :1]))
    px[0, 0, 0] = np.nan
    without = pair_in_metres(px, np.full((4, 2), 0.01))
    assert np.isnan(without[0, 0, 0]).all()
    assert np.isfinite(without[0, 0, 1:]).all()
    np.testing.assert_allclose(without[0, 1] - without[0, 0, 5], same[0, 1] - same[0, 0, 5])


def test_bad_options_are_refused() -> None:
    with pytest.raises(ValidationError, match="distance_m"):
        ViewOptions(distance_m=-1.0)
    with pytest.raises(ValidationError, match="lean_deviation_deg"):
        ViewOptions(lean_deviation_deg=0.0)


def _sphere(count: int) -> np.ndarray:
    """Nearly even points on the sphere (a Fibonacci lattice)."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), height, level * np.sin(turn)], axis=-1)


def density_at(directions: np.ndarray, weights: np.ndarray, deviation_rad: float, views: np.ndarray) -> np.ndarray:
    """Von Mises-Fisher densities round each direction, weighted, per steradian."""
    kappa = 1.0 / deviation_rad**2
    norm = kappa / (2.0 * np.pi * -np.expm1(-2.0 * kappa))
    return norm * np.exp(kappa * (views @ directions.T - 1.0)) @ (weights / weights.sum())


def test_drawn_views_follow_the_density(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    centres = direction_of_angles(np.array([0.3, 2.0, -1.0]), np.array([1.2, 1.6, 1.9]))
    weights = np.array([1.0, 2.0, 3.0])
    monkeypatch.setattr(view_density, "VIEW_DEVIATION_RAD", 0.25)
    draws = draw_views(rng, centres, weights, 20000)
    np.testing.assert_allclose(np.linalg.norm(draws, axis=-1), 1.0)
    grid = _sphere(40000)
    share = density_at(centres, weights, 0.25, grid)
    share /= share.sum()
    for axis in np.eye(3):
        for sign in (1.0, -1.0):
            expected = share[(grid @ axis * sign) > 0.5].sum()
            # 20,000 draws: six standard deviations of a share are below 0.022.
            assert ((draws @ axis * sign) > 0.5).mean() == pytest.approx(expected, abs=0.022)
    np.testing.assert_allclose(draws.mean(axis=0), share @ grid, atol=0.03)
