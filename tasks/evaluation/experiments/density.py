"""Topic `density`: which terms of a density tell real pairs from corrupted ones, before anything is sampled from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from pasdedeux.evaluation.figures import grid_figure
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.experiments.judging import (
    Comparison,
    Corruption,
    TermComparer,
    area_under_curve,
    camera_axes,
    paired_accuracy,
)
from pasdedeux.sampling.annotations import build_bank
from pasdedeux.sampling.coverage import Coverage
from pasdedeux.sampling.growth import GrowthOptions, grow
from pasdedeux.sampling.prior import PriorSettings
from storage_schema import Store
from tasks.annotated_pairs import annotated_pairs, gather, views_of
from tasks.draw_sets import read_grown
from tasks.evaluation.topic import Topic, TopicResult, held_out_takes, refuse_learned
from tasks.evaluation.truth import read_takes
from tasks.priors import read_limits, read_occupancy
from tasks.stage import Parameters, Shard, StageInputs, stream

__all__ = ["TOPIC"]

NUM_VIEWS, NUM_CANDIDATES = 12, 250
FAR_M = 0.2
"""Corruptions that move no joint as far as this are left out of a score of their own, metres."""
NUM_REAL = 1500
"""Real pairs that the distance of lifted pairs from the truth is measured to, at most."""
LIFTED_FOR_JUDGED = 2
"""Lifted pairs for each real pair."""
RANK_METRIC = "rank_correlation_with_nearest_real"


class DensitySettings(PriorSettings, Parameters):
    """How much is judged."""

    num_judged_pairs: int = Field(
        0, ge=0, description="Real pairs of held-out takes that terms of the density are judged on; 0: none are judged"
    )


class DensityParameters(DensitySettings):
    """What the shard is told."""

    num_hypotheses: int = 1


def _plan(inputs: StageInputs, settings: DensitySettings) -> list[Shard]:
    """Plan one shard over the pairs of held-out takes; none where there are no such takes or no annotations."""
    takes = [manifest for manifest in inputs.of("poses") if manifest.facts["num_persons"] == 2]
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    if not (settings.num_judged_pairs and annotated and views and any(take.facts["is_held_out"] for take in takes)):
        return []
    grown = [manifest for manifest in inputs.of("seeds") if manifest.facts["kind"] == "grown_seeds"]
    return [
        TOPIC.shard(
            inputs,
            "terms",
            settings.part(DensityParameters),
            takes=takes,
            grown=grown,
            annotations=annotated,
            views=views,
            joint_limits=inputs.of("joint_limits"),
        )
    ]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score every term by AUC and pair by pair for every corruption, and by its rank correlation with the truth."""
    options = shard.options(DensityParameters)
    count, rng = options.num_judged_pairs, stream(shard.seed, TOPIC.name)
    take_refs, limit_refs = shard.refs("takes"), shard.refs("joint_limits")
    held_out = held_out_takes(store, take_refs)
    refuse_learned(store, (ref for name in shard.inputs if name != "takes" for ref in shard.refs(name)), held_out)
    takes = read_takes(store, take_refs, "pair17_m")
    hidden = np.concatenate([takes[name] for name in held_out])
    shown = np.concatenate([*(pairs for name, pairs in takes.items() if name not in held_out), hidden[:0]])
    gathered = gather(
        store,
        annotations=shard.refs("annotations"),
        views=shard.refs("views"),
        num_hypotheses=options.num_hypotheses,
    ).gathered
    bank = build_bank(gathered.view_density().sample(rng, NUM_VIEWS), gathered.pairs, num_candidates=NUM_CANDIDATES)
    comparer = TermComparer(
        read_limits(store, limit_refs),
        read_occupancy(store, limit_refs),
        gathered.pairs,
        bank,
        read_grown(store, shard.refs("grown")),
        options.part(PriorSettings),
    )
    real = hidden[rng.permutation(len(hidden))[:count]].astype(np.float64)
    comparisons = comparer.comparisons(rng, real, gathered.view_density().sample(rng, len(real)))
    scores: list[Score] = []
    areas: dict[str, dict[str, float]] = {}
    kinds = _with_far_flips(comparisons)
    for name, comparison in kinds.items():
        for term, values in comparison.real.items():
            false = comparison.corrupted[term]
            area, paired = area_under_curve(values, false), paired_accuracy(values, false)
            areas.setdefault(term, {})[name] = area
            scores.append(Score(f"auc_{name}", term, area, split="held_out", count=len(values)))
            scores.append(Score(f"paired_accuracy_{name}", term, paired, split="held_out", count=len(values)))
    columns = [*kinds]
    if len(comparer.grown_m) and len(shown):
        from scipy.stats import spearmanr  # here: a second that planning need not wait for

        columns.append("rank correlation")
        lifted, distance_m = _lifted(rng, comparer, shown, LIFTED_FOR_JUDGED * count)
        for term, values in lifted.items():
            # A term that says the same of every pair has no rank.
            if np.ptp(values) > 0.0:
                rank = float(spearmanr(-values, distance_m).statistic)
                areas[term][columns[-1]] = rank
                scores.append(Score(RANK_METRIC, term, rank, split="annotated", count=len(values)))
    picture = grid_figure(
        np.array([[row.get(column, np.nan) for column in columns] for row in areas.values()]),
        rows=list(areas),
        columns=[column.replace("_", " ") for column in columns],
        title="Area under the curve by term and corruption",
    )
    return TopicResult(
        scores=scores,
        pictures={"density-terms.svg": picture},
        captions={
            "density-terms.svg": "How often a real pair scores above a corrupted one, by term and kind of corruption; "
            "last, the rank correlation with the distance to the nearest real pair."
        },
        notes=[
            f"{len(real)} real pairs of {', '.join(held_out)}, and corruptions that their own image does not show; "
            "that image counts as annotated, so the best view of both is perfect. `auc`: the chance that a real pair "
            "scores above a corrupted one of any pair; `paired_accuracy`: above its own corruption; 0.5 is chance. "
            "The rank correlation is between minus the term and the distance from the nearest real pair, over pairs "
            "lifted without agreement. `image_odds` is the share of a pair's density among all lifts of its image."
        ],
    )


def _with_far_flips(comparisons: Mapping[Corruption, Comparison]) -> dict[str, Comparison]:
    """Return the comparisons by name, and beside all flips those that move a joint by 20 cm or more."""
    named = {}
    for kind, comparison in comparisons.items():
        named[str(kind)] = comparison
        if kind is Corruption.LIMB_FLIPPED and (comparison.moved_m >= FAR_M).any():
            named[f"{kind}_from_20_cm"] = comparison.from_m(FAR_M)
    return named


def _lifted(
    rng: np.random.Generator, comparer: TermComparer, shown: np.ndarray, count: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the terms of pairs lifted from grown ones, each from the nearest alone, and their distance from real ones.

    Distances are to the nearest real pair, (n,), metres.
    """
    alone = GrowthOptions(num_sweeps=0, num_neighbours=1)
    growth = grow(comparer.grown_m[:1], comparer.annotated, comparer.limits, num_grown=3 * count, options=alone)
    pairs, directions = growth.pairs_m[::3], comparer.annotated.directions[growth.entry[::3]]
    truth = Coverage(pairs)
    truth.add(shown[rng.permutation(len(shown))[:NUM_REAL]])
    values = comparer.values(pairs)
    values["image_odds"] = comparer.odds(camera_axes(pairs, directions, Corruption.DEPTH_MIRRORED))
    return values, truth.cartesian_m


TOPIC = Topic(
    name="density",
    heading="Density",
    introduction="How well terms of the density tell real pairs of held-out takes from corrupted ones (area under the "
    "curve), and how they go with the distance of lifted pairs from real ones.",
    reads=("poses", "seeds", "annotations", "views", "joint_limits"),
    plan=_plan,
    run=_run,
    metrics=("auc_*", "paired_accuracy_*", RANK_METRIC),
    settings=DensitySettings,
    yardsticks=(
        Yardstick(
            "auc_depth_mirrored",
            "area under the curve, pairs mirrored in depth",
            methods=("image_odds", "agreement"),
            is_larger_better=True,
            chance=0.5,
            chance_name="guessing",
        ),
    ),
)
