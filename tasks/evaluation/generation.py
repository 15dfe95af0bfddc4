"""Topic `generation`: motion that a model generated for its test takes, beside real motion, chance and the solver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.evaluation.distributions import distances, halves, kernel_interval, mean_distance
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.score_tables import TextTable, format_score, pivot_table
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.learning.clips import CLIP_FRAMES, cut_clips, in_pair_frame
from pasdedeux.learning.meter import SOLVER, ModelMeter
from pasdedeux.plain_text import counted
from pasdedeux.spread import some_of
from storage_schema import Manifest, Store
from tasks.evaluation.augmentation import contact_drifts, variant_player
from tasks.evaluation.realism import LearnedSettings, distance_scores, train_on_real
from tasks.evaluation.topic import ScoresOf, Topic, TopicResult
from tasks.rows.takes import takes_of
from tasks.stage import Shard, StageInputs
from tasks.stage.facts import ModelFacts, VariantFacts
from tasks.stage.streams import stream
from tasks.training.items import StoredVariants, interactions_of

if TYPE_CHECKING:
    from pasdedeux.learning.networks.clip_classifier import ClipClassifier

_CHANCE, _STRANGERS, _PLAIN = "real_halves", "strangers", "naive_fk"
_SHOWN = 2
"""Generated motions in the player, beside the take."""

Clips = Mapping[str, Sequence[Array]]
"""By take the clips (n, 20, 2, 22, 3), metres, of one motion or of several that begin alike."""


def _plan(inputs: StageInputs, settings: LearnedSettings) -> list[Shard]:
    """Plan one shard for each model that motion was generated from."""
    takes = takes_of(inputs, 2)
    shards = []
    for model in inputs.of("models"):
        facts = ModelFacts.of(model)
        made: dict[str, list[Manifest]] = {"generated": [], "solved": []}
        for manifest in inputs.of("variants"):
            variant = VariantFacts.of(manifest)
            if variant.take_id in facts.test and (variant.origin is None or variant.origin.artifact == model.ref.key):
                made["solved" if variant.origin is None else "generated"].append(manifest)
        if made["generated"]:
            options = settings.part(LearnedSettings)
            shards.append(
                TOPIC.shard(inputs, f"{facts.model} {facts.split}", options, model=[model], takes=takes, **made)
            )
    return shards


class _ShownGeneration(NamedTuple):
    """A test take and motions (T, 2, 22, 3), metres, that were generated for it."""

    take_id: str
    source: Source
    motions_m: Mapping[str, Array]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownGeneration]:
    """Score the motions generated for every test take; also as a distribution if the study asks for this."""
    facts, settings = ModelFacts.of(store.manifest(shard.ref("model"))), shard.options(LearnedSettings)
    takes = [store.manifest(ref) for ref in shard.refs("takes")]
    variants = StoredVariants(store, shard.refs("takes"), (*shard.refs("generated"), *shard.refs("solved")))
    clips: dict[str, dict[str, list[Array]]] = {facts.model: {}, SOLVER: {}}
    errors_mm: dict[str, list[Array]] = {}
    parts: list[Items] = []
    shown = None
    for method, take_id, wanted in _wanted(store, shard, facts.model):
        source, items = variants.takes[take_id].source, list(variants.items(wanted))
        clips[method][take_id] = [cut_clips(item.motion_m, source.rate_hz) for item in items]
        contacts = ModelMeter(items[0].request).contacts
        drifts = contact_drifts(contacts, source, ((item.request.bone_scale, item.motion_m) for item in items))
        ours_mm, plain_mm = (1e3 * drift.ravel() for drift in drifts.found_m.values())
        errors_mm.setdefault(method, []).append(ours_mm)
        if method == SOLVER:
            continue
        errors_mm.setdefault(_PLAIN, []).append(plain_mm)
        times_s = np.tile(drifts.frames / source.rate_hz, len(items))
        parts.append(Items({method: ours_mm, _PLAIN: plain_mm}, [take_id] * len(times_s), times_s, len(items)))
        if shown is None:
            shown = _ShownGeneration(take_id, source, {item.variant_id: item.motion_m for item in items[:_SHOWN]})
    more = {"split": f"{facts.split} test"}
    scores = [
        score
        for method, parts in errors_mm.items()
        if len(values := np.concatenate(parts))
        for score in scores_of({"contact_error": values.mean()}, method, "mm", count=len(values), **more)
    ]
    seen = (
        "the model learned from other scales of these takes"
        if facts.shares_takes
        else "the model did not learn from these takes"
    )
    count = sum(map(len, clips[facts.model].values()))
    notes = [f"{in_words(facts.model)}: {count} motions of {counted(len(parts), 'test take')}; {seen}."]
    if settings.num_realism_variants:
        classifier, said = train_on_real(shard, store, takes, settings.classifier)
        notes += said
        if classifier is not None:
            real = {
                take_id: cut_clips(take.source.positions_m, take.source.rate_hz)
                for take_id, take in variants.takes.items()
            }
            generator = stream(shard.seed, "evaluation", "generation", facts.model, facts.split)
            scores += distribution_scores(classifier, real, interactions_of(takes), clips, generator, **more)
    return TopicResult(scores, notes, {"": Items.joined(parts)}, (_PLAIN, _STRANGERS), shown)


def _draw(shown: _ShownGeneration) -> Iterator[Picture]:
    """Show the first take beside the motion generated for it."""
    caption = f"{shown.take_id}, and the motion generated for it. Green: contacts of the take."
    player = variant_player(shown.source, {"take": shown.source.positions_m, **shown.motions_m})
    yield Picture(f"generated-{shown.take_id}.player.json", caption, player)


def _wanted(store: Store, shard: Shard, model: str) -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Yield method, take and variants: those generated, and as many of the solver's, evenly spread."""
    wanted: dict[str, dict[str, list[tuple[str, str]]]] = {"generated": {}, "solved": {}}
    for name, by_take in wanted.items():
        for facts in VariantFacts.read(store, shard.refs(name)):
            by_take.setdefault(facts.take_id, []).extend((facts.take_id, variant) for variant in facts.variants)
    for take_id, variants in sorted(wanted["generated"].items()):
        yield model, take_id, variants
        if solved := wanted["solved"].get(take_id):
            yield SOLVER, take_id, some_of(solved, len(variants))


def distribution_scores(
    classifier: ClipClassifier,
    real: Mapping[str, Array],
    kinds: Mapping[str, str],
    made: Mapping[str, Clips],
    generator: np.random.Generator,
    *,
    split: str,
) -> list[Score]:
    """Return FID, KID, density, coverage and diversity of motions beside one half of the real clips of their takes.

    Each method has a clip at the time of every clip of the other half, so all sets have the same size.  If a take has
    several motions, each set takes the next one in turn, and figures are means over the sets.

    Args:
        classifier: Gives the features.
        real: Clips (n, 20, 2, 22, 3), metres, of every take.
        kinds: Interaction of every take.
        made: By method the clips of the motions of each take that is scored.
        generator: Draws the halves and the strangers.
        split: Split of the scores.
    """
    scored = sorted(set.union(*(set(by_take) for by_take in made.values())))
    places = [(take_id, at) for take_id in scored for at in range(len(real[take_id]))]
    first, second = ([places[at] for at in half] for half in halves([(name,) for name, _ in places], generator))
    if min(len(first), len(second)) < 2:
        return []
    everywhere = [(take_id, at) for take_id in sorted(real) for at in range(len(real[take_id]))]

    def stranger(take_id: str, at: int) -> Array:
        others = [place for place in everywhere if kinds[place[0]] != kinds[take_id]]
        other, when = others[generator.integers(len(others))]
        return np.stack([real[take_id][at][:, 0], real[other][when][:, 1]], axis=1)

    strangers = in_pair_frame(np.stack([stranger(*place) for place in first]), CLIP_FRAMES // 2)
    reference = classifier.features(np.stack([real[take_id][at] for take_id, at in second]))
    sets = {_CHANCE: [np.stack([real[take_id][at] for take_id, at in first])], _STRANGERS: [strangers]}
    for method, of_takes in made.items():
        if set(scored) == set(of_takes):
            sets[method] = [
                np.stack([own[(number + turn) % len(own)][at] for number, (own, at) in enumerate(places)])
                for places in [[(of_takes[take_id], at) for take_id, at in first]]
                for turn in range(max(map(len, of_takes.values())))
            ]
    units = [[take_id for take_id, _ in half] for half in (second, first)]
    scores = []
    for method, of_method in sets.items():
        features = [classifier.features(clips) for clips in of_method]
        rows = [distances(reference, of_set) | {"diversity": mean_distance(of_set)} for of_set in features]
        figures = {metric: float(np.mean([row[metric] for row in rows])) for metric in rows[0]}
        if len(features) > 1:
            figures["multimodality"] = float(np.mean([mean_distance(alike) for alike in np.stack(features, axis=1)]))
        low, high = np.mean([kernel_interval(reference, of_set, *units) for of_set in features], axis=0)
        scores += distance_scores(figures, (float(low), float(high)), method, split=split, count=len(first))
    return scores


def _tabulate(scores: ScoresOf) -> list[TextTable]:
    """Return one row a method, of every split."""
    columns = ("FID", "KID", "diversity", "multimodality", "contact_error")
    return [
        pivot_table(
            scores["generation"],
            ("Generated motion of test takes, compared with chance level (real halves), strangers and the solver"),
            ("split", "motion"),
            lambda s: (s.split, in_words(s.method)),
            {name: in_words(name) for name in columns},
            lambda s: s.metric,
            lambda in_cell: format_score(in_cell[0]),
        )
    ]


TOPIC = Topic(
    name="generation",
    heading="Generated motion",
    introduction="Motion that the stage generation sampled from a model, for the model's test takes. Contact error is "
    "the mean change of contact distance against the take; plain kinematics uses the same bodies. FID, "
    "KID, density and coverage compare the motion with one half of the real clips of these takes, in "
    "features of the clip classifier; the other half is chance level. A copy of the take is at chance "
    "level too, so read these figures together with multimodality: the mean feature distance of two "
    "motions of one take at the same time. Diversity is the mean feature distance of any two clips. "
    "Strangers combine A of one clip with B of another interaction. KID is unbiased; with few clips it "
    "can be strongly negative and then has no meaning.",
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    settings=LearnedSettings,
    criteria=(Criterion("contact_error", "contact error", "mm", "motions", ()),),
    tabulate=_tabulate,
)
