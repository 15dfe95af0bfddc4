"""Topic `realism`: distributions of predictions beside the solver's, by features of a classifier of real clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from pasdedeux.evaluation.distributions import KID_FACTOR, distances, halves, kernel_interval
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.learning.clips import cut_clips
from pasdedeux.learning.meter import GENERATED, SOLVER, generated
from pasdedeux.learning.registry import BASELINES
from pasdedeux.learning.settings import ClassifierSettings, PredictorSettings
from pasdedeux.skeletons import BODY22
from pasdedeux.spread import some_of
from storage_schema import Manifest, Store
from tasks.augmentation import solver_variants
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.takes import read_take, takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import ModelFacts, TakeFacts, VariantFacts
from tasks.stage.streams import stream
from tasks.training.items import StoredVariants, interaction_of, interactions_of
from tasks.training.run import load_stored, refuse_without_torch

if TYPE_CHECKING:
    from pasdedeux.learning.networks.clip_classifier import ClipClassifier

OTHER_SKELETON = "other_skeleton"


class LearnedSettings(Parameters):
    """Settings of judgements by networks trained for the purpose; they need torch."""

    num_realism_variants: int = Field(
        0, ge=0, description="Test variants of each split, to compare models as distributions"
    )
    num_downstream_seeds: int = Field(
        0, ge=0, le=20, description="Repetitions of each training for recognition and prediction"
    )
    tells_roles: bool = Field(
        False, description="Recognition distinguishes roles: clips with A and B exchanged are separate classes"
    )
    num_training_takes: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (), description="Numbers of training takes per interaction, one training each, instead of the published shares"
    )
    classifier: ClassifierSettings = Field(ClassifierSettings(), description="Training of the classifier of clips")
    predictor: PredictorSettings = Field(PredictorSettings(), description="Training of the predictor of motion")


def _plan(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan one shard over all splits and models if there are two interactions to distinguish.

    All splits share one classifier. One trained on the training set of a split would not know the interactions that
    splits across interactions test, and features of different classifiers cannot be compared.
    """
    models = inputs.of("models")
    takes = takes_of(inputs, 2)
    if not (settings.num_realism_variants and models) or len({interaction_of(take) for take in takes}) < 2:
        return []
    models = [model for model in models if ModelFacts.of(model).skeleton == BODY22.name]
    if not models:
        return [TOPIC.shard(inputs, OTHER_SKELETON)]
    variants = [manifest for manifest in solver_variants(inputs) if VariantFacts.of(manifest).num_persons == 2]
    return [TOPIC.shard(inputs, "all", settings.part(LearnedSettings), models=models, takes=takes, variants=variants)]


def _compute(shard: Shard, store: Store) -> TopicResult[None]:
    """Train the classifier on real clips, and compute its features of every model's predictions."""
    if shard.name == OTHER_SKELETON:
        return TopicResult(notes=[f"Skipped: the clip classifier works on {BODY22.name}, and no model does."])
    settings = shard.options(LearnedSettings)
    takes = [store.manifest(ref) for ref in shard.refs("takes")]
    classifier, notes = train_on_real(shard, store, takes, settings.classifier)
    if classifier is None:
        return TopicResult(notes=notes)
    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    kinds = interactions_of(takes)
    splits: dict[str, list[Manifest]] = {}
    for ref in shard.refs("models"):
        manifest = store.manifest(ref)
        splits.setdefault(ModelFacts.of(manifest).split, []).append(manifest)
    scores = []
    for split, manifests in splits.items():
        test = [(take_id, name) for take_id, names in ModelFacts.of(manifests[0]).test.items() for name in names]
        chosen = some_of(test, settings.num_realism_variants)
        models = {ModelFacts.of(manifest).model: load_stored(store, manifest) for manifest in manifests}
        is_of_takes = not ModelFacts.of(manifests[0]).shares_takes
        predicted: dict[str, list[_Clips]] = {}
        drawn: dict[str, list[_Clips]] = {}
        strata: list[tuple[str, str]] = []
        for item in variants.items(chosen):
            take_id, rate_hz = item.request.take_id, item.request.source.rate_hz
            strata.append((kinds[take_id], take_id))
            unit = take_id if is_of_takes else f"{take_id} {item.variant_id}"
            predictions = {name: model.predict(item.request) for name, model in models.items()}
            streams = partial(stream, shard.seed, "evaluation", "drawn", split, take_id, item.variant_id)
            several = generated(models, item.request, streams)
            # Rivals of models that draw scales take the scales of each in turn, so they have no more clips.
            last = {name: draws[len(predicted.get(SOLVER, ())) % len(draws)][1] for name, draws in several.items()}
            for clips, motions in ((predicted, predictions), (drawn, last)):
                for name, motion in {**motions, SOLVER: item.motion_m}.items():
                    clips.setdefault(name, []).append(_Clips(kinds[take_id], unit, cut_clips(motion, rate_hz)))
        dealt = halves(strata, stream(shard.seed, "evaluation", "halves", split))
        for of, clips in (("all", predicted), (GENERATED, drawn)):
            if len(clips) > 1:
                scores += _compare(classifier, clips, *dealt, split=f"{split} test", item=of)
        tested = {take_id for take_id, _ in chosen}
        seen = [take for take in takes if TakeFacts.of(take).take_id in tested and not TakeFacts.of(take).is_held_out]
        notes.append(f"Split {split}: the classifier learned from {len(seen)} of the {len(tested)} test takes.")
    return TopicResult(scores, notes=notes, baselines=BASELINES)


def train_on_real(
    shard: Shard, store: Store, takes: Sequence[Manifest], settings: ClassifierSettings
) -> tuple[ClipClassifier | None, list[str]]:
    """Train the classifier on real clips of takes that are not held out, the same for every topic, with notes on it.

    None where these takes are of one interaction alone.

    Raises:
        InputError: torch is missing.
    """
    refuse_without_torch("the classifier of clips", "evaluation.num_realism_variants=0")
    from pasdedeux.learning.networks.clip_classifier import train_classifier  # torch

    learned = [take for take in takes if not TakeFacts.of(take).is_held_out]
    real = real_clips(store, learned)
    if len(real) < 2:
        return None, ["Distributions are skipped: all takes that are not held out show the same interaction."]
    classifier = train_classifier(real, settings, stream(shard.seed, "evaluation", "classifier"))
    counted = ", ".join(f"{kind} {len(clips)}" for kind, clips in real.items())
    return classifier, [
        f"The classifier learned from {sum(map(len, real.values()))} real clips of 2 s ({counted}), names "
        f"{classifier.accuracy(real):.0f} % of them correctly, and has the digest {classifier.digest}.",
        f"Takes of the classifier: {', '.join(sorted(TakeFacts.of(take).take_id for take in learned))}.",
    ]


def real_clips(store: Store, takes: Sequence[Manifest]) -> dict[str, np.ndarray]:
    """Return the clips of takes by interaction."""
    by_label: dict[str, list[np.ndarray]] = {}
    for take in takes:
        source = read_take(store, take.ref).source
        by_label.setdefault(interaction_of(take), []).append(cut_clips(source.positions_m, source.rate_hz))
    return {kind: np.concatenate(clips) for kind, clips in by_label.items()}


@dataclass(frozen=True)
class _Clips:
    """The clips (n, 20, 2, 22, 3) of one motion, with their interaction and their unit of resampling."""

    kind: str
    unit: str
    clips: np.ndarray


def _compare(
    classifier: ClipClassifier, clips: Mapping[str, Sequence[_Clips]], first: list[int], second: list[int], **more: Any
) -> list[Score]:
    """Score the predictions of one half of the variants beside the solver's results of the other half."""
    scores: list[Score] = []
    real, real_units = _features(classifier, [clips[SOLVER][at] for at in second or first])
    for name, clips_of_method in clips.items():
        features, units = _features(classifier, [clips_of_method[at] for at in first])
        if second and min(len(real), len(features)) > 1:
            interval = kernel_interval(real, features, real_units, units)
            scores += distance_scores(distances(real, features), interval, name, count=len(features), **more)
        by_kind: dict[str, list[np.ndarray]] = {}
        for clip_set in clips_of_method:
            if clip_set.kind in classifier.labels:
                by_kind.setdefault(clip_set.kind, []).append(clip_set.clips)
        if by_kind:
            share = classifier.accuracy({kind: np.concatenate(some) for kind, some in by_kind.items()})
            count = sum(len(some_clips) for some in by_kind.values() for some_clips in some)
            scores.append(Score("recognised", name, share, "%", count=count, **more))
    return scores


def distance_scores(figures: Mapping[str, float], kernel: tuple[float, float], method: str, **more: Any) -> list[Score]:
    """Return distances by name as scores of a method, the kernel distance first, with the ends of its interval."""
    low, high = (KID_FACTOR * end for end in kernel)
    first, *others = scores_of({"KID": figures["KID"], **figures}, method, **more)
    return [replace(first, low=low, high=high), *others]


def _features(classifier: ClipClassifier, clip_sets: Sequence[_Clips]) -> tuple[np.ndarray, list[str]]:
    """Return features of all clips, and the unit of each."""
    units = [clip_set.unit for clip_set in clip_sets for _ in clip_set.clips]
    return classifier.features(np.concatenate([clip_set.clips for clip_set in clip_sets])), units


TOPIC = Topic(
    name="realism",
    heading="Models as distributions",
    introduction="Test variants predicted by a model are compared with variants of the same takes made by the solver, "
    "in 32 features of a two-person ST-GCN classifier. The classifier was trained on real clips of takes "
    "that are not held out (listed below). The method `solver` is chance level: the solver's result for "
    "the same variants. Read KID first (times 1000, unbiased). FID of so few clips is mostly bias; "
    "compare it with that of the solver only. Intervals of KID are jackknifed over takes if no test take "
    "was learned from, else over variants. `generated` are motions whose scales the models drew "
    "themselves, one per variant; baselines and the closed form use the same scales. Density and coverage "
    "are about 1 for draws of the same distribution. Recognised is the share of predicted clips whose "
    "interaction is recognised, as in table 6 of the paper.",
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan,
    compute=_compute,
    settings=LearnedSettings,
)
