"""Topic `density`: which terms of a density tell real pairs from corrupted ones, before anything is sampled from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.stats import spearmanr

from pasdedeux.evaluation.figures import grid_figure
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.experiments.combination import Combination
from pasdedeux.experiments.judging import (
    Comparison,
    Corruption,
    TermComparer,
    area_under_curve,
    camera_axes,
    paired_accuracy,
)
from pasdedeux.plausibility import JointLimits, Occupancy
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs, build_bank
from pasdedeux.sampling.coverage import Coverage
from pasdedeux.sampling.growth import GrowthOptions, grow
from pasdedeux.sampling.prior import PenetrationWeight, PriorSettings
from storage_schema import Store
from tasks.annotated_pairs import annotated_pairs, gather, views_of
from tasks.evaluation.topic import Topic, TopicResult, held_out_takes, refuse_learned
from tasks.evaluation.truth import read_takes
from tasks.priors import read_limits, read_occupancy
from tasks.stage import Parameters, Shard, StageInputs, stream

__all__ = ["COMBINED", "TOPIC"]

NUM_VIEWS, NUM_CANDIDATES = 12, 250
FAR_M = 0.2
"""Corruptions that move no joint as far as this are left out of a score of their own, metres."""
NUM_REAL = 1500
"""Real pairs that the distance of lifted pairs from the truth is measured to, at most."""
LIFTED_FOR_JUDGED = 2
"""Lifted pairs for each real pair."""
NUM_FITTED_TAKES = 2
"""Takes that the combination is fitted on, at most."""
COMBINED = (
    "image_odds",
    "placement",
    "limbs",
    "contact",
    "pose_prior_sum",
    "joint_limits",
    "agreement",
    "grown_near",
    "mean_view",
)
"""Terms of the combination."""
RANK_METRIC = "rank_correlation_with_nearest_real"


class DensitySettings(PenetrationWeight, Parameters):
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
    material = _read(shard, store)
    count = shard.options(DensityParameters).num_judged_pairs
    rng = stream(shard.seed, TOPIC.name)
    hidden = np.concatenate([material.takes[name] for name in material.held_out])
    shown = {name: pairs for name, pairs in material.takes.items() if name not in material.held_out}
    comparer = material.comparer(rng, None)
    comparisons = comparer.comparisons(rng, *material.some(rng, hidden, count))
    lifted = material.lifted(rng, comparer, np.concatenate([*shown.values(), hidden[:0]]), LIFTED_FOR_JUDGED * count)
    notes = [
        f"{min(count, len(hidden))} real pairs of {', '.join(material.held_out)}, and corruptions that their own "
        "image does not show; that image counts as annotated, so the best view of both is perfect. `auc`: the chance "
        "that a real pair scores above a corrupted one of any pair; `paired_accuracy`: above its own corruption; 0.5 "
        "is chance. The rank correlation is between minus the term and the distance from the nearest real pair, over "
        "pairs lifted without agreement. `image_odds` is the share of a pair's density among all lifts of its image."
    ]
    scores: list[Score] = []
    usable = [name for name in sorted(shown) if material.knows_others(name)]
    fitted_on = sorted(rng.permutation(usable)[:NUM_FITTED_TAKES].tolist())
    if fitted_on:
        combination = material.combination(rng, fitted_on, max(count // NUM_FITTED_TAKES, 1))
        for comparison in comparisons.values():
            for part in (comparison.real, comparison.corrupted):
                part["combination"] = combination.value(part)
        if lifted is not None:
            lifted.values["combination"] = combination.value(lifted.values)
        scores += [
            Score("combination_weight", term, float(weight), split="fitted")
            for term, weight in zip(combination.terms, combination.weights, strict=True)
        ]
        notes.append(
            "`combination` is logistic, of terms divided by their standard deviation over real pairs; it was fitted on "
            f"{', '.join(fitted_on)}, each judged with what grew from the other takes alone."
        )
    kinds = _with_far_flips(comparisons)
    areas: dict[str, dict[str, float]] = {}
    for name, comparison in kinds.items():
        for term, real in comparison.real.items():
            false = comparison.corrupted[term]
            area, paired = area_under_curve(real, false), paired_accuracy(real, false)
            areas.setdefault(term, {})[name] = area
            scores.append(Score(f"auc_{name}", term, area, split="held_out", count=len(real)))
            scores.append(Score(f"paired_accuracy_{name}", term, paired, split="held_out", count=len(real)))
    if lifted is not None:
        for term, values in lifted.values.items():
            # A term that says the same of every pair has no rank.
            if np.ptp(values) > 0.0:
                rank = float(spearmanr(-values, lifted.distance_m).statistic)
                areas[term]["rank correlation"] = rank
                count = len(values)
                scores.append(Score(RANK_METRIC, term, rank, split="annotated", count=count))
    columns = [*kinds, *(["rank correlation"] if lifted is not None else [])]
    picture = grid_figure(
        np.array([[row.get(column, np.nan) for column in columns] for row in areas.values()]),
        rows=list(areas),
        columns=[column.replace("_", " ") for column in columns],
        title="Area under the curve by term and corruption",
    )
    return TopicResult(
        scores=scores,
        pictures={"density-terms.png": picture},
        captions={
            "density-terms.png": "How often a real pair scores above a corrupted one, by term and kind of corruption; "
            "last, the rank correlation with the distance to the nearest real pair."
        },
        notes=notes,
    )


def _with_far_flips(comparisons: Mapping[Corruption, Comparison]) -> dict[str, Comparison]:
    """Return the comparisons by name, and beside all flips those that move a joint by 20 cm or more."""
    named = {}
    for kind, comparison in comparisons.items():
        named[str(kind)] = comparison
        if kind is Corruption.LIMB_FLIPPED and (comparison.moved_m >= FAR_M).any():
            named[f"{kind}_from_20_cm"] = comparison.from_m(FAR_M)
    return named


@dataclass(frozen=True)
class _Lifted:
    """Terms of lifted pairs, and how far each pair is from the nearest real one, metres."""

    values: dict[str, np.ndarray]
    distance_m: np.ndarray


@dataclass(frozen=True)
class _Material:
    """What terms are made from, with the take that each annotation and grown pair shows; None where nobody knows."""

    takes: dict[str, np.ndarray]
    held_out: list[str]
    limits: JointLimits
    occupancy: Occupancy
    gathered: GatheredPairs
    annotated_take: np.ndarray
    grown: np.ndarray
    grown_take: np.ndarray
    prior: PriorSettings

    def comparer(self, rng: np.random.Generator, without: str | None) -> TermComparer:
        """Return a judge that has seen no annotation of a take, and nothing that grew from one."""
        every = self.gathered.pairs
        is_seen, is_left = self._others(without)
        pairs = AnnotatedPairs(every.points_m[is_seen], every.directions[is_seen], every.annotation_index[is_seen])
        bank = build_bank(self.gathered.view_density().sample(rng, NUM_VIEWS), pairs, num_candidates=NUM_CANDIDATES)
        return TermComparer(self.limits, self.occupancy, pairs, bank, self.grown[is_left], self.prior)

    def knows_others(self, take: str) -> bool:
        """Whether annotations of other takes are there, and pairs that grew from them."""
        return all(bool(is_other.any()) for is_other in self._others(take))

    def _others(self, without: str | None) -> tuple[np.ndarray, ...]:
        return tuple(
            np.array([without is None or take != without for take in takes], dtype=bool)
            for takes in (self.annotated_take, self.grown_take)
        )

    def some(self, rng: np.random.Generator, pairs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return some pairs (n, 2, 17, 3) and a view of each (n, 3)."""
        some = pairs[rng.permutation(len(pairs))[:count]].astype(np.float64)
        return some, self.gathered.view_density().sample(rng, len(some))

    def combination(self, rng: np.random.Generator, takes: Sequence[str], count: int) -> Combination:
        """Fit a combination on pairs of takes, each judged as if it had not been annotated."""
        real: dict[str, list[Mapping[str, np.ndarray]]] = {}
        corrupted: dict[str, list[Mapping[str, np.ndarray]]] = {}
        for take in takes:
            comparisons = self.comparer(rng, take).comparisons(rng, *self.some(rng, self.takes[take], count))
            for kind, comparison in comparisons.items():
                if kind is Corruption.SLID_10:
                    continue
                far = comparison.from_m(FAR_M) if kind is Corruption.LIMB_FLIPPED else comparison
                if not len(far.moved_m):
                    continue
                real.setdefault(kind, []).append(far.real)
                corrupted.setdefault(kind, []).append(far.corrupted)
        return Combination.fitted(
            COMBINED, [_joined(real[kind]) for kind in real], [_joined(corrupted[kind]) for kind in real]
        )

    def lifted(self, rng: np.random.Generator, comparer: TermComparer, shown: np.ndarray, count: int) -> _Lifted | None:
        """Judge pairs that are lifted from a grown one, each from the nearest alone; None where nothing has grown."""
        if not (len(self.grown) and len(shown)):
            return None
        alone = GrowthOptions(num_sweeps=0, num_neighbours=1)
        growth = grow(self.grown[:1], self.gathered.pairs, self.limits, num_grown=3 * count, options=alone)
        pairs, directions = growth.pairs_m[::3], self.gathered.pairs.directions[growth.entry[::3]]
        truth = Coverage(pairs)
        truth.add(shown[rng.permutation(len(shown))[:NUM_REAL]])
        values = comparer.values(pairs)
        values["image_odds"] = comparer.odds(camera_axes(pairs, directions, Corruption.DEPTH_MIRRORED))
        return _Lifted(values, truth.cartesian_m)


def _joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _read(shard: Shard, store: Store) -> _Material:
    take_refs = shard.refs("takes")
    held_out = held_out_takes(store, take_refs)
    refuse_learned(store, (ref for name in shard.inputs if name != "takes" for ref in shard.refs(name)), held_out)
    take_of: dict[str, str | None] = {}
    for ref in shard.refs("annotations"):
        table = store.read(ref, "annotations", columns=["sequence_id", "take_id"])
        take_of.update(zip(table["sequence_id"], table["take_id"], strict=True))
    tables = [store.read(ref, "seeds", columns=["pair17_m", "sequence_id"]) for ref in shard.refs("grown")]
    placed = gather(
        store,
        annotations=shard.refs("annotations"),
        views=shard.refs("views"),
        num_hypotheses=shard.options(DensityParameters).num_hypotheses,
    )
    sequences = [placed.places[index][0] for index in placed.gathered.pairs.annotation_index.tolist()]
    return _Material(
        takes=read_takes(store, take_refs, "pair17_m"),
        held_out=held_out,
        limits=read_limits(store, shard.refs("joint_limits")),
        occupancy=read_occupancy(store, shard.refs("joint_limits")),
        gathered=placed.gathered,
        annotated_take=np.array([take_of.get(sequence) for sequence in sequences], dtype=object),
        grown=np.concatenate([np.zeros((0, 2, 17, 3)), *(np.asarray(table["pair17_m"]) for table in tables)]),
        grown_take=np.array([take_of.get(str(one)) for table in tables for one in table["sequence_id"]], dtype=object),
        prior=shard.options(DensityParameters).part(PriorSettings),
    )


TOPIC = Topic(
    name="density",
    heading="Density",
    introduction="How well terms of the density tell real pairs of held-out takes from corrupted ones (area under the "
    "curve), and how they go with the distance of lifted pairs from real ones.",
    reads=("poses", "seeds", "annotations", "views", "joint_limits"),
    plan=_plan,
    run=_run,
    settings=DensitySettings,
    yardsticks=(
        Yardstick(
            "auc_depth_mirrored",
            "area under the curve, pairs mirrored in depth",
            methods=("combination", "agreement"),
            is_larger_better=True,
            chance=0.5,
            chance_name="guessing",
        ),
    ),
)
