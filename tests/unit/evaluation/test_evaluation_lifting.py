"""Scores of lifted pairs, completed joints and in-betweens."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.errors import HIDDEN, completion_errors, in_between_errors, lifted_errors
from pasdedeux.completion.retrieval import nearest_by_image, nearest_images
from pasdedeux.evaluation.scores import Score
from pasdedeux.kinematics.rotations import normalise, yaw_rotmat
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.lifting import calibration_scores
from tasks.evaluation.lifting_pictures import expected_figure, lifted_player, rows_figure
from tasks.rows.annotated_pairs import PairPlace

PAIRS = random_pairs(np.random.default_rng(0), 40, spread_rad=0.2)


def value(scores: list[Score], metric: str, method: str) -> float:
    return next(score.value for score in scores if (score.metric, score.method) == (metric, method))


def test_the_truth_has_no_error_and_a_shift_of_the_pair_is_none() -> None:
    errors = lifted_errors(PAIRS + np.array([1.0, 2.0, 3.0]), PAIRS)
    for values in errors.values():
        np.testing.assert_allclose(values, 0.0, atol=1e-9)


def test_the_true_pair_comes_from_the_take_and_is_none_where_the_take_or_a_person_is_missing() -> None:
    frames = {("view", 7): ("duet", 3), ("other", 7): ("trio", 3)}
    truth = GroundTruth({"duet": PAIRS}, {"duet": 30.0}, frames=frames)
    found = truth.pair(PairPlace("view", 7, 0, 1))
    assert found is not None
    assert (found.take_id, found.time_s) == ("duet", 0.1)
    np.testing.assert_array_equal(found.pair_m, PAIRS[3])
    for unknown in (("other", 7, 0, 1), ("view", 8, 0, 1), ("view", 7, 0, 2), ("view", 7, -1, 1)):
        assert truth.pair(PairPlace(*unknown)) is None


def test_a_turned_pair_has_the_right_shape() -> None:
    turned = PAIRS @ yaw_rotmat(0.5).T
    errors = lifted_errors(turned, PAIRS)
    np.testing.assert_allclose(errors["lifted_D_C"], 0.0, atol=1e-7)
    assert (errors["lifted_pair_error"] > 0.01).all()


def test_hidden_joints_of_pairs_that_are_draws_are_found() -> None:
    errors = completion_errors(np.random.default_rng(1), PAIRS[:2], PAIRS.astype(np.float32))
    assert set(errors) == set(HIDDEN)
    for found in errors.values():
        assert found["nearest_draw"].max() < 1e-5
        assert found["mean_pair"].min() > 0.01


def test_the_straight_line_is_in_between_where_people_go_straight() -> None:
    share = np.linspace(0.0, 1.0, 5)[:, None, None, None]
    errors = in_between_errors([(1.0 - share) * PAIRS[0] + share * PAIRS[1]], PAIRS)
    np.testing.assert_allclose(errors["straight"][0], 0.0, atol=1e-12)
    assert set(errors) == {"draws", "straight"}


def test_lifted_pairs_are_shown_beside_their_truth_one_example_after_another() -> None:
    shown = json.loads(lifted_player([{"truth": PAIRS[0], "fitted": PAIRS[1]}, {"truth": PAIRS[2]}]))
    assert [panel["title"] for panel in shown["panels"]] == ["ground truth", "fitted draws"]
    assert shown["labels"] == ["example 1 of 2", "example 2 of 2"]


def test_the_images_most_like_a_pair_are_those_of_it_and_are_drawn_beside_it() -> None:
    views = normalise(np.random.default_rng(2).normal(size=(len(PAIRS), 3)))
    images = project_pair(PAIRS, views)
    images[4, 1, 3:9] = np.nan  # a few joints are not seen
    found, distance = nearest_images(PAIRS[4] @ yaw_rotmat(0.7).T, images, views, count=3)
    assert found[0] == 4
    np.testing.assert_allclose(distance[0], 0.0, atol=1e-6)
    assert (np.diff(distance) > 0).all()
    placed, far = nearest_by_image(DrawIndex(PAIRS), images[4], views[4:5], count=2)
    assert far[0] < 1e-4 < far[1]
    np.testing.assert_allclose(
        np.linalg.norm(placed[0, 0, 0] - placed[0, 1, 0]), np.linalg.norm(PAIRS[4, 0, 0] - PAIRS[4, 1, 0]), rtol=1e-4
    )
    row = [("image", images[4]), ("lifted", PAIRS[4, ..., :2]), *(("annotation", images[at]) for at in found)]
    picture = rows_figure([("clip, frame 4", row), ("clip, frame 5", row[:2]), ("clip, frame 4", row[:2])])
    assert picture.count(b"<path") > 2 * 7
    assert picture.count(b">clip, frame 4<") == 2  # two couples of a frame


def test_calibration_scores_tell_good_expected_errors_from_wrong_ones() -> None:
    errors = np.linspace(0.05, 0.2, 10)
    expected = errors[:, None] * [1.0, 0.6, 1.6]
    right = calibration_scores(expected, errors, split="held_out")
    assert value(right, "expected_interval_share", "fitted") == 1.0
    assert value(right, "expected_correlation", "fitted") == pytest.approx(1.0)
    wrong = calibration_scores(expected[::-1], errors, split="held_out")
    assert value(wrong, "expected_interval_share", "fitted") < 0.5
    assert value(wrong, "expected_correlation", "fitted") == pytest.approx(-1.0)
    assert [s.metric for s in calibration_scores(expected[:1], errors[:1], split="x")] == ["expected_interval_share"]
    assert b"true error" in expected_figure({"held_out": (expected, errors)})
