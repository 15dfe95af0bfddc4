"""Topic `models`: predictions of the trained models on the variants kept for testing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from pasdedeux.evaluation.model_meter import SOLVER, ModelMeter
from pasdedeux.evaluation.model_tables import LARGEST_SCALE, best_model, case_player, extreme_cases, model_tables
from pasdedeux.evaluation.models import GENERATED, frame_errors_cm, model_figure, model_scores, share_scores
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import FEWEST_UNITS, Score
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning import BASELINES, DEFAULT_MODELS, SPLIT_NAMES, VariantKey, VariantModel
from pasdedeux.skeletons import BODY22
from storage_schema import Manifest, Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import ModelFacts, TakeFacts, VariantFacts
from tasks.stage import Parameters, Shard, StageInputs, stream
from tasks.training.items import StoredVariants, interaction_of
from tasks.training.run import load_stored

_DRAWS = 10
"""Motions that a model which draws scales draws for a take, as in table 3 of the paper."""


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per split, with every model trained on it."""
    splits: dict[str, list[Manifest]] = {}
    for manifest in inputs.of("models"):
        splits.setdefault(ModelFacts.of(manifest).split, []).append(manifest)
    found = []
    for split, models in splits.items():
        tested = set(ModelFacts.of(models[0]).test)
        takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).take_id in tested]
        variants = [manifest for manifest in inputs.of("variants") if VariantFacts.of(manifest).take_id in tested]
        found.append(TOPIC.shard(inputs, split, models=models, takes=takes, variants=variants))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score every model of a split on its test variants, and show the best, a middling and the worst of them."""
    stored = [store.manifest(ref) for ref in shard.refs("models")]
    facts = ModelFacts.of(stored[0])
    skeleton = facts.skeleton
    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"), skeleton)
    models = {ModelFacts.of(manifest).model: load_stored(store, manifest) for manifest in stored}
    meters: dict[str, ModelMeter] = {}
    errors: dict[str, list[dict[str, float]]] = {name: [] for name in (*models, SOLVER)}
    tested: list[VariantKey] = []
    trivial = DEFAULT_MODELS if set(models).difference(DEFAULT_MODELS) else BASELINES
    parts: list[Items] = []
    for item in variants.items(_named(facts.test)):
        request = item.request
        tested.append(VariantKey(request.take_id, item.variant_id, request.bone_scale))
        if request.take_id not in meters:
            meters[request.take_id] = ModelMeter(request)
        predicted = {name: model.predict(request) for name, model in models.items()}
        for name, found in meters[request.take_id].measure(request.bone_scale, predicted, item.motion_m).items():
            errors[name].append(found)
        by_frame = {name: frame_errors_cm(motion, item.motion_m) for name, motion in predicted.items()}
        times_s = np.arange(len(item.motion_m)) / request.source.rate_hz
        parts.append(Items(by_frame, [request.take_id] * len(times_s), times_s, trivial, count=1))
    split = f"{facts.split} test"

    def scores_where(item: str, rows: Sequence[int]) -> list[Score]:
        mine = {name: [found[row] for row in rows] for name, found in errors.items()}
        own = None if facts.shares_takes else [tested[row].take_id for row in rows]
        return model_scores(mine, baselines=trivial, split=split, item=item, takes=own) if rows else []

    distances = {name: found for name, found in errors.items() if name != SOLVER}
    scores = [
        *scores_where("all", range(len(tested))),
        *share_scores(
            distances,
            baselines=DEFAULT_MODELS,
            split=split,
            takes=None if facts.shares_takes else [key.take_id for key in tested],
        ),
    ]
    interactions = {
        TakeFacts.of(take).take_id: interaction_of(take) for take in map(store.manifest, shard.refs("takes"))
    }
    for motion in sorted({interactions[key.take_id] for key in tested}):
        own = [row for row, key in enumerate(tested) if interactions[key.take_id] == motion]
        scores += scores_where(motion, own)
        largest = [row for row in own if np.isclose(tested[row].furthest_scale, LARGEST_SCALE)]
        scores += scores_where(f"{motion} at {LARGEST_SCALE}", largest)
    streams = partial(stream, shard.seed, "evaluation", "generated", split)
    scores += _generated(models, meters, streams, baselines=trivial, split=split)
    shared = " The takes are those of the training set, at other scales." if facts.shares_takes else ""
    pictures = {
        f"models-{facts.split}.svg": model_figure(
            [key.furthest_scale for key in tested], distances, baselines=trivial, split=facts.split
        )
    }
    captions = {
        f"models-{facts.split}.svg": f"Error of each model on the {len(tested)} test variants of split "
        f"{facts.split}: lower is better, dashed are the trivial ways.{shared}"
    }
    shown = best_model(scores, split=split, baselines=trivial)
    if shown is not None:
        cases = extreme_cases([found["E_r"] for found in errors[shown]])
        name = f"cases-{facts.split}.player.json"
        wanted = {(tested[row].take_id, tested[row].variant_id): what for what, row in cases.items()}
        drawn = {wanted[item.request.take_id, item.variant_id]: item for item in variants.items(list(wanted))}
        pictures[name] = case_player(
            {what: (drawn[what], models[shown].predict(drawn[what].request)) for what in cases if what in drawn}
        )
        listed = "; ".join(
            f"{what}: {tested[row].take_id}, {tested[row].variant_id}, {errors[shown][row]['E_r']:.2f} cm"
            for what, row in cases.items()
        )
        captions[name] = (
            f"{in_words(shown)}, on split {facts.split}; the true variant is grey. Better: no grey to see. {listed}."
        )
    keys = [
        f"{name}: the distance of key pairs (JPD) is between {pairs}."
        for name, one in sorted(meters.items())
        if (pairs := one.key_names())
    ]
    learned = len({key for manifest in stored for key in ModelFacts.of(manifest).train})
    notes = [
        *([f"Models and figures are of {skeleton}; what is of surfaces is not measured."] * (skeleton != BODY22.name)),
        f"Split {facts.split}: {len(tested)} test variants of {len(meters)} "
        f"take{'s' * (len(meters) != 1)}, learned from {learned}. "
        + (
            "Intervals are over test variants, which of one take are much alike: they say nothing of other takes."
            if facts.shares_takes
            else f"Intervals are over takes, as variants of one are much alike, where there are {FEWEST_UNITS}."
        ),
        *keys,
    ]
    items = {str(facts.split).replace("_", " "): Items.joined(parts)}
    return TopicResult(scores=scores, pictures=pictures, captions=captions, notes=notes, items=items)


def _generated(
    models: Mapping[str, VariantModel],
    meters: Mapping[str, ModelMeter],
    streams: Callable[..., np.random.Generator],
    *,
    baselines: Sequence[str],
    split: str,
) -> list[Score]:
    """Score motions that models draw with their scales for every take, beside baselines at these scales."""
    errors: dict[str, list[dict[str, float]]] = {}
    for take_id, meter in meters.items():
        for draw in range(_DRAWS):
            for name, found in meter.measure_generated(models, partial(streams, take_id, draw)).items():
                errors.setdefault(name, []).append(found)
    takes = [take_id for take_id in meters for _ in range(_DRAWS)]
    return model_scores(errors, baselines=baselines, split=split, item=GENERATED, takes=takes)


def _named(by_take: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    return [(take_id, name) for take_id, names in by_take.items() for name in names]


TOPIC = Topic(
    name="models",
    heading="Models",
    introduction="Models that say from a take and the sizes of two bodies how they would move, and how far that is "
    "from what the solver says. The trivial ways give the take back, or put its joint angles on the new bones. The "
    "table of names says what each figure and model is.",
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan,
    run=_run,
    criteria=tuple(
        Criterion("E_r", "joint error E_r", "cm", "variants", name=split.replace("_", " ")) for split in SPLIT_NAMES
    ),
    cautions=(
        (
            "models",
            "Models are scored on takes that they saw at other scales (cross-scale split) unless the split says "
            "otherwise.",
        ),
    ),
    tables=lambda scores: model_tables(scores["models"]),
)
