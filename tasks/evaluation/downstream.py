"""Topics `recognition` and `prediction`: gain of training with variants (Li et al. 2024, tables 4 to 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.score_tables import TextTable, pivot_table
from pasdedeux.evaluation.scores import Score, bootstrap_interval
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning.clips import CLIP_HZ, HISTORY, HORIZON, cut_clips, exchange_people, joint_errors
from pasdedeux.learning.meter import GENERATED, SOLVER
from storage_schema import Manifest, Store
from tasks.evaluation.realism import LearnedSettings
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.takes import takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import ModelFacts, TakeFacts, VariantFacts
from tasks.stage.streams import stream
from tasks.training.items import StoredVariants, interaction_of
from tasks.training.run import refuse_without_torch

BY_SOLVER, BY_MODEL, WITHOUT = "augmented_by_solver", "augmented_by_model", "without_augmentation"
STILL, LARGEST, TRUTH = "last_pose_held", "largest_class", "truth"
BASELINES = (WITHOUT, STILL, LARGEST)
"""Baseline that learning with variants has to beat."""
HORIZONS_S = (0.2, 0.4, 0.6, 0.8, 1.0)
_SHARES = {"80/10/10": (0.8, 0.1), "50/20/30": (0.5, 0.3)}
"""Shares of the takes of every interaction for training and test; the rest is for validation, which nothing here uses,
as nothing is selected."""
_BY = "augmented_by_"
_FEW_TEST = 0.3
"""Share of the takes that test where the number of training takes is stated, the same for every number."""
_METHODS = (BY_SOLVER, BY_MODEL, WITHOUT, STILL, TRUTH, SOLVER, GENERATED, LARGEST)
"""In the order of the tables' columns; further models come after them."""
_JUDGED = {BY_SOLVER: "", BY_MODEL: "model"}
"""Names of the criteria by what they judge."""
_ASKED = {BY_SOLVER: SOLVER, BY_MODEL: GENERATED}
"""Name of the solver's variants of test takes, which a classifier recognises; those of models have their own."""

Clips = Mapping[str, Array]
"""Clips (n, T, 2, 22, 3), metres, by interaction."""


class OneTraining(Parameters):
    """One repetition: its shares and seed, and the models beside the solver with the takes that they saw."""

    shares: str
    seed: int
    learned: LearnedSettings
    models: tuple[str, ...] = ()
    seen: tuple[str, ...] = ()


def _plan(topic: Topic[None], shares: Sequence[str], inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan a shard for each repetition; interactions of one take cannot be split by take and are skipped."""
    takes = takes_of(inputs, 2)
    kinds = [interaction_of(take) for take in takes]
    used = [take for take, kind in zip(takes, kinds, strict=True) if kinds.count(kind) > 1]
    if not settings.num_downstream_seeds or len({interaction_of(take) for take in used}) < 2:
        return []
    ids = {TakeFacts.of(take).take_id for take in used}
    by_model: dict[str, list[Manifest]] = {}
    for manifest in inputs.of("variants"):
        if VariantFacts.of(manifest).take_id in ids:
            by_model.setdefault(_model_of(manifest), []).append(manifest)
    solved = by_model.pop("", [])
    models, seen = _unseeing_models(inputs, used, by_model)
    return [
        topic.shard(
            inputs,
            f"{name} seed {seed}",
            OneTraining(shares=name, seed=seed, learned=settings.part(LearnedSettings), models=models, seen=seen),
            takes=used,
            variants=solved,
            generated=[manifest for model in models for manifest in by_model[model]],
        )
        for name in shares
        for seed in range(settings.num_downstream_seeds)
    ]


def _unseeing_models(
    inputs: StageInputs, takes: Iterable[Manifest], sampled: Iterable[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return models that variants were sampled from, as NAME@SPLIT, and the takes that they learned from or chose by.

    Only takes that they did not see are tested on, so all saw the same takes as the first that left some of two
    interactions.  Empty where there is none.
    """
    known = [ModelFacts.of(manifest) for manifest in inputs.of("models")]
    saw = {f"{facts.model}@{facts.split}": tuple(sorted({*facts.train, *facts.validation})) for facts in known}
    usable = [
        name
        for name in sampled
        if name in saw
        and len({interaction_of(take) for take in takes if TakeFacts.of(take).take_id not in saw[name]}) > 1
    ]
    seen = saw[usable[0]] if usable else ()
    return tuple(name for name in usable if saw[name] == seen), seen


def _model_of(variants: Manifest) -> str:
    """Return the model that variants were sampled from as NAME@SPLIT; empty for those of the solver."""
    origin = VariantFacts.of(variants).origin
    return "" if origin is None else f"{origin.model}@{origin.split}"


def _shares(settings: LearnedSettings) -> tuple[str, ...]:
    """Return the names of the divisions of takes: by share as published, or by how many are learned from."""
    return tuple(map(str, settings.num_training_takes)) or tuple(_SHARES)


def _plan_recognition(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan every division of takes, with every seed."""
    return _plan(RECOGNITION, _shares(settings), inputs, settings)


def _plan_prediction(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan the first published division of takes, or every number of them, with every seed."""
    return _plan(PREDICTION, _shares(settings)[: len(settings.num_training_takes) or 1], inputs, settings)


def _recognise(shard: Shard, store: Store) -> TopicResult[None]:
    """Train a classifier on each training set; test it on clips of other takes, and one on variants of these.

    The latter learned from real clips alone (table 6 of the paper).
    """
    repetition = _Repetition(shard, store)
    from pasdedeux.learning.networks.clip_classifier import train_classifier  # torch

    learned = repetition.options.learned
    classes = _with_roles if learned.tells_roles else dict[str, Array]
    tested = classes(repetition.clips(repetition.test))
    trained = {
        method: train_classifier(
            classes(clips), learned.classifier, repetition.stream("recognition"), tells_roles=learned.tells_roles
        )
        for method, clips in repetition.training_sets.items()
    }
    shares = {method: classifier.accuracy(tested) for method, classifier in trained.items()}
    shares[LARGEST] = 100.0 * max(map(len, tested.values())) / _count(tested)
    asked = {
        _ASKED.get(by, by.removeprefix(_BY)): classes(repetition.clips(repetition.test, by, has_takes=False))
        for by in trained
        if by != WITHOUT
    }
    figures = [("recognised", name, trained[WITHOUT].accuracy(clips), clips) for name, clips in asked.items() if clips]
    figures += [("recognised", name, shares[method], tested) for name, method in ((TRUTH, WITHOUT), (LARGEST, LARGEST))]
    figures += [("accuracy", method, value, tested) for method, value in shares.items()]
    more: dict[str, Any] = {"split": repetition.options.shares, "item": f"seed {repetition.options.seed}"}
    scores = [Score(metric, name, value, "%", count=_count(clips), **more) for metric, name, value, clips in figures]
    values = {method: np.array([value]) for method, value in shares.items()}
    return repetition.result(scores, Items(values, [repetition.name], [0.0], _count(tested)))


def _with_roles(clips: Clips) -> Clips:
    """Return the clips; those with A and B exchanged form another class."""
    return {**clips, **{f"{kind}, exchanged": exchange_people(some) for kind, some in clips.items()}}


def _predict(shard: Shard, store: Store) -> TopicResult[None]:
    """Train a predictor on each training set, and test it on clips of other takes."""
    # A take shorter than a clip has none: a pose held still at its end would count as motion to predict.
    repetition = _Repetition(shard, store, num_frames=HISTORY + HORIZON, frame=HISTORY - 1, is_held=False)
    from pasdedeux.learning.networks.motion_predictor import train_predictor  # torch

    tested = repetition.clips(repetition.test)
    if not (repetition.training_sets[WITHOUT] and tested):
        return TopicResult(
            notes=[f"{repetition.name}: skipped, because training or test takes are all shorter than 3 s."]
        )
    guesses: dict[str, Callable[[Array], Array]] = {
        method: train_predictor(
            np.concatenate(list(clips.values())), repetition.options.learned.predictor, repetition.stream("prediction")
        ).predict
        for method, clips in repetition.training_sets.items()
    }
    guesses[STILL] = lambda known: np.repeat(known[:, -1:], HORIZON, axis=1)
    scores, parts = [], []
    for number, (kind, clips) in enumerate(tested.items()):
        errors: dict[str, np.ndarray] = {}
        for method, guess in guesses.items():
            jme, ame = joint_errors(guess(clips[:, :HISTORY]), clips[:, HISTORY:])
            errors[method] = jme.mean(axis=1)
            item = f"{kind}, seed {repetition.options.seed}"
            scores += prediction_scores(jme, ame, method, split=repetition.options.shares, item=item)
        parts.append(Items(errors, [repetition.name] * len(clips), [number] * len(clips)))
    return repetition.result(scores, Items.joined(parts))


class _Repetition:
    """The takes and clips of one repetition, cut with the arguments of `cut_clips`."""

    def __init__(self, shard: Shard, store: Store, **cut: Any) -> None:
        refuse_without_torch(f"the topic {shard.partition}", "evaluation.num_downstream_seeds=0")
        self.options, self._seed, self._cut = shard.options(OneTraining), shard.seed, cut
        takes, first = shard.refs("takes"), self.options.models[:1]
        refs_by_origin = {BY_SOLVER: list(shard.refs("variants"))}
        for ref in shard.refs("generated"):
            model = _model_of(store.manifest(ref))
            by = BY_MODEL if model in first else _BY + model.partition("@")[0]
            refs_by_origin.setdefault(by, []).append(ref)
        self._variants = {by: StoredVariants(store, takes, refs) for by, refs in refs_by_origin.items()}
        self.train, self.test = split_takes(map(store.manifest, takes), self.options, self.stream("takes"))

    @property
    def name(self) -> str:
        """Unit of resampling for intervals: one training with everything it was tested on."""
        return f"{self.options.shares} seed {self.options.seed}"

    def stream(self, what: str) -> np.random.Generator:
        """Return the random generator for a purpose, the same for every training set."""
        return stream(self._seed, "evaluation", what, self.options.shares, self.options.seed)

    def clips(self, takes: Iterable[Manifest], by: str = WITHOUT, *, has_takes: bool = True) -> Clips:
        """Return clips of takes, and of as many of their variants as solver and models all have."""
        clips: dict[str, list[Array]] = {}
        for take in takes:
            take_id = TakeFacts.of(take).take_id
            source = self._variants[BY_SOLVER].takes[take_id].source
            motions = [source.positions_m] if has_takes else []
            if by != WITHOUT:
                sound = {name: variants.sound_names(take_id) for name, variants in self._variants.items()}
                count = min(map(len, sound.values()))
                chosen = [sound[by][at * len(sound[by]) // count] for at in range(count)]
                motions += [item.motion_m for item in self._variants[by].items(chosen)]
            cut = [cut_clips(motion, source.rate_hz, **self._cut) for motion in motions]
            clips.setdefault(interaction_of(take), []).extend(cut)
        return {kind: joined for kind, cut in clips.items() if cut and len(joined := np.concatenate(cut))}

    @cached_property
    def training_sets(self) -> dict[str, Clips]:
        """The training sets: real clips alone, and with equally many variants of the solver and of each model."""
        return {by: self.clips(self.train, by) for by in (*self._variants, WITHOUT)}

    def result(self, scores: Sequence[Score], items: Items) -> TopicResult[None]:
        """Return the result of a topic, with a description of its data."""
        real, augmented = (_count(self.training_sets[by]) for by in (WITHOUT, BY_SOLVER))
        note = (
            f"{self.name}: {len(self.train)} training takes with {real} clips, and {augmented - real} of their "
            f"variants; {len(self.test)} test takes. All train for as many steps."
        )
        if self.options.models:
            note += f" The same number of variants is from {', '.join(self.options.models)}, which saw no test take."
        judged = {name: items for by, name in _JUDGED.items() if by in items.values}
        return TopicResult(scores, [note], judged, BASELINES)


def split_takes(
    takes: Iterable[Manifest], options: OneTraining, generator: np.random.Generator
) -> tuple[list[Manifest], list[Manifest]]:
    """Return the takes learned from and tested on, drawn among those of every interaction.

    Held-out takes are only tested on; takes that the model saw are never tested on.
    """
    learn, judge = _SHARES.get(options.shares, (0.0, _FEW_TEST))
    by_kind: dict[str, list[Manifest]] = {}
    for take in takes:
        by_kind.setdefault(interaction_of(take), []).append(take)
    train: list[Manifest] = []
    test: list[Manifest] = []
    for kind in sorted(by_kind):
        ordered = sorted(by_kind[kind], key=lambda take: TakeFacts.of(take).take_id)
        drawn = [ordered[at] for at in generator.permutation(len(ordered))]
        drawn.sort(key=lambda take: (TakeFacts.of(take).is_held_out, TakeFacts.of(take).take_id not in options.seen))
        num_test = max(round(judge * len(drawn)), 1)
        wanted = round(learn * len(drawn)) if learn else int(options.shares)
        num_train = min(max(wanted, 1), len(drawn) - num_test)
        train += [take for take in drawn[:num_train] if not TakeFacts.of(take).is_held_out]
        test += [take for take in drawn[-num_test:] if TakeFacts.of(take).take_id not in options.seen]
    return train, test


def _count(clips: Clips) -> int:
    return sum(map(len, clips.values()))


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


def recognition_tables(scores: Sequence[Score]) -> list[TextTable]:
    """Return the accuracy of each training set with its effect over seeds, and the share of variants recognised."""
    captions = {
        "accuracy": "As table 5 of the paper: accuracy of recognition, %",
        "recognised": "As table 6 of the paper: clips, %, that a classifier of real clips recognises",
    }
    return [
        table
        for metric, caption in captions.items()
        for table in _seed_table([score for score in scores if score.metric == metric], caption)
    ]


def prediction_tables(scores: Sequence[Score]) -> list[TextTable]:
    """Return mean errors of each training set with its effect over seeds, and JME and AME of every motion and horizon.

    Motions of one seed share a trained network, so their mean is taken first.
    """
    tables, methods = [], _METHODS[: _METHODS.index(STILL) + 1]
    for metric in ("JME", "AME"):
        caption = f"{metric} over the whole second, cm"
        tables += _seed_table([score for score in scores if score.metric == f"{metric}_mean"], caption)
    for metric in ("JME", "AME"):
        table = pivot_table(
            sorted((score for score in scores if score.metric == metric), key=_motion),
            f"As table 4 of the paper: {metric}, cm, {' / '.join(map(in_words, methods))}",
            ("motion",),
            lambda s: (_motion(s),),
            {f"{horizon:g}": f"{horizon} s" for horizon in HORIZONS_S},
            lambda s: f"{s.at:g}",
            lambda in_cell: " / ".join(_mean([score for score in in_cell if score.method == name]) for name in methods),
        )
        tables += [table] if table.rows else []
    return tables


def _seed_table(scores: Sequence[Score], caption: str) -> list[TextTable]:
    """Return the figures of each training set by split, and differences seed by seed; empty without figures."""
    there = {score.method for score in scores}
    methods = [method for method in (*_METHODS, *sorted(there.difference(_METHODS))) if method in there]
    augmented = [method for method in methods if method.startswith(_BY)]
    pairs = [(method, WITHOUT) for method in augmented] + [
        (method, BY_SOLVER) for method in augmented if method != BY_SOLVER
    ]
    pairs = [pair for pair in pairs if there.issuperset(pair)]
    rows = []
    splits = {score.split: None for score in sorted(scores, key=lambda score: _division(score.split))}
    for split in splits:
        by_seed = {
            name: _of_seeds(score for score in scores if (score.split, score.method) == (split, name))
            for name in methods
        }
        differences = [[by_seed[name][seed] - by_seed[other][seed] for seed in by_seed[name]] for name, other in pairs]
        rows.append((split, *(_spread([*seeds.values()]) for seeds in by_seed.values()), *map(_effect, differences)))
    effects = (f"{in_words(name)} - {in_words(other)} (95 %)" for name, other in pairs)
    division = "training / validation / test" if "/" in "".join(splits) else "training takes of each interaction"
    headings = (division, *map(in_words, methods), *effects)
    return [TextTable(caption, headings, tuple(rows))] if rows else []


def _division(split: str) -> tuple[int, str]:
    """Return the key by which divisions of takes are sorted: few takes first, large shares first."""
    return (int(split), "") if split.isdecimal() else (-int(split.partition("/")[0]), split)


def _of_seeds(scores: Iterable[Score]) -> dict[str, float]:
    """Return the mean of each seed."""
    by_seed: dict[str, list[float]] = {}
    for score in scores:
        by_seed.setdefault(score.item.rpartition(", ")[2], []).append(score.value)
    return {seed: float(np.mean(values)) for seed, values in sorted(by_seed.items())}


def _mean(scores: Sequence[Score]) -> str:
    return f"{np.mean([score.value for score in scores]):.2f}" if scores else "-"


def _spread(values: Sequence[float]) -> str:
    deviation = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{deviation}" if values else "-"


def _effect(differences: Sequence[float]) -> str:
    low, high = bootstrap_interval(np.array(differences)) if differences else (np.nan, np.nan)
    interval = f" ({low:+.2f} to {high:+.2f})" if np.isfinite(low) else ""
    return f"{np.mean(differences):+.2f}{interval}" if differences else "-"


def _motion(score: Score) -> str:
    return score.item.rpartition(",")[0]


_MODEL_TOO = (
    " Variants are made by the solver or, in the same number, by a model of the stage `generation` that "
    "saw no test take."
)
RECOGNITION = Topic(
    name="recognition",
    heading="Recognition of interactions",
    introduction="A two-person ST-GCN classifies clips of 2 s by interaction. It is trained with or without variants "
    "of its training takes, and tested on clips of unseen takes. The classifier without variants is also "
    "tested on variants of the test takes." + _MODEL_TOO,
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan_recognition,
    compute=_recognise,
    settings=LearnedSettings,
    criteria=tuple(
        Criterion("accuracy", "accuracy of recognition", "%", "clips", (method,), name, is_larger_better=True)
        for method, name in _JUDGED.items()
    ),
    tabulate=lambda scores: recognition_tables(scores["recognition"]),
)

PREDICTION = Topic(
    name="prediction",
    heading="Prediction of motion",
    introduction="A network predicts the next second of motion from the last 2 s (DCT, graph convolutions, attention "
    "to motion history). It is trained with or without variants of the training takes, and tested on "
    "unseen takes; takes under 3 s are skipped. JME is the joint error in place, AME the joint error of "
    "aligned poses." + _MODEL_TOO,
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan_prediction,
    compute=_predict,
    settings=LearnedSettings,
    criteria=tuple(
        Criterion("JME_mean", "mean error of prediction", "cm", "clips", (method,), name)
        for method, name in _JUDGED.items()
    ),
    has_means_first=True,
    tabulate=lambda scores: prediction_tables(scores["prediction"]),
)
