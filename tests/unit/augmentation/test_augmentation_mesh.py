"""The interaction mesh, and the weights of floor, stance and time."""

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.augmentation import (
    AugmentationSettings,
    Augmenter,
    Source,
    UserContact,
    reference_motion,
    uniform_variations,
    weights,
)
from pasdedeux.augmentation.mesh import build_mesh
from pasdedeux.augmentation.support import floor_weights, lasting_s, stance_weights
from pasdedeux.augmentation.terms import build_problem
from pasdedeux.errors import InputError
from pasdedeux.interaction.surfaces import fade
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair


def test_weights_are_rows_that_sum_to_one_and_cross_rows_to_zero() -> None:
    mesh = build_mesh(Source(swaying_pair(4), 30.0), smoothing_s=0.1)
    np.testing.assert_allclose(mesh.weights.sum(axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(mesh.laplacian.sum(axis=-1), 0.0, atol=1e-12)
    np.testing.assert_allclose(mesh.cross_laplacian.sum(axis=-1), 0.0, atol=1e-12)


def test_near_joints_weigh_more_by_the_inverse_square() -> None:
    positions = swaying_pair(1)
    mesh = build_mesh(Source(positions, 30.0))
    points = positions.reshape(44, 3)
    i = BODY22.index("left_wrist")
    neighbours = np.flatnonzero(mesh.weights[0, i])
    squared = ((points[neighbours] - points[i]) ** 2).sum(axis=-1)
    ratio = mesh.weights[0, i, neighbours] * np.maximum(squared, 1e-4)
    np.testing.assert_allclose(ratio, ratio[0])


def test_coplanar_and_duplicate_joints_are_meshed_all_the_same() -> None:
    flat, doubled, one_point = swaying_pair(3), swaying_pair(3), np.zeros((1, 2, 22, 3))
    flat[..., 2] = 0.0
    doubled[:, 0, 7] = doubled[:, 0, 3]
    for positions in (flat, doubled, one_point):
        weights = build_mesh(Source(positions, 30.0)).weights
        np.testing.assert_allclose(weights.sum(axis=-1), 1.0, atol=1e-12)
        assert (weights[:, :22, 22:] > 0).any()


def test_fading_is_continuous_and_ends_flat() -> None:
    distances = np.linspace(0.1, 0.4, 2001)
    weights = fade(distances, 0.2, 0.3)
    assert np.abs(np.diff(weights)).max() < 3.0 * 0.3 / 2000 / 0.1
    assert weights[0] == 1.0
    assert weights[-1] == 0.0


FEET = BODY22.indices(["left_ankle", "left_toe", "right_ankle", "right_toe"])


def test_planted_feet_stand_and_raised_feet_do_not() -> None:
    positions = swaying_pair(60)
    weights = stance_weights(Source(positions, 30.0))
    assert weights[:, :, FEET].min() > 0.9
    assert np.delete(weights, FEET, axis=2).max() == 0.0
    raised = positions.copy()
    raised[30:, 0, FEET[:2], 1] += 0.4
    weights = stance_weights(Source(raised, 30.0))[:, :, FEET]
    assert weights[40:, 0, :2].max() < 0.01
    assert weights[40:, 0, 2:].min() > 0.9
    assert np.abs(np.diff(weights, axis=0)).max() < 0.2


def test_a_still_person_who_is_held_up_has_no_floor_and_a_lying_one_has_it_under_the_back() -> None:
    positions = swaying_pair(30)
    source = Source(positions + np.array([[[0.0] * 3], [[0.0, 0.5, 0.0]]]), 30.0)
    assert source.floor_m == pytest.approx(Source(positions, 30.0).floor_m, abs=0.005)
    for weight in (floor_weights(source), stance_weights(source)):
        assert not weight[:, 1].any()
        assert weight[:, 0, FEET].min() > 0.5
    lying = positions.copy()
    lying[:, 1] = lying[:, 1] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    lying[:, 1, :, 1] += 0.1 + source.floor_m - lying[:, 1, BODY22.index("spine3"), 1].min()
    weights = floor_weights(Source(lying, 30.0))[:, 1]
    assert weights[:, BODY22.indices(["pelvis", "spine2", "spine3"])].min() > 0.5


def test_a_stated_floor_is_used() -> None:
    source = Source(swaying_pair(10), 30.0)
    (variant,) = Augmenter(source, AugmentationSettings(floor_m=-0.4)).solve(uniform_variations([0.75], ["A"]))
    (found,) = Augmenter(source).solve(uniform_variations([0.75], ["A"]))
    feet = BODY22.indices(["left_toe", "right_toe"])
    assert variant.positions_m[:, 0, feet, 1].min() < found.positions_m[:, 0, feet, 1].min() - 0.01
    assert not stance_weights(Source(swaying_pair(10), 30.0, ground_m=-0.4)).any()


def test_a_stance_lasts_until_somebody_lifts_the_foot_and_part_of_it_ends_with_part_of_the_weight() -> None:
    stands = np.array([[1.0, 1.0, 0.0, 1.0, 1.0, 1.0]]).T
    np.testing.assert_allclose(lasting_s(stands, 2.0)[:, 0], [1.0, 1.0, 0.0, 1.5, 1.5, 1.5])
    np.testing.assert_allclose(lasting_s(stands[::-1], 2.0), lasting_s(stands, 2.0)[::-1])
    np.testing.assert_allclose(lasting_s(np.array([[1.0], [0.5], [1.0]]), 1.0)[:, 0], [2.0, 1.5, 2.0])


def test_a_stated_contact_needs_existing_frames_and_joints() -> None:
    contact = UserContact(joint_a="head", joint_b="head", stop_frame=11)
    with pytest.raises(InputError, match="frames within 0 to 10"):
        Augmenter(Source(swaying_pair(10), 30.0), user_contacts=[contact])
    with pytest.raises(ValidationError, match="joint 'nose' is not in body22"):
        UserContact(joint_a="nose", joint_b="head", stop_frame=1)
    with pytest.raises(ValidationError, match="share_b"):
        UserContact(joint_a="head", joint_b="head", share_b=1.5, stop_frame=1)


def test_the_reference_motion_has_the_new_lengths_and_at_scale_one_is_the_source() -> None:
    source = Source(swaying_pair(5), 30.0)
    scales = np.ones((2, 2, 22))
    scales[1, 0] = 0.8
    motions = reference_motion(source, scales)
    np.testing.assert_allclose(motions[0], source.positions_m, atol=1e-12)
    lengths = bone_lengths(BODY22, motions[1])
    np.testing.assert_allclose(lengths[:, 0], np.broadcast_to(0.8 * source.lengths_m[0], (5, 22)), atol=1e-12)
    toes = BODY22.indices(["left_toe", "right_toe"])
    np.testing.assert_allclose(motions[1][:, 0, toes, 1], source.positions_m[:, 0, toes, 1], atol=1e-3)


def test_bad_sources_are_refused_with_the_reason() -> None:
    good = swaying_pair(5)
    with pytest.raises(InputError, match="no frames"):
        Source(good[:0], 30.0)
    with pytest.raises(InputError, match="one person or more"):
        Source(good[:, :0], 30.0)
    with pytest.raises(InputError, match="rate is 0"):
        Source(good, 0.0)
    bad = good.copy()
    bad[3, 1, 2, 0] = np.nan
    with pytest.raises(InputError, match=r"salsa: frame 3 has a joint that is not finite"):
        Source(bad, 30.0, "salsa")
    far = good.copy()
    far[2] += 1e7
    with pytest.raises(InputError, match="frame 2"):
        Source(far, 30.0)


def test_the_weight_of_smoothness_is_as_stated_at_30_hz_and_scales_with_the_frame_rate() -> None:
    people = swaying_pair(12)
    usual, double = (build_problem(Source(people, rate_hz)) for rate_hz in (30.0, 60.0))
    assert usual.smoothness == weights.SMOOTHNESS
    assert double.smoothness == pytest.approx(16.0 * weights.SMOOTHNESS)
