"""The classifier of clips and the predictor of motion: what they cannot see, what they learn, that they repeat it."""

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.evaluation.scores import Score
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.learning.clips import CLIP_FRAMES, HISTORY, HORIZON, clips_of, joint_errors
from pasdedeux.learning.networks.clip_classifier import train_classifier
from pasdedeux.learning.networks.motion_predictor import train_predictor
from pasdedeux.learning.settings import ClassifierSettings, PredictorSettings
from tasks.evaluation.downstream import (
    STILL,
    WITH,
    WITHOUT,
    prediction_scores,
    prediction_table,
    recognition_table,
)
from tests.builders.moving_pairs import swaying_pair

MOTION = swaying_pair(120)


def _turned(motion_m: np.ndarray, yaw: float, shift: tuple[float, float]) -> np.ndarray:
    turn = np.array([0.0, np.sin(yaw / 2.0), 0.0, np.cos(yaw / 2.0)])
    there = np.array([shift[0], 0.0, shift[1]])
    return there + rotate(np.broadcast_to(turn, (*motion_m.shape[:-1], 4)), motion_m)


def test_clips_do_not_depend_on_where_the_pair_is_and_where_it_faces() -> None:
    clips = clips_of(MOTION, 30.0)
    assert clips.shape == (5, CLIP_FRAMES, 2, 22, 3)
    np.testing.assert_allclose(clips_of(_turned(MOTION, 1.3, (2.0, -1.0)), 30.0), clips, atol=1e-9)
    middle = clips[:, CLIP_FRAMES // 2, :, 0]
    np.testing.assert_allclose(middle[..., [0, 2]].sum(axis=1), 0.0, atol=1e-9)
    assert (middle[:, 1, 0] > 0.0).all()
    apart = np.linalg.norm(np.diff(clips, axis=3), axis=-1)
    np.testing.assert_allclose(apart[0, 0], np.linalg.norm(np.diff(MOTION[0], axis=1), axis=-1), atol=1e-9)


def test_a_motion_that_is_shorter_than_a_clip_is_held_at_its_end() -> None:
    (clip,) = clips_of(MOTION[:30], 30.0)
    assert len(clip) == CLIP_FRAMES
    np.testing.assert_array_equal(clip[9:], np.repeat(clip[9:10], CLIP_FRAMES - 9, axis=0))
    assert clips_of(MOTION[:1], 30.0).shape == (1, CLIP_FRAMES, 2, 22, 3)
    assert clips_of(MOTION[:57], 30.0, is_held=False).shape == (0, CLIP_FRAMES, 2, 22, 3)
    assert len(clips_of(MOTION[:58], 30.0, is_held=False)) == 1


def _classes() -> dict[str, np.ndarray]:
    found = {}
    for name, apart in (("far", 0.9), ("near", 0.5)):
        found[name] = np.concatenate([clips_of(swaying_pair(90, seed=s, apart_m=apart), 30.0) for s in range(3)])
    return found


def test_the_classifier_learns_to_tell_two_kinds_apart_and_always_the_same() -> None:
    settings = ClassifierSettings(num_steps=24)
    clips = _classes()
    one, other = (train_classifier(clips, settings, np.random.default_rng(3)) for _ in range(2))
    assert one.accuracy(clips) == 100.0
    assert one.accuracy({"near": clips["far"], "far": clips["far"][:0]}) == 0.0
    assert one.digest == other.digest
    features = one.features(clips["far"])
    assert features.shape == (len(clips["far"]), 32)
    np.testing.assert_array_equal(features, other.features(clips["far"]))
    assert train_classifier(clips, settings, np.random.default_rng(4)).digest != one.digest
    with pytest.raises(InputError, match="needs two classes with clips of 2 s; found far 9"):
        train_classifier({"far": clips["far"]}, settings, np.random.default_rng(0))


def test_the_predictor_begins_with_the_last_pose_and_learns_to_do_better_on_unseen_motion() -> None:
    clips = np.concatenate(
        [clips_of(swaying_pair(120, seed=s), 30.0, num_frames=HISTORY + HORIZON, frame=HISTORY - 1) for s in range(5)]
    )
    train, test = clips[:-3], clips[-3:]
    known, true = test[:, :HISTORY], test[:, HISTORY:]
    still = np.repeat(known[:, -1:], HORIZON, axis=1)
    settings = PredictorSettings(num_steps=1, learning_rate=1e-9)
    first = train_predictor(train, settings, np.random.default_rng(0))
    np.testing.assert_allclose(first.predict(known), still, atol=1e-5)
    longer = PredictorSettings(num_steps=60)
    one, other = (train_predictor(train, longer, np.random.default_rng(0)).predict(known) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert joint_errors(one, true)[0].mean() < 0.9 * joint_errors(still, true)[0].mean()
    with pytest.raises(InputError, match="no clip of 3 s"):
        train_predictor(clips[:0], settings, np.random.default_rng(0))


def test_ame_is_blind_to_where_people_are_and_jme_is_not() -> None:
    true = MOTION[None, :HORIZON]
    moved = _turned(true, 0.7, (0.3, 0.0))
    jme, ame = joint_errors(moved, true)
    assert jme.min() > 10.0
    np.testing.assert_allclose(ame, 0.0, atol=1e-6)
    mirrored = true * [-1.0, 1.0, 1.0]
    assert joint_errors(mirrored, true)[1].min() > 0.1


def test_effects_are_paired_by_seed_and_have_their_interval() -> None:
    scores = [
        Score("accuracy", method, value + seed, "%", split="80/10/10", item=f"seed {seed}")
        for seed in range(4)
        for method, value in ((WITH, 92.0), (WITHOUT, 90.0))
    ]
    (table,) = recognition_table(scores)
    assert table.rows == (("80/10/10", "93.50", "91.50", "+2.00 (+2.00 to +2.00)"),)
    errors = np.tile(np.arange(1.0, 11.0), (3, 1))
    made = [
        score
        for seed in range(5)
        for method, factor in ((WITH, 1.0), (WITHOUT, 2.0), (STILL, 3.0))
        for score in prediction_scores(factor * errors, errors, method, split="80/10/10", item=f"hug, seed {seed}")
    ]
    (table,) = prediction_table(made)
    assert table.rows[0][:3] == ("hug", "JME", "2.00 / 4.00 / 6.00")
    assert table.rows[1][1:3] == ("JME", "-2.00 (-2.00 to -2.00)")
    assert table.rows[3][2] == "+0.00 (+0.00 to +0.00)"
    assert recognition_table([]) == prediction_table([]) == []
