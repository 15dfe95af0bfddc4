"""Topic `sets`: do the pairs of a set cover held-out motion, look real, and differ?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.score_tables import TextTable, format_score, pivot_table
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Criterion, Items, lead_interval
from pasdedeux.interaction.nearest import cartesian_distances
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import DUPLICATE_M, MIN_LOG_PRIOR
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread
from storage_schema import Store
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult, refuse_learned
from tasks.priors import read_limits
from tasks.rows.draw_sets import GROWN, baselines_of, draw_manifests, read_draw_sets
from tasks.rows.selection import READS, select_pairs
from tasks.rows.takes import takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import TakeFacts
from tasks.stage.streams import stream

SIZE = 500
"""Pairs of every set that are compared, or fewer where a set has fewer."""
_LARGEST = 10 * SIZE
"""Pairs of a set that are then judged, at most."""
_REAL, _SELECTED = "real_frames", "selected_pairs"
_NUM_TRUTH, _NUM_REAL, _NUM_MEMBERS = 300, 1500, 300
"""Held-out pairs that are covered, real frames that members are compared with, and members compared, at most."""
_METRICS = {
    "set_coverage_D_C": ("m", "held-out pair to the set"),
    "set_coverage_lead": ("m", "gain over grown pairs"),
    "set_precision_D_C": ("m", "pair to real frames"),
    "set_implausible": ("%", "implausible"),
    "set_penetration": ("m", "penetration"),
    "set_near_duplicates": ("%", "near duplicates"),
    "set_nearest_other_D_C": ("m", "nearest other"),
}
"""Unit and heading of each metric, in the order of the columns."""


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard if takes are held out: only these show whether pairs generalise."""
    draws, takes = draw_manifests(inputs), takes_of(inputs, 2)
    if not draws or not any(TakeFacts.of(take).is_held_out for take in takes):
        return []
    named = {"takes": takes, "draws": draws, "chains": inputs.of("chain_info"), "limits": inputs.of("joint_limits")}
    return [TOPIC.shard(inputs, "sets", **named)]


def _compute(shard: Shard, store: Store) -> TopicResult[None]:
    """Judge every set of pairs at one size and as a whole, beside as many real frames."""
    draw_refs = shard.refs("draws")
    known = GroundTruth.read(store, shard.refs("takes"), ())
    refuse_learned(store, draw_refs, known.held_out)
    learned = {take.take_id for take in TakeFacts.read(store, shard.refs("takes")) if take.is_prior}
    generator = stream(shard.seed, TOPIC.name)
    held_out = [(name, at) for name in sorted(known.held_out - learned) for at in range(len(known.takes[name]))]
    places = [held_out[at] for at in evenly_spread(len(held_out), _NUM_TRUTH)]
    real = [pairs for name, pairs in known.takes.items() if name not in known.held_out | learned]
    if not places or not real:
        return TopicResult(
            notes=["Sets of pairs are not judged: they need frames that are held out and frames to learn from."]
        )
    truth = np.stack([known.takes[name][at] for name, at in places])
    frames = np.concatenate(real)[generator.permutation(sum(map(len, real)))]
    drawn = read_draw_sets(store, draw_refs)
    sets = {name: score.in_order for name, score in drawn.items()}
    selected = select_pairs(store, (*draw_refs, *shard.refs("chains"), *shard.refs("limits")), SIZE)
    if selected.columns:
        sets[_SELECTED] = np.stack(selected.columns["pair17_m"])
    sets[_REAL] = frames[_NUM_REAL:] if len(frames) > 2 * _NUM_REAL else frames[::2]
    references = np.concatenate([frames[:_NUM_REAL] if len(frames) > 2 * _NUM_REAL else frames[1::2], truth])
    limits = read_limits(store, shard.refs("limits"))
    size = min(SIZE, *map(len, sets.values()))
    scores: list[Score] = []
    nearest: dict[str, Array] = {}
    for name, pairs in sets.items():
        # Selected pairs come by how much they differ, others in any order.
        mixed = pairs if name == _SELECTED else pairs[generator.permutation(len(pairs))]
        for count in dict.fromkeys((size, min(len(mixed), _LARGEST))):
            covered, figures = judge_set(mixed[:count], truth, references, limits)
            nearest.setdefault(name, covered)
            scores += [
                Score(metric, name, value, _METRICS[metric][0], split="held_out", at=float(count), count=count)
                for metric, value in figures.items()
            ]
    items = Items(nearest, *known.where(places))
    for name in nearest:
        # The same held-out pairs for every set, so that the choice of hard pairs does not matter.
        if name != GROWN and (paired := items.paired([name], [GROWN])) and paired.baselines:
            lead = float(nearest[GROWN].mean() - nearest[name].mean())
            low, high = lead_interval(paired, GROWN)
            score = Score("set_coverage_lead", name, lead, "m", split="held_out", at=float(size), count=len(places))
            scores.append(replace(score, low=low, high=high))
    notes = [f"Selected: {selected.in_words()}."] if selected.columns else []
    return TopicResult(scores, notes, {"": items}, baselines_of(drawn))


def judge_set(
    pairs_m: npt.NDArray[np.floating], truth_m: Array, real_m: Array, limits: JointLimits
) -> tuple[Array, Mapping[str, float]]:
    """Return how far each true pair is from a set, (truth,), metres of D_C, and the figures of the set by metric.

    Args:
        pairs_m: The set, (pair, person=2, joint=17, 3), metres; at least one pair.
        truth_m: Pairs that it is to cover, (truth, 2, 17, 3), metres.
        real_m: Real pairs that its members should look like, (real, 2, 17, 3), metres.
        limits: Joint limits.
    """
    pairs = np.asarray(pairs_m, dtype=np.float64)
    quality = seed_quality(pairs, limits)
    covered = cartesian_distances(truth_m, pairs).min(axis=1)
    some = pairs[evenly_spread(len(pairs), _NUM_MEMBERS)]
    other = cartesian_distances(some, pairs)
    other[np.arange(len(some)), evenly_spread(len(pairs), _NUM_MEMBERS)] = np.inf
    apart = other.min(axis=1)
    return covered, {
        "set_coverage_D_C": float(covered.mean()),
        "set_precision_D_C": float(cartesian_distances(some, real_m).min(axis=1).mean()),
        "set_implausible": 100.0 * float(np.mean(~quality.is_possible | (quality.log_prior < MIN_LOG_PRIOR))),
        "set_penetration": float(capsule_model(PAIR17).penetration(pairs).sum(axis=1).mean()),
        "set_near_duplicates": 100.0 * float(np.mean(apart < DUPLICATE_M)),
        "set_nearest_other_D_C": float(apart.mean()) if len(pairs) > 1 else float("nan"),
    }


def set_table(scores: Sequence[Score]) -> list[TextTable]:
    """Lay out the figures of every set, a row for each size, the best cover first."""
    covers = {(score.method, score.at): score.value for score in scores if score.metric == "set_coverage_D_C"}
    ranked = sorted(scores, key=lambda score: (score.at > min(at for _, at in covers), covers[score.method, score.at]))
    if not covers:
        return []
    return [
        pivot_table(
            ranked,
            f"Can these pairs be used as a set? Sets of equal size first, then up to {_LARGEST:,} pairs",
            ("set", "pairs"),
            lambda score: (in_words(score.method), f"{score.at:,.0f}"),
            {metric: heading for metric, (_, heading) in _METRICS.items()},
            lambda score: score.metric,
            lambda in_cell: format_score(in_cell[0]),
        )
    ]


TOPIC = Topic(
    name="sets",
    heading="Sets of pairs",
    introduction="Can the pairs be used as a set? A good set covers unseen motion, its pairs look like real frames, "
    "and none is impossible or a duplicate. The bound is the same number of real frames.",
    reads=(*READS, "poses"),
    plan=_plan,
    compute=_compute,
    tabulate=lambda scores: set_table(scores.get("sets", ())),
    criteria=(
        Criterion("set_coverage_D_C", "distance from held-out pairs to a set of equal size", "m", "held-out pairs"),
    ),
)
