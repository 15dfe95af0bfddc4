"""Uses of draws: retrieval, the final fit, occluded joints, in-betweens, and the baselines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.lifting import plain_nearest
from benchmarks.synthetic import random_pairs, standing_pair
from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.baselines import lift_by_ik, resolve_penetration, sample_naively
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.expected_error import expected_error, expected_over_time
from pasdedeux.completion.fit import fit_pair, pooled_lengths
from pasdedeux.completion.in_betweens import fill_between, straight_between
from pasdedeux.completion.neighbours import nearest_by_interaction, nearest_rigid
from pasdedeux.completion.occlusion import blend_onto, complete_pair
from pasdedeux.completion.retrieval import image_residual, retrieve
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity
from pasdedeux.kinematics import align_rigid, bone_lengths
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.skeletons import PAIR17

PAIRS = random_pairs(np.random.default_rng(0), 700, spread_rad=0.3)
INDEX = DrawIndex(PAIRS)
WRIST = PAIR17.index("left_wrist")


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), hidden=st.floats(0.0, 0.6), num_views=st.integers(1, 3))
def test_the_index_gives_what_the_definition_gives(seed: int, hidden: float, num_views: int) -> None:
    rng = np.random.default_rng(seed)
    views = rng.normal(size=(num_views, 3))
    image = project_pair(PAIRS[rng.integers(len(PAIRS))], views[0]) + rng.normal(scale=0.02, size=(2, 17, 2))
    image[rng.random((2, 17)) < hidden] = np.nan
    if np.isfinite(image).all(axis=-1).sum() < 4:
        return
    fast, plain = INDEX.nearest(image, views, count=5), plain_nearest(PAIRS, image, views, count=5)
    # Draws are stored in single precision, so distances are off by a micrometre, and ties may swap.
    np.testing.assert_allclose(fast.distance_m, plain.distance_m, atol=1e-5)
    apart = np.diff(plain.distance_m, prepend=-1.0, append=9.0)
    is_clear = (apart[:-1] > 2e-5) & (apart[1:] > 2e-5)
    assert (fast.draw == plain.draw)[:-1][is_clear[:-1]].all()


def test_a_pair_seen_from_its_view_is_found_and_placed_where_it_stood() -> None:
    view = np.array([0.3, 0.2, 1.0])
    image = project_pair(PAIRS[123], view)
    found = retrieve(INDEX, image, view[None])
    assert found.nearest.draw[0] == 123
    np.testing.assert_allclose(found.pairs_m[0][..., :2], image, atol=1e-5)
    points, true_points = found.pairs_m[0].reshape(-1, 3), PAIRS[123].reshape(-1, 3)
    np.testing.assert_allclose(points, align_rigid(true_points, points).apply(true_points), atol=1e-5)
    np.testing.assert_allclose(found.weight.sum(), 1.0)
    assert image_residual(found.pairs_m[0], image) < 1e-5


def test_the_view_that_fits_is_chosen_among_hypotheses() -> None:
    view = np.array([0.9, 0.1, 0.4])
    image = project_pair(PAIRS[5], view)
    found = INDEX.nearest(image, np.stack([-view, [0.0, 0.0, 1.0], view]), count=1)
    assert (found.draw[0], found.view[0]) == (5, 2)


def test_excluded_draws_do_not_change_the_result() -> None:
    view = np.array([[0.9, 0.1, 0.4], [0.3, 0.2, 1.0]])
    image = project_pair(PAIRS[5], view[0])
    excluded = retrieve(INDEX, image, view).nearest.draw[[0, 1, 4]]
    found = retrieve(INDEX, image, view, without=excluded)
    plain = retrieve(DrawIndex(np.delete(PAIRS, excluded, axis=0)), image, view)
    np.testing.assert_allclose(found.mean_m, plain.mean_m, atol=1e-9)
    few = DrawIndex(PAIRS[:3])
    found, plain = (retrieve(few, image, view, without=excluded) for excluded in ([0, 1, 2], []))
    np.testing.assert_array_equal(found.mean_m, plain.mean_m)


def test_an_image_of_three_joints_and_an_index_without_draws_are_refused() -> None:
    image = np.full((2, 17, 2), np.nan)
    image[0, :3] = 0.0
    with pytest.raises(InputError, match="3 joints"):
        INDEX.nearest(image, np.array([[0.0, 0.0, 1.0]]))
    with pytest.raises(InputError, match="at least one"):
        DrawIndex(PAIRS[:0])


def test_the_fit_meets_the_image_with_exact_bones() -> None:
    rng = np.random.default_rng(1)
    truth = PAIRS[9]
    start = truth + rng.normal(scale=0.03, size=truth.shape)
    lengths = bone_lengths(PAIR17, truth)
    fitted = fit_pair(truth[..., :2], start, lengths)
    np.testing.assert_allclose(bone_lengths(PAIR17, fitted)[:, 1:], lengths[:, 1:], atol=1e-9)
    assert image_residual(fitted, truth[..., :2]) < image_residual(start, truth[..., :2])
    assert np.linalg.norm(fitted - truth, axis=-1).mean() < np.linalg.norm(start - truth, axis=-1).mean()


def test_a_joint_not_seen_keeps_the_retrieved_bone() -> None:
    pair = PAIRS[11]
    image = pair[..., :2].copy()
    image[0, WRIST] = np.nan
    fitted = fit_pair(image, pair, bone_lengths(PAIR17, pair))
    np.testing.assert_allclose(fitted, pair, atol=1e-4)


def test_bone_lengths_are_pooled_by_weight_and_the_same_on_both_sides() -> None:
    twice = 2.0 * PAIRS[0]
    lengths = pooled_lengths(np.stack([PAIRS[0], twice]), np.array([0.25, 0.75]))
    np.testing.assert_allclose(lengths, lengths[:, list(PAIR17.mirror)])
    np.testing.assert_allclose(lengths.sum(), 1.75 * bone_lengths(PAIR17, PAIRS[0]).sum())


def test_the_nearest_draw_in_3d_is_that_of_the_definition() -> None:
    pair = PAIRS[40].copy()
    pair[1, 5:9] = np.nan
    known = np.isfinite(pair).all(axis=-1).ravel()
    turned = pair @ yaw_rotmat(1.0).T + 3.0
    found = nearest_rigid(PAIRS, turned, count=6)
    points = PAIRS.reshape(len(PAIRS), -1, 3)[:, known]
    fixed = np.broadcast_to(turned.reshape(-1, 3)[known], points.shape)
    distance = np.sqrt(((align_rigid(points, fixed).apply(points) - fixed) ** 2).sum(axis=-1).mean(axis=-1))
    np.testing.assert_allclose(found.distance_m, np.sort(distance)[:6], atol=1e-6)
    assert found.draw[0] == 40
    np.testing.assert_allclose(found.pairs_m[0].reshape(-1, 3)[known], fixed[0], atol=1e-5)


def test_ranking_all_draws_gives_the_nearest_in_interaction_coordinates() -> None:
    few, pair = PAIRS[:40], PAIRS[50]
    found = nearest_by_interaction(few, pair, count=3, num_ranked=40)
    every = [interaction_dissimilarity(draw.reshape(-1, 3), pair.reshape(-1, 3)) for draw in few]
    assert found.draw.tolist() == np.argsort(every)[:3].tolist()


def test_a_hidden_wrist_is_completed_better_than_by_the_mean_pair() -> None:
    rng = np.random.default_rng(3)
    errors = []
    mean_pair_m = PAIRS.mean(axis=0).reshape(-1, 3)
    for pair in random_pairs(rng, 8, spread_rad=0.3):
        seen = pair.copy()
        seen[0, WRIST] = np.nan
        done = complete_pair(seen, PAIRS, num_nearest=20, num_ranked=40)
        mean_m = align_rigid(mean_pair_m, pair.reshape(-1, 3)).apply(mean_pair_m)
        errors.append([np.linalg.norm(wrist - pair[0, WRIST]) for wrist in (done.fitted_m[0, WRIST], mean_m[WRIST])])
        is_visible = np.isfinite(seen)
        np.testing.assert_array_equal(done.pair_m[is_visible], pair[is_visible])
        expected = bone_lengths(PAIR17, pair)
        np.testing.assert_allclose(bone_lengths(PAIR17, done.fitted_m)[:, 1:], expected[:, 1:], atol=1e-9)
    completed_m, by_mean_m = np.mean(errors, axis=0)
    assert completed_m < by_mean_m


def test_blending_moves_hidden_joints_with_the_visible_ones() -> None:
    pair = PAIRS[2]
    shifted = pair + np.array([0.1, -0.2, 0.3])
    shifted[1, WRIST] = np.nan
    np.testing.assert_allclose(blend_onto(pair, shifted)[1, WRIST], pair[1, WRIST] + [0.1, -0.2, 0.3], atol=1e-12)


def test_completing_without_enough_joints_is_refused() -> None:
    seen = np.full((2, 17, 3), np.nan)
    seen[0, :4] = PAIRS[0, 0, :4]
    with pytest.raises(InputError, match="4 joints"):
        complete_pair(seen, PAIRS, num_nearest=20, num_ranked=40)


def test_in_betweens_keep_bone_lengths_and_start_near_the_ends() -> None:
    first, last = PAIRS[0], PAIRS[1]
    np.testing.assert_allclose(straight_between(first, last, 3)[[0, 1]], [(3 * first + last) / 4, (first + last) / 2])
    between = fill_between(first, last, 5, PAIRS[:300])
    lengths = bone_lengths(PAIR17, np.stack([first, last])).mean(axis=0)
    np.testing.assert_allclose(bone_lengths(PAIR17, between)[:, :, 1:], np.tile(lengths[:, 1:], (5, 1, 1)), atol=1e-9)
    motion = np.concatenate([first[None], between, last[None]])
    steps = np.linalg.norm(np.diff(motion, axis=0), axis=-1).mean(axis=(1, 2))
    assert steps.max() < 3.0 * steps.min()


def test_lifting_with_ik_ends_in_range_and_out_of_each_other() -> None:
    limits = JointLimits.published()
    pair = standing_pair(distance_m=0.25)
    bent = pair.copy()
    bent[0, WRIST] = 2.0 * bent[0, PAIR17.index("left_elbow")] - bent[0, PAIR17.index("left_shoulder")]
    solved = lift_by_ik(pair[..., :2], bent, bone_lengths(PAIR17, pair), limits)
    model = capsule_model(PAIR17)
    assert model.penetration(solved, model.radii_of(pair[None]))[2] <= 0.011
    assert image_residual(solved, pair[..., :2]) < 0.01


def test_people_who_do_not_touch_stay_where_they_are() -> None:
    pair = standing_pair(distance_m=1.5)
    np.testing.assert_array_equal(resolve_penetration(pair), pair)


def test_naive_samples_keep_bones_and_the_nearest_is_the_nearest() -> None:
    pair = standing_pair(distance_m=0.8)
    limits = JointLimits.published()
    distances = []
    for count in (1, 60):
        near = sample_naively(np.random.default_rng(0), pair[..., :2], pair, limits, num_samples=count)
        np.testing.assert_allclose(bone_lengths(PAIR17, near), bone_lengths(PAIR17, pair), atol=1e-9)
        distances.append(np.linalg.norm(near[..., :2] - pair[..., :2]))
    assert 0.0 < distances[1] < distances[0]


@given(scale=st.floats(0.1, 10.0), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=20)
def test_an_expected_error_scales_with_the_pair_and_does_not_depend_on_its_place(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lifted, mean = PAIRS[rng.integers(len(PAIRS), size=2)]
    image = lifted[..., :2].copy()
    image[rng.random((2, 17)) < 0.3] = np.nan
    expected = expected_error(image, mean, lifted, has_own_draw=False)
    assert expected.low_m < expected.value_m < expected.high_m
    moved = expected_error(scale * image + 3.0, scale * mean + 1.0, scale * lifted + 1.0, has_own_draw=False)
    assert moved.value_m == pytest.approx(scale * expected.value_m)
    assert expected_error(image, 0.5 * (lifted + mean), lifted, has_own_draw=False).value_m < expected.value_m
    # A draw of the same image makes the pair better than other draws show.
    with_own_draw = expected_error(image, mean, lifted, has_own_draw=True)
    assert with_own_draw.value_m < expected.value_m
    assert with_own_draw.high_m / with_own_draw.low_m == pytest.approx(expected.high_m / expected.low_m)


def test_draws_that_fit_exactly_have_an_expected_error_and_an_unseen_pair_has_none() -> None:
    assert 0.02 < expected_error(PAIRS[0, ..., :2], PAIRS[0], PAIRS[0], has_own_draw=False).value_m < 0.1
    assert np.isnan(expected_error(np.full((2, 17, 2), np.nan), PAIRS[0], PAIRS[1], has_own_draw=False).value_m)


def test_the_expected_error_over_time_follows_that_of_the_scene() -> None:
    near, far = (expected_over_time(None, together_m) for together_m in (0.05, 0.2))
    assert far.value_m == pytest.approx(4.0 * near.value_m)
    assert far.low_m < far.value_m < far.high_m
