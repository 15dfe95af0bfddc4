"""Topic `models`: predictions of the trained models on the test variants."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.evaluation.names import in_words, is_bound
from pasdedeux.evaluation.pictures import CurvePanel, Picture, curve_figure, pack_player, people_panel, shown_frames
from pasdedeux.evaluation.scores import FEWEST_UNITS, Score, bootstrap_interval, scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning.mesh_refine import refine
from pasdedeux.learning.meter import GENERATED, SHARE, SOLVER, UNITS, Errors, ModelMeter
from pasdedeux.learning.model import VALIDATION_FALL as FALL
from pasdedeux.learning.model import TrainingItem, VariantModel
from pasdedeux.learning.registry import BASELINES, DEFAULT_MODELS
from pasdedeux.learning.sampling import NUM_STEPS
from pasdedeux.learning.splits import SPLIT_NAMES, VariantKey
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22
from pasdedeux.spread import some_of
from storage_schema import Manifest, Store, TableData
from tasks.augmentation import solver_variants
from tasks.evaluation.model_tables import AT_LARGEST, LARGEST_SCALE, model_tables
from tasks.evaluation.topic import Topic, TopicResult
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import ModelFacts, TakeFacts, VariantFacts
from tasks.stage.streams import stream
from tasks.training.items import StoredVariants, frame_errors, interactions_of
from tasks.training.run import load_stored

_DRAWS = 10
"""Motions drawn for each take by a model that draws scales, as in table 3 of the paper."""
_SCALE_STEP = 0.05
_OF_LOG = ("model", "step", "quantity", "value")
_OTHER_SKELETON = "Models and figures are for the skeleton {}; surfaces are not measured."
_OVER_VARIANTS = (
    "Intervals are over test variants. Variants of one take are similar, so the intervals do not generalise to other "
    "takes."
)
_OVER_TAKES = (
    f"Intervals are over takes if there are at least {FEWEST_UNITS}, because variants of one take are similar."
)


class ModelsSettings(Parameters):
    """How many variants models are scored on."""

    num_test_variants: int = Field(
        0, ge=0, description="Test variants of each split that models are scored on, evenly spread; 0: all"
    )


def _plan(inputs: StageInputs, settings: ModelsSettings) -> list[Shard]:
    """Plan one shard per split and skeleton, with every model trained there."""
    splits: dict[str, list[Manifest]] = {}
    for manifest in inputs.of("models"):
        splits.setdefault(_split_name(ModelFacts.of(manifest)), []).append(manifest)
    shards = []
    for split, models in splits.items():
        tested = set(ModelFacts.of(models[0]).test)
        takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).take_id in tested]
        variants = [manifest for manifest in solver_variants(inputs) if VariantFacts.of(manifest).take_id in tested]
        options = settings.part(ModelsSettings)
        logs = [log for log in inputs.of("training_log") if _split_name(ModelFacts.of(log)) == split]
        shards.append(TOPIC.shard(inputs, split, options, models=models, takes=takes, variants=variants, logs=logs))
    return shards


def _split_name(facts: ModelFacts) -> str:
    """Return the name of a model's split, with its skeleton where that is another one."""
    return facts.split if facts.skeleton == BODY22.name else f"{facts.split}_{facts.skeleton}"


class _ShownModels(NamedTuple):
    """Input of a split's pictures.

    Args:
        split: Name of the split.
        caption: Caption of its curves.
        keys: Its test variants.
        errors: Errors of each model on them.
        baselines: Models that are dashed.
        cases: Caption of the best, a middling and the worst, and the prediction for each; empty without a model.
        curves: Steps and validation errors of each network and of the copy.
    """

    split: str
    caption: str
    keys: Sequence[VariantKey]
    errors: Mapping[str, Sequence[Errors]]
    baselines: Collection[str]
    cases: tuple[str, Mapping[str, tuple[TrainingItem, Array]]]
    curves: Mapping[str, tuple[Array, Array]]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownModels]:
    """Score every model of a split on its test variants, and choose the best, a middling and the worst of them."""
    stored = [store.manifest(ref) for ref in shard.refs("models")]
    facts = ModelFacts.of(stored[0])
    split_name, skeleton = _split_name(facts), facts.skeleton
    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"), skeleton)
    models = {ModelFacts.of(manifest).model: load_stored(store, manifest) for manifest in stored}
    meters: dict[str, ModelMeter] = {}
    errors: dict[str, list[Errors]] = {name: [] for name in (*models, SOLVER)}
    tested: list[VariantKey] = []
    parts: list[Items] = []
    test = [(take_id, name) for take_id, names in facts.test.items() for name in names]
    count = shard.options(ModelsSettings).num_test_variants or len(test)
    for item in variants.items(some_of(test, count)):
        request = item.request
        take_id = request.take_id
        tested.append(VariantKey(take_id, item.variant_id, request.bone_scale))
        meter = meters.setdefault(take_id, ModelMeter(request))
        predicted = {name: model.predict(request) for name, model in models.items()}
        for name, measured in meter.measure(request.bone_scale, predicted, item.motion_m).items():
            errors[name].append(measured)
        parts.append(frame_errors(item, predicted))
    rivals = [name for name, model in models.items() if model.name in DEFAULT_MODELS]
    plain = [name for name, model in models.items() if model.name in BASELINES]
    split, baselines = f"{split_name} test", rivals if set(models).difference(rivals) else plain
    takes = None if facts.shares_takes else [key.take_id for key in tested]

    def scores_of_rows(item: str, rows: Sequence[int]) -> list[Score]:
        chosen = {name: [per_item[row] for row in rows] for name, per_item in errors.items()}
        row_takes = None if takes is None else [takes[row] for row in rows]
        return model_scores(chosen, split=split, item=item, takes=row_takes) if rows else []

    distances = {name: of_model for name, of_model in errors.items() if name != SOLVER}
    scores = scores_of_rows("all", range(len(tested)))
    scores += share_scores(distances, rivals=rivals, split=split, takes=takes)
    scores += fall_scores(
        {ModelFacts.of(manifest).model: store.read(manifest.ref, "training_log") for manifest in stored}, split
    )
    interactions = interactions_of(map(store.manifest, shard.refs("takes")))
    for motion in sorted({interactions[key.take_id] for key in tested}):
        motion_rows = [row for row, key in enumerate(tested) if interactions[key.take_id] == motion]
        scores += scores_of_rows(motion, motion_rows)
        largest = [row for row in motion_rows if np.isclose(tested[row].furthest_scale, LARGEST_SCALE)]
        scores += scores_of_rows(f"{motion}{AT_LARGEST}", largest)
    drawn: dict[str, list[Errors]] = {}
    for take_id, meter in meters.items():
        for draw in range(_DRAWS):
            streams = partial(stream, shard.seed, "evaluation", "generated", split, take_id, draw)
            for name, measured in meter.measure_generated(models, streams).items():
                drawn.setdefault(name, []).append(measured)
    of_draws = [take_id for take_id in meters for _ in range(_DRAWS)]
    scores += model_scores(drawn, split=split, item=GENERATED, takes=of_draws)
    best = best_model(scores, split=split, baselines=baselines)
    if best is not None and skeleton == BODY22.name and best not in baselines:
        scores += refined_scores(variants, best, models[best], meters, tested, split, takes)
    caption = (
        f"Error of each model on the {len(tested)} test variants of split {split_name}. Good: low. Dashed: "
        f"baselines.{' The takes are those of the training set, at other scales.' * facts.shares_takes}"
    )
    cases = ("", {}) if best is None else _cases(variants, tested, best, models[best], errors[best], split_name)
    curves = learning_curves([store.read(ref, "training_log") for ref in shard.refs("logs")])
    learned = len({key for manifest in stored for key in ModelFacts.of(manifest).train})
    count_in_words = (
        f"Split {split_name}: {len(tested)} of {len(test)} test variants of {counted(len(meters), 'take')}; trained on "
        f"{learned}."
    )
    return TopicResult(
        scores,
        _notes(facts, count_in_words, meters),
        {split_name.replace("_", " "): Items.joined(parts)},
        baselines,
        _ShownModels(split_name, caption, tested, distances, baselines, cases, curves),
    )


def _cases(
    variants: StoredVariants,
    tested: Sequence[VariantKey],
    name: str,
    model: VariantModel,
    errors: Sequence[Errors],
    split_name: str,
) -> tuple[str, Mapping[str, tuple[TrainingItem, Array]]]:
    """Return the best, a middling and the worst prediction of a model, and the caption of their players."""
    cases = extreme_cases([error["E_r"] for error in errors])
    wanted = [(tested[row].take_id, tested[row].variant_id) for row in cases.values()]
    items = {(item.request.take_id, item.variant_id): item for item in variants.items(list(dict.fromkeys(wanted)))}
    shown = {what: (items[key], model.predict(items[key].request)) for what, key in zip(cases, wanted, strict=True)}
    listed = "; ".join(
        f"{what}: {tested[row].take_id}, {tested[row].variant_id}, {errors[row]['E_r']:.2f} cm"
        for what, row in cases.items()
    )
    where = f"{in_words(name)}, on split {split_name} (Li et al. 2024, figs. 5 and 6)"
    return f"{where}. Grey: the true variant. Good: no grey is visible. {listed}.", shown


def _notes(facts: ModelFacts, count_in_words: str, meters: Mapping[str, ModelMeter]) -> list[str]:
    """Return what a reader must know of the figures: skeleton, number of variants, intervals, key pairs."""
    notes = [] if facts.skeleton == BODY22.name else [_OTHER_SKELETON.format(facts.skeleton)]
    notes.append(f"{count_in_words} {_OVER_VARIANTS if facts.shares_takes else _OVER_TAKES}")
    for name, meter in sorted(meters.items()):
        if pairs := meter.key_names():
            notes.append(f"{name}: the distance of key pairs (JPD) is between {pairs}.")
    return notes


def _draw(shown: _ShownModels) -> Iterator[Picture]:
    """Draw errors against scales and steps of training, and show cases of the best model."""
    scales = [key.furthest_scale for key in shown.keys]
    drawn = model_figure(scales, shown.errors, baselines=shown.baselines, split=shown.split)
    yield Picture(f"models-{shown.split}.svg", shown.caption, drawn)
    if shown.curves:
        drawn = curve_figure(
            [CurvePanel("mean joint error of validation windows (cm)", shown.curves, BASELINES)],
            title=f"training on {shown.split.replace('_', ' ')}",
            x_label="steps",
        )
        words = (
            f"Validation error of each network during training on split {shown.split}, with z = 0. Dashed: "
            "copy of the source."
        )
        yield Picture(f"learning-{shown.split}.svg", words, drawn)
    caption, cases = shown.cases
    if cases:
        yield Picture(f"cases-{shown.split}.player.json", caption, case_player(cases))


def model_scores(
    errors: Mapping[str, Sequence[Errors]], *, split: str, item: str, takes: Sequence[str] | None = None
) -> list[Score]:
    """Return the mean of each figure of each model over test variants, with its bootstrap interval over these.

    Figures that are NaN everywhere have no score.  Where the variants' takes are given, the interval is over takes.
    """
    scores = []
    for model, per_item in errors.items():
        for metric in dict.fromkeys(name for error in per_item for name in error):
            values = np.array([error.get(metric, np.nan) for error in per_item])
            is_known = np.isfinite(values)
            if not is_known.any():
                continue
            units = None if takes is None else np.asarray(takes)[is_known].tolist()
            low, high = bootstrap_interval(values[is_known], units=units)
            value = {metric: float(values[is_known].mean())}
            more = {"split": split, "item": item, "count": int(is_known.sum()), "low": low, "high": high}
            scores += scores_of(value, model, UNITS[metric], **more)
    return scores


def share_scores(
    errors: Mapping[str, Sequence[Errors]], *, rivals: Collection[str], split: str, takes: Sequence[str] | None = None
) -> list[Score]:
    """Return E_r of each model in percent of that of its best rival, with the interval as `model_scores` has it."""
    values = {name: np.array([error["E_r"] for error in per_item]) for name, per_item in errors.items() if per_item}
    beside = [per_item for name, per_item in values.items() if name in rivals]
    if not beside:
        return []
    best = min(beside, key=lambda per_item: float(per_item.mean()))
    scores = []
    for model, per_item in values.items():
        if model not in rivals:
            low, high = (100.0 * end for end in bootstrap_interval(per_item, best, units=takes))
            share = 100.0 * float(per_item.mean() / max(best.mean(), 1e-12))
            scores.append(
                Score(SHARE, model, share, UNITS[SHARE], split=split, count=len(per_item), low=low, high=high)
            )
    return scores


def fall_scores(logs: Mapping[str, TableData], split: str) -> list[Score]:
    """Return by how much validation fell in the last segment of each model's training, percent, from their logs."""
    falls = {
        name: float(value)
        for name, log in logs.items()
        for quantity, value in zip(log["quantity"], log["value"], strict=True)
        if str(quantity) == FALL
    }
    return [Score(FALL, name, fall, "%", split=split) for name, fall in falls.items()]


def learning_curves(logs: Sequence[TableData]) -> dict[str, tuple[Array, Array]]:
    """Return steps and validation error, cm, of each network by its name, and of the copy, from all segments' logs."""
    curves: dict[str, dict[float, float]] = {}
    for log in logs:
        for model, step, quantity, value in zip(*(log[name] for name in _OF_LOG), strict=True):
            name = {"validation_error_cm": str(model), "validation_copy_error_cm": BASELINES[0]}.get(str(quantity))
            if name is not None:
                curves.setdefault(name, {})[float(step)] = float(value)
    return {
        name: (np.array(sorted(by_step)), np.array([by_step[step] for step in sorted(by_step)]))
        for name, by_step in curves.items()
    }


def refined_scores(
    variants: StoredVariants,
    name: str,
    model: VariantModel,
    meters: Mapping[str, ModelMeter],
    tested: Sequence[VariantKey],
    split: str,
    takes: Sequence[str] | None,
) -> list[Score]:
    """Return the figures of a model's predictions of the tested variants after two steps of the mesh."""
    errors = []
    for item in variants.items([(key.take_id, key.variant_id) for key in tested]):
        request, meter = item.request, meters[item.request.take_id]
        motion_m = refine(request, meter.problems, model.predict(request), NUM_STEPS).motion_m
        errors.append(meter.measure(request.bone_scale, {name: motion_m}, item.motion_m)[name])
    return model_scores({f"{name}_refined": errors}, split=split, item="all", takes=takes)


def model_figure(
    scales: Sequence[float], errors: Mapping[str, Sequence[Errors]], *, baselines: Collection[str], split: str
) -> bytes:
    """Draw E_r of each model against the test variants' scale furthest from 1 (means of steps of 0.05); SVG bytes."""
    at = np.round(np.array(scales) / _SCALE_STEP) * _SCALE_STEP
    known = np.unique(np.round(at, 6))
    curves = {}
    for model, per_item in errors.items():
        values = np.array([error["E_r"] for error in per_item])
        curves[model] = known, np.array([values[np.isclose(at, scale)].mean() for scale in known])
    return curve_figure(
        [CurvePanel("mean joint error E_r (cm)", curves, baselines)],
        title=f"models on {split.replace('_', ' ')} test variants",
        x_label="scale furthest from 1, of anybody's bones",
    )


def best_model(scores: Sequence[Score], *, split: str, baselines: Collection[str]) -> str | None:
    """Return the model with the smallest E_r over the test variants of a split; a baseline or bound if all are."""
    errors = {s.method: s.value for s in scores if (s.metric, s.split, s.item) == ("E_r", split, "all")}
    return min(errors, key=lambda name: (name in baselines or is_bound(name), errors[name]), default=None)


def extreme_cases(errors: Sequence[float]) -> dict[str, int]:
    """Return the best, the median and the worst of some errors, by index.

    >>> extreme_cases([3.0, 1.0, 2.0])
    {'best': 1, 'median': 2, 'worst': 0}
    """
    order = np.argsort(errors, kind="stable")
    return {"best": int(order[0]), "median": int(order[(len(order) - 1) // 2]), "worst": int(order[-1])}


def case_player(cases: Mapping[str, tuple[TrainingItem, Array]]) -> bytes:
    """Show predictions (T, 2, 22, 3), metres, beside each other, the solver's answer grey behind each.

    Longer takes are cut to the length of the shortest.
    """
    sources = [item.request.source for item, _ in cases.values()]
    frames, rate_hz = shown_frames(min(source.num_frames for source in sources), sources[0].rate_hz)
    panels = []
    for what, (item, predicted) in cases.items():
        skeleton = item.request.source.skeleton
        true, guessed = item.motion_m[frames], predicted[frames]
        middle = true[:, :, skeleton.root].mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
        title = f"{what}: {item.request.take_id} {item.variant_id}"
        panels.append(people_panel(title, skeleton, guessed - middle, truth_m=true - middle))
    return pack_player(panels, rate_hz=rate_hz)


TOPIC = Topic(
    name="models",
    heading="Models",
    introduction="Models predict variants from a take and two body sizes. They are compared with the solver's result. "
    "The baselines return the take unchanged, or apply its joint angles to the new bones. The table of "
    "names describes each figure and model.",
    reads=("models", "training_log", "poses", "variants", "variant_quality"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    settings=ModelsSettings,
    criteria=tuple(
        Criterion("E_r", "joint error E_r", "cm", "variants", name=split.replace("_", " ")) for split in SPLIT_NAMES
    ),
    cautions=(
        (
            "models",
            "On the cross-scale split, models are scored on takes that they saw at other scales.",
        ),
    ),
    tabulate=lambda scores: model_tables(scores["models"]),
)
