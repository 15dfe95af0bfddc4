"""Topics `recognition` and `prediction`: gain of training with variants (Li et al. 2024, tables 4 and 5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.score_tables import TextTable, pivot_table
from pasdedeux.evaluation.scores import Score, bootstrap_interval
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning.clips import CLIP_HZ, HISTORY, HORIZON, clips_of, joint_errors
from storage_schema import Manifest, Store
from tasks.augmentation import solver_variants
from tasks.evaluation.realism import LearnedSettings
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import TakeFacts, VariantFacts
from tasks.stage import Parameters, Shard, StageInputs, stream
from tasks.training.items import StoredVariants, interaction_of
from tasks.training.run import refuse_without_torch

WITH, WITHOUT = "with_augmentation", "without_augmentation"
STILL, LARGEST = "last_pose_held", "largest_class"
BASELINES = (WITHOUT, STILL, LARGEST)
"""What learning with variants has to beat."""
HORIZONS_S = (0.2, 0.4, 0.6, 0.8, 1.0)
_SHARES = {"80/10/10": (0.8, 0.1), "50/20/30": (0.5, 0.3)}
"""Shares of the takes of every interaction for training and test; the rest is for validation, which nothing here uses,
as nothing is selected."""


class OneTraining(Parameters):
    """One repetition: which shares, and with which seed."""

    shares: str
    seed: int
    learned: LearnedSettings


def _plan(topic: Topic, shares: Sequence[str], inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan a shard for each repetition; interactions of one take cannot be split by take and are skipped."""
    takes = [take for take in inputs.of("poses") if TakeFacts.of(take).num_persons == 2]
    kinds = [interaction_of(take) for take in takes]
    used = [take for take, kind in zip(takes, kinds, strict=True) if kinds.count(kind) > 1]
    if not settings.num_downstream_seeds or len({interaction_of(take) for take in used}) < 2:
        return []
    ids = {TakeFacts.of(take).take_id for take in used}
    variants = [manifest for manifest in solver_variants(inputs) if VariantFacts.of(manifest).take_id in ids]
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
    options = shard.options(OneTraining)
    train, test = _split(shard, store, options)
    from pasdedeux.learning.networks.clip_classifier import train_classifier  # torch

    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    real, tested = _clips(variants, train, num_frames=None), _clips(variants, test, num_frames=None)
    made = _clips(variants, train, num_frames=None, is_augmented=True)
    scores = []
    for method, clips in ((WITH, _joined(real, made)), (WITHOUT, real)):
        generator = stream(shard.seed, "evaluation", "recognition", options.shares, options.seed)
        classifier = train_classifier(clips, options.learned.classifier, generator)
        scores.append(_accuracy(method, classifier.accuracy(tested), options, tested))
    largest = max(map(len, tested.values())) / sum(map(len, tested.values()))
    scores.append(_accuracy(LARGEST, 100.0 * largest, options, tested))
    values = {score.method: np.array([score.value]) for score in scores}
    items = Items(values, [_repetition(options)], [0.0], sum(map(len, tested.values())))
    return TopicResult(scores, (), [_note(options, train, test, real, made)], {"": items}, BASELINES)


def _repetition(options: OneTraining) -> str:
    """Return what is drawn together when one asks how sure a figure is: a training, with all that it was tested on."""
    return f"{options.shares} seed {options.seed}"


def _accuracy(method: str, value: float, options: OneTraining, tested: dict[str, np.ndarray]) -> Score:
    count = sum(map(len, tested.values()))
    return Score("accuracy", method, value, "%", split=options.shares, item=f"seed {options.seed}", count=count)


def _predict(shard: Shard, store: Store) -> TopicResult:
    """Train the predictor twice on the same takes, once with their variants, and test it on clips of other takes."""
    options = shard.options(OneTraining)
    train, test = _split(shard, store, options)
    from pasdedeux.learning.networks.motion_predictor import train_predictor  # torch

    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    frames = HISTORY + HORIZON
    real, tested = _clips(variants, train, num_frames=frames), _clips(variants, test, num_frames=frames)
    made = _clips(variants, train, num_frames=frames, is_augmented=True)
    if not (real and tested):
        return TopicResult(notes=[f"{options.shares} seed {options.seed}: skipped, no take of a side lasts 3 s."])
    guesses = {
        method: train_predictor(
            np.concatenate(list(clips.values())),
            options.learned.predictor,
            stream(shard.seed, "evaluation", "prediction", options.shares, options.seed),
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
            scores += prediction_scores(jme, ame, method, split=options.shares, item=f"{kind}, seed {options.seed}")
        parts.append(Items(errors, [_repetition(options)] * len(clips), [number] * len(clips)))
    notes = [_note(options, train, test, real, made)]
    return TopicResult(scores, (), notes, {"": Items.joined(parts)}, BASELINES)


def _split(shard: Shard, store: Store, options: OneTraining) -> tuple[list[Manifest], list[Manifest]]:
    """Return the takes learned from and tested on, drawn among those of every interaction; held out takes only test."""
    refuse_without_torch(f"the topic {shard.partition}", "evaluation.num_downstream_seeds=0")
    learn, judge = _SHARES[options.shares]
    generator = stream(shard.seed, "evaluation", "takes", options.shares, options.seed)
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


def _note(
    options: OneTraining,
    train: Sequence[Manifest],
    test: Sequence[Manifest],
    real: dict[str, np.ndarray],
    made: dict[str, np.ndarray],
) -> str:
    return (
        f"{options.shares} seed {options.seed}: {len(train)} training takes with {sum(map(len, real.values()))} clips, "
        f"and {sum(map(len, made.values()))} of their variants; {len(test)} test takes. Both train for as many steps."
    )


def prediction_scores(jme: Array, ame: Array, method: str, *, split: str, item: str) -> list[Score]:
    """Return JME and AME (n, 10) of clips, cm, at the published horizons, and their means over the whole second."""
    scores = []
    for metric, errors in (("JME", jme), ("AME", ame)):
        more: dict[str, Any] = {"split": split, "item": item, "count": len(errors)}
        scores.append(Score(f"{metric}_mean", method, float(errors.mean()), "cm", **more))
        for horizon in HORIZONS_S:
            at = round(horizon * CLIP_HZ) - 1
            scores.append(Score(metric, method, float(errors[:, at].mean()), "cm", at=horizon, **more))
    return scores


def recognition_table(scores: Sequence[Score]) -> list[TextTable]:
    """Return accuracy with and without augmentation, and the effect over seeds with its interval."""
    rows = []
    for split in sorted({score.split for score in scores}, reverse=True):
        found = _paired([score for score in scores if score.split == split and score.metric == "accuracy"])
        if found:
            with_, without = (np.array(values) for values in zip(*found.values(), strict=True))
            rows.append((split, f"{with_.mean():.2f}", f"{without.mean():.2f}", _effect(with_ - without)))
    headings = ("training / validation / test", "with", "without", "effect (95 % over seeds)")
    caption = "As table 5 of the paper: accuracy of recognition, %, with and without augmentation"
    return [TextTable(caption, headings, tuple(rows))] if rows else []


def prediction_table(scores: Sequence[Score]) -> list[TextTable]:
    """Return JME and AME of every motion and horizon, and the effect of augmentation over seeds.

    Motions of one seed share what was trained, so they are drawn together.
    """
    rows: list[tuple[str, ...]] = []
    horizons = {f"{horizon:g}": f"{horizon} s" for horizon in HORIZONS_S}
    headings = ("motion", "error")
    caption = "As table 4 of the paper: error of prediction, cm, with augmentation / without / last pose held"
    for metric in ("JME", "AME"):
        mine = sorted((score for score in scores if score.metric == metric), key=_motion)
        table = pivot_table(
            mine, caption, headings, lambda s: (_motion(s), s.metric), horizons, lambda s: f"{s.at:g}", _means
        )
        effects = []
        for horizon in horizons:
            pairs = _paired([score for score in mine if f"{score.at:g}" == horizon])
            seeds = [item.rpartition(",")[2] for item in pairs]
            effects.append(_effect(np.array([one - other for one, other in pairs.values()]), seeds) if pairs else "")
        rows += [*table.rows, ("effect (95 % over seeds)", metric, *effects)] if table.rows else []
    return [TextTable(caption, (*headings, *horizons.values()), tuple(rows))] if rows else []


def _motion(score: Score) -> str:
    return score.item.rpartition(",")[0]


def _means(found: Sequence[Score]) -> str:
    values = [[score.value for score in found if score.method == method] for method in (WITH, WITHOUT, STILL)]
    return " / ".join(f"{np.mean(own):.2f}" if own else "-" for own in values)


def _paired(scores: Sequence[Score]) -> dict[str, tuple[float, float]]:
    """Return the figures with and without augmentation of each item that has both."""
    one, other = ({s.item: s.value for s in scores if s.method == method} for method in (WITH, WITHOUT))
    return {item: (one[item], other[item]) for item in sorted(set(one) & set(other))}


def _effect(differences: Array, units: Sequence[str] | None = None) -> str:
    low, high = bootstrap_interval(differences, units=units)
    interval = f" ({low:+.2f} to {high:+.2f})" if np.isfinite(low) else ""
    return f"{differences.mean():+.2f}{interval}"


RECOGNITION = Topic(
    name="recognition",
    heading="Recognition of interactions",
    introduction="A two-person ST-GCN classifies clips of 2 s by interaction, trained with or without the variants of "
    "its training takes, and tested on clips of unseen takes.",
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
    introduction="Motion of the next second, predicted from the 2 s before (DCT, graph convolutions and attention to "
    "motion history), trained with or without the variants of the training takes, and tested on unseen takes; takes "
    "under 3 s are skipped. JME is the joint error in place, AME that of poses aligned with the true ones.",
    reads=("poses", "variants", "variant_quality"),
    plan=_plan_prediction,
    run=_predict,
    settings=LearnedSettings,
    criteria=(Criterion("JME_mean", "mean error of prediction", "cm", "clips", (WITH,)),),
    has_means_first=True,
    tables=lambda scores: prediction_table(scores["prediction"]),
)
