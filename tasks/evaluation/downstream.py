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
from pasdedeux.learning.clips import CLIP_HZ, HISTORY, HORIZON, clips_of, joint_errors
from pasdedeux.learning.meter import GENERATED, SOLVER
from storage_schema import Manifest, Store
from tasks.evaluation.realism import LearnedSettings
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import ModelFacts, TakeFacts, VariantFacts
from tasks.stage import Parameters, Shard, StageInputs
from tasks.streams import stream
from tasks.takes import takes_of
from tasks.training.items import StoredVariants, interaction_of
from tasks.training.run import refuse_without_torch

BY_SOLVER, BY_MODEL, WITHOUT = "augmented_by_solver", "augmented_by_model", "without_augmentation"
STILL, LARGEST, TRUTH = "last_pose_held", "largest_class", "truth"
BASELINES = (WITHOUT, STILL, LARGEST)
"""What learning with variants has to beat."""
HORIZONS_S = (0.2, 0.4, 0.6, 0.8, 1.0)
_SHARES = {"80/10/10": (0.8, 0.1), "50/20/30": (0.5, 0.3)}
"""Shares of the takes of every interaction for training and test; the rest is for validation, which nothing here uses,
as nothing is selected."""
_METHODS = (BY_SOLVER, BY_MODEL, WITHOUT, STILL, TRUTH, SOLVER, GENERATED, LARGEST)
"""In the order of the tables' columns."""
_JUDGED = {BY_SOLVER: "", BY_MODEL: "model"}
"""Names of the criteria by what they judge."""
_ASKED = {BY_SOLVER: SOLVER, BY_MODEL: GENERATED}
"""What the variants of test takes are called that a classifier is asked about."""
_EFFECTS = ((BY_SOLVER, WITHOUT), (BY_MODEL, WITHOUT), (BY_MODEL, BY_SOLVER))
"""Trainings that are compared seed by seed."""

Clips = Mapping[str, Array]
"""Clips (n, T, 2, 22, 3), metres, by interaction."""


class OneTraining(Parameters):
    """One repetition: which shares, with which seed, and the model beside the solver with the takes that it saw."""

    shares: str
    seed: int
    learned: LearnedSettings
    model: str = ""
    seen: tuple[str, ...] = ()


def _plan(topic: Topic[None], shares: Sequence[str], inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan a shard for each repetition; interactions of one take cannot be split by take and are skipped."""
    takes = takes_of(inputs, 2)
    kinds = [interaction_of(take) for take in takes]
    used = [take for take, kind in zip(takes, kinds, strict=True) if kinds.count(kind) > 1]
    if not settings.num_downstream_seeds or len({interaction_of(take) for take in used}) < 2:
        return []
    ids = {TakeFacts.of(take).take_id for take in used}
    model, seen = _unseeing_model(inputs, used)
    made: dict[str, list[Manifest]] = {}
    for manifest in inputs.of("variants"):
        if VariantFacts.of(manifest).take_id in ids:
            made.setdefault(_model_of(manifest), []).append(manifest)
    return [
        topic.shard(
            inputs,
            f"{name} seed {seed}",
            OneTraining(shares=name, seed=seed, learned=settings.part(LearnedSettings), model=model, seen=seen),
            takes=used,
            variants=made.get("", []),
            generated=made[model] if model else [],
        )
        for name in shares
        for seed in range(settings.num_downstream_seeds)
    ]


def _unseeing_model(inputs: StageInputs, takes: Iterable[Manifest]) -> tuple[str, tuple[str, ...]]:
    """Return the model of the sampled variants, as NAME@SPLIT, and the takes that it learned from or was chosen by.

    Only takes that it did not see are tested on.  Empty where it left none of two interactions, or there is no model.
    """
    for manifest in inputs.of("models"):
        facts = ModelFacts.of(manifest)
        name, seen = f"{facts.model}@{facts.split}", {*facts.train, *facts.validation}
        unseen = {interaction_of(take) for take in takes if TakeFacts.of(take).take_id not in seen}
        if len(unseen) > 1 and any(_model_of(one) == name for one in inputs.of("variants")):
            return name, tuple(sorted(seen))
    return "", ()


def _model_of(variants: Manifest) -> str:
    """Return the model that variants were sampled from as NAME@SPLIT; empty for those of the solver."""
    origin = VariantFacts.of(variants).origin
    return "" if origin is None else f"{origin.model}@{origin.split}"


def _plan_recognition(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan both shares of takes, with every seed."""
    return _plan(RECOGNITION, tuple(_SHARES), inputs, settings)


def _plan_prediction(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan the first shares of takes, with every seed."""
    return _plan(PREDICTION, tuple(_SHARES)[:1], inputs, settings)


def _recognise(shard: Shard, store: Store) -> TopicResult[None]:
    """Train a classifier on each training set and test it on clips of other takes; ask one what variants of these are.

    That one learned from real clips alone (table 6 of the paper).
    """
    one = _Repetition(shard, store)
    from pasdedeux.learning.networks.clip_classifier import train_classifier  # torch

    tested = one.clips(one.test)
    trained = {
        method: train_classifier(clips, one.options.learned.classifier, one.stream("recognition"))
        for method, clips in one.training_sets.items()
    }
    found = {method: classifier.accuracy(tested) for method, classifier in trained.items()}
    found[LARGEST] = 100.0 * max(map(len, tested.values())) / _count(tested)
    asked = {name: one.clips(one.test, by, has_takes=False) for by, name in _ASKED.items() if by in trained}
    told = [("recognised", name, trained[WITHOUT].accuracy(clips), clips) for name, clips in asked.items() if clips]
    told += [("recognised", name, found[method], tested) for name, method in ((TRUTH, WITHOUT), (LARGEST, LARGEST))]
    told += [("accuracy", method, value, tested) for method, value in found.items()]
    more: dict[str, Any] = {"split": one.options.shares, "item": f"seed {one.options.seed}"}
    scores = [Score(metric, name, value, "%", count=_count(clips), **more) for metric, name, value, clips in told]
    values = {method: np.array([value]) for method, value in found.items()}
    return one.result(scores, Items(values, [one.name], [0.0], _count(tested)))


def _predict(shard: Shard, store: Store) -> TopicResult[None]:
    """Train a predictor on each training set, and test it on clips of other takes."""
    # A take that is shorter than a clip has none: what is held still there would be a motion to predict.
    one = _Repetition(shard, store, num_frames=HISTORY + HORIZON, frame=HISTORY - 1, is_held=False)
    from pasdedeux.learning.networks.motion_predictor import train_predictor  # torch

    tested = one.clips(one.test)
    if not (one.training_sets[WITHOUT] and tested):
        return TopicResult(notes=[f"{one.name}: skipped, no take of a side lasts 3 s."])
    guesses: dict[str, Callable[[Array], Array]] = {
        method: train_predictor(
            np.concatenate(list(clips.values())), one.options.learned.predictor, one.stream("prediction")
        ).predict
        for method, clips in one.training_sets.items()
    }
    guesses[STILL] = lambda known: np.repeat(known[:, -1:], HORIZON, axis=1)
    scores, parts = [], []
    for number, (kind, clips) in enumerate(tested.items()):
        errors: dict[str, np.ndarray] = {}
        for method, guess in guesses.items():
            jme, ame = joint_errors(guess(clips[:, :HISTORY]), clips[:, HISTORY:])
            errors[method] = jme.mean(axis=1)
            item = f"{kind}, seed {one.options.seed}"
            scores += prediction_scores(jme, ame, method, split=one.options.shares, item=item)
        parts.append(Items(errors, [one.name] * len(clips), [number] * len(clips)))
    return one.result(scores, Items.joined(parts))


class _Repetition:
    """The takes and clips of one repetition; clips are cut as `clips_of` is told."""

    def __init__(self, shard: Shard, store: Store, **cut: Any) -> None:
        refuse_without_torch(f"the topic {shard.partition}", "evaluation.num_downstream_seeds=0")
        self.options, self._seed, self._cut = shard.options(OneTraining), shard.seed, cut
        takes = shard.refs("takes")
        makers = {BY_SOLVER: "variants"} | ({BY_MODEL: "generated"} if self.options.model else {})
        self._variants = {by: StoredVariants(store, takes, shard.refs(name)) for by, name in makers.items()}
        self.train, self.test = split_takes(map(store.manifest, takes), self.options, self.stream("takes"))

    @property
    def name(self) -> str:
        """What is drawn together when one asks how sure a figure is: a training, with all that it was tested on."""
        return f"{self.options.shares} seed {self.options.seed}"

    def stream(self, what: str) -> np.random.Generator:
        """Return the generator for something, the same for every training set."""
        return stream(self._seed, "evaluation", what, self.options.shares, self.options.seed)

    def clips(self, takes: Iterable[Manifest], by: str = WITHOUT, *, has_takes: bool = True) -> Clips:
        """Return clips of takes, and of as many of their variants as solver and model both have."""
        found: dict[str, list[Array]] = {}
        for take in takes:
            take_id = TakeFacts.of(take).take_id
            source = self._variants[BY_SOLVER].takes[take_id].source
            motions = [source.positions_m] if has_takes else []
            if by != WITHOUT:
                sound = {one: variants.sound_names(take_id) for one, variants in self._variants.items()}
                count = min(map(len, sound.values()))
                chosen = [sound[by][at * len(sound[by]) // count] for at in range(count)]
                motions += [item.motion_m for item in self._variants[by].items(chosen)]
            cut = [clips_of(motion, source.rate_hz, **self._cut) for motion in motions]
            found.setdefault(interaction_of(take), []).extend(cut)
        return {kind: joined for kind, own in found.items() if own and len(joined := np.concatenate(own))}

    @cached_property
    def training_sets(self) -> dict[str, Clips]:
        """The real clips with as many variants of solver and of model, and alone."""
        return {by: self.clips(self.train, by) for by in (*self._variants, WITHOUT)}

    def result(self, scores: Sequence[Score], items: Items) -> TopicResult[None]:
        """Return what a topic found, with what it was found on in words."""
        real, augmented = (_count(self.training_sets[by]) for by in (WITHOUT, BY_SOLVER))
        note = (
            f"{self.name}: {len(self.train)} training takes with {real} clips, and {augmented - real} of their "
            f"variants; {len(self.test)} test takes. All train for as many steps."
        )
        if self.options.model:
            note += f" {self.options.model} made as many variants, and saw none of the test takes."
        judged = {name: items for by, name in _JUDGED.items() if by in items.values}
        return TopicResult(scores, [note], judged, BASELINES)


def split_takes(
    takes: Iterable[Manifest], options: OneTraining, generator: np.random.Generator
) -> tuple[list[Manifest], list[Manifest]]:
    """Return the takes learned from and tested on, drawn among those of every interaction.

    Held-out takes only test, takes that the model saw do not.
    """
    learn, judge = _SHARES[options.shares]
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
        num_train = min(max(round(learn * len(drawn)), 1), len(drawn) - num_test)
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
    """Return accuracy of each training set with its effect over seeds, and what is recognised of variants."""
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

    Motions of one seed share what was trained, so their mean is taken first.
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
            lambda found: " / ".join(_mean([one for one in found if one.method == name]) for name in methods),
        )
        tables += [table] if table.rows else []
    return tables


def _seed_table(scores: Sequence[Score], caption: str) -> list[TextTable]:
    """Return the figures of each training set by split, and differences seed by seed; none where there is none."""
    there = {score.method for score in scores}
    methods = [method for method in _METHODS if method in there]
    pairs = [pair for pair in _EFFECTS if there.issuperset(pair)]
    rows = []
    for split in sorted({score.split for score in scores}, reverse=True):
        found = {
            name: _of_seeds(score for score in scores if (score.split, score.method) == (split, name))
            for name in methods
        }
        differences = [[found[one][seed] - found[other][seed] for seed in found[one]] for one, other in pairs]
        rows.append((split, *(_spread([*own.values()]) for own in found.values()), *map(_effect, differences)))
    effects = (f"{in_words(one)} - {in_words(other)} (95 %)" for one, other in pairs)
    headings = ("training / validation / test", *map(in_words, methods), *effects)
    return [TextTable(caption, headings, tuple(rows))] if rows else []


def _of_seeds(scores: Iterable[Score]) -> dict[str, float]:
    """Return the mean of each seed."""
    found: dict[str, list[float]] = {}
    for score in scores:
        found.setdefault(score.item.rpartition(", ")[2], []).append(score.value)
    return {seed: float(np.mean(values)) for seed, values in sorted(found.items())}


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
    " Variants are the solver's, or as many of a model (stage `generation`) that saw no test take, as those of splits "
    "across interactions."
)
RECOGNITION = Topic(
    name="recognition",
    heading="Recognition of interactions",
    introduction="A two-person ST-GCN classifies clips of 2 s by interaction, trained with or without the variants of "
    "its training takes, and tested on clips of unseen takes. The one without is also asked what variants of the test "
    "takes are." + _MODEL_TOO,
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
    introduction="Motion of the next second, predicted from the 2 s before (DCT, graph convolutions and attention to "
    "motion history), trained with or without the variants of the training takes, and tested on unseen takes; takes "
    "under 3 s are skipped. JME is the joint error in place, AME that of poses aligned with the true ones."
    + _MODEL_TOO,
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
