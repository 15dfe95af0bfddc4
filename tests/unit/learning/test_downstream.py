"""The classifier of clips and the predictor of motion: invariance, learning and repeatability."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.evaluation.scores import Score
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.learning.clips import CLIP_FRAMES, HISTORY, HORIZON, cut_clips, exchange_people, joint_errors
from pasdedeux.learning.networks.clip_classifier import train_classifier
from pasdedeux.learning.networks.motion_predictor import train_predictor
from pasdedeux.learning.settings import ClassifierSettings, PredictorSettings
from storage_schema import Store
from tasks.evaluation import evaluation_stage
from tasks.evaluation.downstream import (
    BY_MODEL,
    BY_SOLVER,
    LARGEST,
    PREDICTION,
    RECOGNITION,
    STILL,
    WITHOUT,
    OneTraining,
    prediction_scores,
    prediction_tables,
    recognition_tables,
    split_takes,
)
from tasks.evaluation.topic import Topic
from tasks.stage import Shard, StageInputs
from tests.builders.moving_pairs import swaying_pair
from tests.builders.storage_rows import put, random_columns, take_rows

MOTION = swaying_pair(120)


def _turned(motion_m: np.ndarray, yaw: float, shift: tuple[float, float]) -> np.ndarray:
    turn = np.array([0.0, np.sin(yaw / 2.0), 0.0, np.cos(yaw / 2.0)])
    there = np.array([shift[0], 0.0, shift[1]])
    return there + rotate(np.broadcast_to(turn, (*motion_m.shape[:-1], 4)), motion_m)


def test_clips_do_not_depend_on_where_the_pair_is_and_where_it_faces() -> None:
    clips = cut_clips(MOTION, 30.0)
    assert clips.shape == (5, CLIP_FRAMES, 2, 22, 3)
    np.testing.assert_allclose(cut_clips(_turned(MOTION, 1.3, (2.0, -1.0)), 30.0), clips, atol=1e-9)
    middle = clips[:, CLIP_FRAMES // 2, :, 0]
    np.testing.assert_allclose(middle[..., [0, 2]].sum(axis=1), 0.0, atol=1e-9)
    assert (middle[:, 1, 0] > 0.0).all()
    apart = np.linalg.norm(np.diff(clips, axis=3), axis=-1)
    np.testing.assert_allclose(apart[0, 0], np.linalg.norm(np.diff(MOTION[0], axis=1), axis=-1), atol=1e-9)


def test_a_motion_that_is_shorter_than_a_clip_is_held_at_its_end() -> None:
    (clip,) = cut_clips(MOTION[:30], 30.0)
    assert len(clip) == CLIP_FRAMES
    np.testing.assert_array_equal(clip[9:], np.repeat(clip[9:10], CLIP_FRAMES - 9, axis=0))
    assert cut_clips(MOTION[:1], 30.0).shape == (1, CLIP_FRAMES, 2, 22, 3)
    assert cut_clips(MOTION[:57], 30.0, is_held=False).shape == (0, CLIP_FRAMES, 2, 22, 3)
    assert len(cut_clips(MOTION[:58], 30.0, is_held=False)) == 1


def _classes() -> dict[str, np.ndarray]:
    found = {}
    for name, apart in (("far", 0.9), ("near", 0.5)):
        found[name] = np.concatenate([cut_clips(swaying_pair(90, seed=s, apart_m=apart), 30.0) for s in range(3)])
    return found


def test_the_classifier_learns_to_tell_two_kinds_apart_and_always_the_same() -> None:
    settings = ClassifierSettings(num_steps=24)
    clips = _classes()
    classifier, same = (train_classifier(clips, settings, np.random.default_rng(3)) for _ in range(2))
    assert classifier.accuracy(clips) == 100.0
    assert classifier.accuracy({"near": clips["far"], "far": clips["far"][:0]}) == 0.0
    assert classifier.digest == same.digest
    features = classifier.features(clips["far"])
    assert features.shape == (len(clips["far"]), 32)
    np.testing.assert_array_equal(features, same.features(clips["far"]))
    assert train_classifier(clips, settings, np.random.default_rng(4)).digest != classifier.digest
    with pytest.raises(InputError, match="needs two classes with clips of 2 s; found far 9"):
        train_classifier({"far": clips["far"]}, settings, np.random.default_rng(0))


def test_the_predictor_begins_with_the_last_pose_and_learns_to_do_better_on_unseen_motion() -> None:
    clips = np.concatenate(
        [cut_clips(swaying_pair(120, seed=s), 30.0, num_frames=HISTORY + HORIZON, frame=HISTORY - 1) for s in range(5)]
    )
    train, test = clips[:-3], clips[-3:]
    known, true = test[:, :HISTORY], test[:, HISTORY:]
    still = np.repeat(known[:, -1:], HORIZON, axis=1)
    settings = PredictorSettings(num_steps=1, learning_rate=1e-9)
    first = train_predictor(train, settings, np.random.default_rng(0))
    np.testing.assert_allclose(first.predict(known), still, atol=1e-5)
    longer = PredictorSettings(num_steps=60)
    predicted, again = (train_predictor(train, longer, np.random.default_rng(0)).predict(known) for _ in range(2))
    np.testing.assert_array_equal(predicted, again)
    assert joint_errors(predicted, true)[0].mean() < 0.9 * joint_errors(still, true)[0].mean()
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
    methods = ((BY_SOLVER, 92.0), (BY_MODEL, 91.0), (WITHOUT, 90.0))
    scores = [
        Score("accuracy", method, value + seed, "%", split="80/10/10", item=f"seed {seed}")
        for seed in range(4)
        for method, value in methods
    ]
    (table,) = recognition_tables(scores)
    spreads = tuple(f"{value + 1.5:.2f} ± 1.29" for _, value in methods)
    effects = ("+2.00 (+2.00 to +2.00)", "+1.00 (+1.00 to +1.00)", "-1.00 (-1.00 to -1.00)")
    assert table.rows == (("80/10/10", *spreads, *effects),)
    errors = np.tile(np.arange(1.0, 11.0), (3, 1))
    errors_by_seed = [
        score
        for seed in range(5)
        for motion, factor in (("hug", 1.0), ("waltz", 3.0))
        for method, more in ((BY_SOLVER, 1.0), (WITHOUT, 2.0), (STILL, 3.0))
        for score in prediction_scores(
            factor * more * errors, errors, method, split="80/10/10", item=f"{motion}, seed {seed}"
        )
    ]
    jme, ame, by_motion, _ = prediction_tables(errors_by_seed)
    assert jme.rows[0][1:] == ("11.00 ± 0.00", "22.00 ± 0.00", "33.00 ± 0.00", "-11.00 (-11.00 to -11.00)")
    assert ame.rows[0][-1] == "+0.00 (+0.00 to +0.00)"
    assert by_motion.rows[0][:2] == ("hug", "2.00 / - / 4.00 / 6.00")
    assert recognition_tables([]) == prediction_tables([]) == []


FRAMES = 31
TAKES = [f"{kind}_{number}" for kind in ("hug", "judo", "push", "waltz") for number in range(3)]
SEEN = {*TAKES[:6]}
MODEL = {"model": "sampler", "split": "cross_interaction", "artifact": "0", "segment": 0, "seed": 0}


def _study(store: Store, seen: set[str], models: Sequence[str] = ("sampler",)) -> StageInputs:
    """Return takes of 3.0 s at different heights, with three variants of the solver and two of each model."""
    first, *learned = sorted(seen)
    split: dict[str, Any] = {"train": {take: ["x"] for take in learned}, "validation": {first: ["x"]}, "test": {}}
    facts: dict[str, Any] = {"kind": "model", "class": "paper_cvae", **MODEL, **split, "shares_takes": False}
    found = {
        "models": [
            put(store, "training", name, {"models": random_columns("models", 1)}, {**facts, "model": name})
            for name in models
        ]
    }
    for number, take_id in enumerate(TAKES):
        motion = swaying_pair(FRAMES, seed=number) + np.array([0.0, 10.0 * number, 0.0])
        people = np.swapaxes(motion, 0, 1).reshape(-1, 22, 3)
        poses, facts = take_rows(take_id, 2, FRAMES, rate_hz=10.0, body22_m=people)
        takes = random_columns("takes", 2) | {"person": np.arange(2), "body22_rest_m": np.zeros((2, 22, 3))}
        duet = {"name": take_id.partition("_")[0]}
        take = put(store, "ingest", take_id, {"takes": takes, "poses": poses}, facts, duet=duet)
        found.setdefault("poses", []).append(take)
        for by, count, origin in (("solver", 3, None), *((name, 2, {**MODEL, "model": name}) for name in models)):
            names = [f"{by}-{index}" for index in range(count)]
            frames, scale = np.full(count, FRAMES), [np.ones(44)] * count
            quality = {"variant_id": names, "bone_scale": scale, "num_frames": frames, "verdict": ["pass"] * count}
            body = {"body22_m": np.tile(motion.reshape(-1, 22, 3), (count, 1, 1))}
            rows = random_columns("variants", 2 * FRAMES * count) | body
            tables = {"variants": rows, "variant_quality": random_columns("variant_quality", count) | quality}
            facts = {"kind": "variants", "take_id": take_id, "num_persons": 2, "num_frames": FRAMES, "origin": origin}
            facts["told"] = {"contacts": [], "variants": names}
            found.setdefault("variants", []).append(put(store, "augmentation", f"{take_id} {by}", tables, facts))
    return StageInputs(found, seed=3)


def _shards(inputs: StageInputs, topic: Topic, **more: object) -> list[Shard]:
    settings = {"num_downstream_seeds": 3, "predictor": {"num_steps": 2}, **more}
    return topic.plan(inputs, evaluation_stage([topic]).parameters.model_validate(settings))


def _takes_of(clips: Mapping[str, np.ndarray]) -> list[str]:
    """Return the take of every clip, by its height."""
    return [TAKES[int(clip[..., 1].mean() / 10.0)] for clips_of_kind in clips.values() for clip in clips_of_kind]


def test_nobody_learned_from_test_takes_or_their_variants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned: list[list[str]] = []
    asked: list[list[str]] = []

    def learn(clips: Mapping[str, np.ndarray], *_: object, **__: object) -> SimpleNamespace:
        learned.append(_takes_of(clips))
        return SimpleNamespace(accuracy=lambda clips: float(asked.append(_takes_of(clips)) is None))

    monkeypatch.setattr("pasdedeux.learning.networks.clip_classifier.train_classifier", learn)
    store = Store(tmp_path)
    drawn = set()
    for shard in _shards(_study(store, SEEN), RECOGNITION):
        learned.clear()
        asked.clear()
        assert {BY_SOLVER, BY_MODEL, WITHOUT} <= {score.method for score in RECOGNITION.compute(shard, store).scores}
        by_solver, by_model, without = learned
        assert sorted(by_solver) == sorted(by_model), "as many variants of the same takes"
        assert len(by_solver) == 3 * len(without), "two beside each"
        tested = {take for takes in asked for take in takes}
        assert tested.isdisjoint({*by_solver, *without} | SEEN)
        assert {take.partition("_")[0] for take in tested} == {"push", "waltz"}
        drawn.add(frozenset(tested))
    assert len(drawn) > 1, "seeds test on other takes"
    for shard in _shards(_study(Store(tmp_path / "saw_all"), set(TAKES)), RECOGNITION):
        assert (shard.refs("generated"), shard.options(OneTraining).seen) == ((), ()), "the model is left out"


def test_several_models_are_compared_and_roles_are_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[Mapping[str, np.ndarray]] = []

    def learn(clips: Mapping[str, np.ndarray], *_: object, tells_roles: bool) -> SimpleNamespace:
        assert tells_roles
        trained.append(clips)
        return SimpleNamespace(accuracy=lambda clips: float(len(clips)))

    monkeypatch.setattr("pasdedeux.learning.networks.clip_classifier.train_classifier", learn)
    store = Store(tmp_path)
    shard = _shards(_study(store, SEEN, ("sampler", "other")), RECOGNITION, tells_roles=True)[0]
    result = RECOGNITION.compute(shard, store)
    assert [{kind: len(some) for kind, some in clips.items()} for clips in trained[:3]] == [
        {kind: len(some) for kind, some in trained[0].items()}
    ] * 3, "solver and both models make as many"
    kinds = ("hug", "judo", "push", "waltz")
    assert set(trained[0]) == {*kinds, *(f"{kind}, exchanged" for kind in kinds)}
    for clips in trained:
        for kind in kinds:
            np.testing.assert_allclose(exchange_people(clips[f"{kind}, exchanged"]), clips[kind], atol=1e-9)
    accuracy = {score.method: score.value for score in result.scores if score.metric == "accuracy"}
    assert set(accuracy) == {BY_SOLVER, BY_MODEL, "augmented_by_other", WITHOUT, LARGEST}
    assert accuracy[BY_SOLVER] == 4.0, "two interactions that no model saw, each in two roles"
    (table, _) = recognition_tables(result.scores)
    assert "augmented by other - augmented by the solver (95 %)" in table.headings
    assert "sampler@cross_interaction, other@cross_interaction" in result.notes[0]


def test_few_takes_are_learned_from_and_the_same_takes_tested_on_whatever_their_number(tmp_path: Path) -> None:
    store = Store(tmp_path)
    shards = _shards(_study(store, SEEN), PREDICTION, num_training_takes=[2, 1])
    sides = {}
    for shard in shards:
        options = shard.options(OneTraining)
        takes = [store.manifest(ref) for ref in shard.refs("takes")]
        train, test = split_takes(takes, options, np.random.default_rng(options.seed))
        assert len(train) == 4 * int(options.shares)
        sides.setdefault(options.seed, []).append({take.partition for take in test})
    assert [len(tests) for tests in sides.values()] == [2, 2, 2]
    assert all(few == fewer for few, fewer in sides.values())
    scores = [
        Score("JME_mean", method, 1.0, "cm", split=number, item="hug, seed 0")
        for number in ("8", "1", "2")
        for method in (BY_SOLVER, WITHOUT)
    ]
    assert [row[0] for row in prediction_tables(scores)[0].rows] == ["1", "2", "8"]


def test_seeds_change_what_is_found_and_the_order_of_the_work_does_not(tmp_path: Path) -> None:
    store = Store(tmp_path)
    shards = _shards(_study(store, SEEN), PREDICTION)
    once, again = (
        {shard.name: PREDICTION.compute(shard, store).scores for shard in order} for order in (shards, shards[::-1])
    )
    assert once == again
    assert len({tuple(score.value for score in scores if score.metric == "JME_mean") for scores in once.values()}) == 3
