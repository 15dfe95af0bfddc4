"""Topics `recognition` and `prediction`: what variants of the training takes bring to other tasks, beside none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.evaluation.downstream import (
    BASELINES,
    LARGEST,
    STILL,
    WITH,
    WITHOUT,
    prediction_scores,
    prediction_table,
    recognition_table,
)
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning.clips import HISTORY, HORIZON, clips_of, joint_errors
from storage_schema import Manifest, Store
from tasks.evaluation.realism import LearnedSettings
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import TakeFacts, VariantFacts
from tasks.stage import Parameters, Shard, StageInputs, stream
from tasks.training.items import StoredVariants, interaction_of
from tasks.training.run import refuse_without_torch

_SHARES = {"80/10/10": (0.8, 0.1), "50/20/30": (0.5, 0.3)}
"""Shares of the takes of every interaction that are learned from and tested on; the rest is left for validation, which
nothing here looks at, as nothing is chosen."""


class OneTraining(Parameters):
    """One repetition: which shares, and with which seed."""

    shares: str
    seed: int
    learned: LearnedSettings


def _plan(topic: Topic, shares: Sequence[str], inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan a shard for each repetition; interactions of one take cannot be split by take and are left out."""
    takes = [take for take in inputs.of("poses") if TakeFacts.of(take).num_persons == 2]
    kinds = [interaction_of(take) for take in takes]
    used = [take for take, kind in zip(takes, kinds, strict=True) if kinds.count(kind) > 1]
    if not settings.num_downstream_seeds or len({interaction_of(take) for take in used}) < 2:
        return []
    ids = {TakeFacts.of(take).take_id for take in used}
    variants = [manifest for manifest in inputs.of("variants") if VariantFacts.of(manifest).take_id in ids]
    return [
        topic.shard(
            inputs,
            f"{name} seed {seed}",
            OneTraining(shares=name, seed=seed, learned=settings.part(LearnedSettings)),
            takes=used,
            variants=variants,
        )
        for name in shares
        for seed in range(settings.num_downstream_seeds)
    ]


def _plan_recognition(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan both shares of takes, with every seed."""
    return _plan(RECOGNITION, tuple(_SHARES), inputs, settings)


def _plan_prediction(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan the first shares of takes, with every seed."""
    return _plan(PREDICTION, tuple(_SHARES)[:1], inputs, settings)


def _recognise(shard: Shard, store: Store) -> TopicResult:
    """Train the classifier twice on the same takes, once with their variants, and test it on clips of other takes."""
    told = shard.options(OneTraining)
    train, test = _split(shard, store, told)
    from pasdedeux.learning.networks.clip_classifier import train_classifier  # torch

    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    real, tested = _clips(variants, train, num_frames=None), _clips(variants, test, num_frames=None)
    made = _clips(variants, train, num_frames=None, is_augmented=True)
    scores = []
    for method, clips in ((WITH, _joined(real, made)), (WITHOUT, real)):
        generator = stream(shard.seed, "evaluation", "recognition", told.shares, told.seed)
        classifier = train_classifier(clips, told.learned.classifier, generator)
        scores.append(_accuracy(method, classifier.accuracy(tested), told, tested))
    largest = max(map(len, tested.values())) / sum(map(len, tested.values()))
    scores.append(_accuracy(LARGEST, 100.0 * largest, told, tested))
    values = {score.method: np.array([score.value]) for score in scores}
    items = Items(values, [_repetition(told)], [0.0], BASELINES, sum(map(len, tested.values())))
    return TopicResult(scores=scores, notes=[_said(told, train, test, real, made)], items={"": items})


def _repetition(told: OneTraining) -> str:
    """Return what is drawn together when one asks how sure a figure is: a training, with all that it was tested on."""
    return f"{told.shares} seed {told.seed}"


def _accuracy(method: str, value: float, told: OneTraining, tested: dict[str, np.ndarray]) -> Score:
    count = sum(map(len, tested.values()))
    return Score("accuracy", method, value, "%", method in BASELINES, told.shares, f"seed {told.seed}", count=count)


def _predict(shard: Shard, store: Store) -> TopicResult:
    """Train the predictor twice on the same takes, once with their variants, and test it on clips of other takes."""
    told = shard.options(OneTraining)
    train, test = _split(shard, store, told)
    from pasdedeux.learning.networks.motion_predictor import train_predictor  # torch

    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    frames = HISTORY + HORIZON
    real, tested = _clips(variants, train, num_frames=frames), _clips(variants, test, num_frames=frames)
    made = _clips(variants, train, num_frames=frames, is_augmented=True)
    if not (real and tested):
        return TopicResult(notes=[f"{told.shares} seed {told.seed}: left out, no take of a side lasts 3 s."])
    guesses = {
        method: train_predictor(
            np.concatenate(list(clips.values())),
            told.learned.predictor,
            stream(shard.seed, "evaluation", "prediction", told.shares, told.seed),
        ).predict
        for method, clips in ((WITH, _joined(real, made)), (WITHOUT, real))
    }
    guesses[STILL] = lambda known: np.repeat(known[:, -1:], HORIZON, axis=1)
    scores, parts = [], []
    for number, (kind, clips) in enumerate(tested.items()):
        errors: dict[str, np.ndarray] = {}
        for method, guess in guesses.items():
            jme, ame = joint_errors(guess(clips[:, :HISTORY]), clips[:, HISTORY:])
            errors[method] = jme.mean(axis=1)
            scores += prediction_scores(jme, ame, method, split=told.shares, item=f"{kind}, seed {told.seed}")
        parts.append(Items(errors, [_repetition(told)] * len(clips), [number] * len(clips), BASELINES))
    return TopicResult(scores=scores, notes=[_said(told, train, test, real, made)], items={"": Items.joined(parts)})


def _split(shard: Shard, store: Store, told: OneTraining) -> tuple[list[Manifest], list[Manifest]]:
    """Return the takes learned from and tested on, drawn among those of every interaction; held out takes only test."""
    refuse_without_torch(f"the topic {shard.partition}", "evaluation.num_downstream_seeds=0")
    learn, judge = _SHARES[told.shares]
    generator = stream(shard.seed, "evaluation", "takes", told.shares, told.seed)
    by_kind: dict[str, list[Manifest]] = {}
    for ref in shard.refs("takes"):
        take = store.manifest(ref)
        by_kind.setdefault(interaction_of(take), []).append(take)
    train: list[Manifest] = []
    test: list[Manifest] = []
    for kind in sorted(by_kind):
        takes = sorted(by_kind[kind], key=lambda take: TakeFacts.of(take).take_id)
        takes = [takes[at] for at in generator.permutation(len(takes))]
        takes.sort(key=lambda take: TakeFacts.of(take).is_held_out)
        num_test = max(round(judge * len(takes)), 1)
        num_train = min(max(round(learn * len(takes)), 1), len(takes) - num_test)
        train += [take for take in takes[:num_train] if not TakeFacts.of(take).is_held_out]
        test += takes[len(takes) - num_test :]
    return train, test


def _clips(
    variants: StoredVariants, takes: Sequence[Manifest], *, num_frames: int | None, is_augmented: bool = False
) -> dict[str, np.ndarray]:
    """Return clips by interaction: of recognition, or of prediction, in the pair's frame where that begins.

    A take that is shorter than a clip of prediction has none: what is held still there would be a motion to predict.
    """
    cut: dict[str, Any] = (
        {} if num_frames is None else {"num_frames": num_frames, "frame": HISTORY - 1, "is_held": False}
    )
    found: dict[str, list[np.ndarray]] = {}
    for take in takes:
        take_id = TakeFacts.of(take).take_id
        source = variants.takes[take_id].source
        motions = [source.positions_m]
        if is_augmented:
            motions = [item.motion_m for item in variants.items(variants.sound_names(take_id))]
        found.setdefault(interaction_of(take), []).extend(clips_of(one, source.rate_hz, **cut) for one in motions)
    joined = {kind: np.concatenate(clips) for kind, clips in found.items() if clips}
    return {kind: clips for kind, clips in joined.items() if len(clips)}


def _joined(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {kind: np.concatenate([clips, *(other[kind] for _ in [0] if kind in other)]) for kind, clips in one.items()}


def _said(
    told: OneTraining,
    train: Sequence[Manifest],
    test: Sequence[Manifest],
    real: dict[str, np.ndarray],
    made: dict[str, np.ndarray],
) -> str:
    return (
        f"{told.shares} seed {told.seed}: {len(train)} takes to learn from with {sum(map(len, real.values()))} clips, "
        f"and {sum(map(len, made.values()))} of their variants; {len(test)} takes to test on. With and without have as "
        "many steps."
    )


RECOGNITION = Topic(
    name="recognition",
    heading="Recognition of interactions",
    introduction="A two-person ST-GCN tells clips of 2 s apart by interaction, trained with the variants of its "
    "training takes or without them, tested on clips of takes that neither saw.",
    reads=("poses", "variants", "variant_quality"),
    plan=_plan_recognition,
    run=_recognise,
    settings=LearnedSettings,
    criteria=(Criterion("accuracy", "accuracy of recognition", "%", "clips", (WITH,), is_larger_better=True),),
    tables=lambda scores: recognition_table(scores["recognition"]),
)

PREDICTION = Topic(
    name="prediction",
    heading="Prediction of motion",
    introduction="What comes in the next second, from the 2 s before (DCT, graph convolutions and attention to "
    "motion history), trained with the variants of the training takes or without them, tested on takes that neither "
    "saw; takes under 3 s are left out. JME is the error of joints where the pair is, AME that of poses laid onto "
    "the true ones.",
    reads=("poses", "variants", "variant_quality"),
    plan=_plan_prediction,
    run=_predict,
    settings=LearnedSettings,
    criteria=(Criterion("JME_mean", "mean error of prediction", "cm", "clips", (WITH,)),),
    has_means_first=True,
    tables=lambda scores: prediction_table(scores["prediction"]),
)
