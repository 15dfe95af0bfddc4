"""Topic `density`: which terms of a density tell real pairs from corrupted ones, before anything is sampled from it."""

from __future__ import annotations

import numpy as np
from scipy.stats import spearmanr

from pasdedeux.evaluation.scores import Score
from pasdedeux.sampling.coverage import Coverage
from pasdedeux.sampling.growth import GrowthOptions, grow
from pasdedeux.sampling.judging import Corruption, Judge, corrupt, separation, told_apart
from pasdedeux.sampling.likelihood import build_bank
from storage_schema import Store
from tasks.annotated_pairs import annotated_pairs, gather, views_of
from tasks.evaluation.topic import TopicResult, make_shard, refuse_overlap
from tasks.evaluation.truth import read_takes
from tasks.priors import read_occupancy
from tasks.seeds import read_limits
from tasks.stage import Shard, StageInputs, stream

__all__ = ["TOPIC", "run", "shards"]

TOPIC = "density"
NUM_VIEWS, NUM_CANDIDATES = 12, 250
FAR_M = 0.2
"""Corruptions that move no joint as far as this are left out of a score of their own, metres."""
NUM_REAL = 1500
"""Real pairs that the distance of lifted pairs from the truth is measured to, at most."""


def shards(inputs: StageInputs, *, num_judged_pairs: int) -> list[Shard]:
    """One shard over the pairs of takes that are held out; none where there are no such takes or no annotations."""
    takes = [manifest for manifest in inputs.of("poses") if manifest.facts["num_persons"] == 2]
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    if not (num_judged_pairs and annotated and views and any(take.facts["is_held_out"] for take in takes)):
        return []
    grown = [manifest for manifest in inputs.of("seeds") if manifest.facts["kind"] == "grown_seeds"]
    return [
        make_shard(
            topic=TOPIC,
            name="terms",
            inputs=[*takes, *grown, *annotated, *views, *inputs.of("joint_limits")],
            parameters={
                "num_takes": len(takes),
                "num_grown": len(grown),
                "num_judged_pairs": num_judged_pairs,
                "num_hypotheses": 1,
            },
            seed=inputs.seed,
        )
    ]


def run(shard: Shard, store: Store) -> TopicResult:
    """Score every term by AUC and pair by pair for every corruption, and by its rank correlation with the truth."""
    count, num_takes = int(shard.parameters["num_judged_pairs"]), int(shard.parameters["num_takes"])
    take_refs = shard.inputs[:num_takes]
    grown_refs = shard.inputs[num_takes : num_takes + int(shard.parameters["num_grown"])]
    facts = {ref: store.manifest(ref).facts for ref in take_refs}
    held_out = sorted(str(fact["take_id"]) for fact in facts.values() if fact["is_held_out"])
    for ref in shard.inputs[num_takes:]:
        refuse_overlap(f"artifact {store.manifest(ref).partition}", store.manifest(ref).facts["takes"], held_out)
    rng = stream(shard.seed, TOPIC)
    takes = read_takes(store, take_refs, "pair17_m")
    hidden = np.concatenate([takes[name] for name in held_out])
    shown = np.concatenate([pairs for name, pairs in takes.items() if name not in held_out] or [hidden[:0]])
    tables = [store.read(ref, "seeds", columns=["pair17_m"]) for ref in grown_refs]
    grown = np.concatenate([np.zeros((0, 2, 17, 3)), *(np.asarray(table["pair17_m"]) for table in tables)])
    gathered = gather(shard, store).gathered
    limits = read_limits(shard, store)
    density = gathered.view_density()
    bank = build_bank(density.sample(rng, NUM_VIEWS), gathered.pairs, num_candidates=NUM_CANDIDATES)
    real = hidden[rng.permutation(len(hidden))[:count]].astype(np.float64)
    directions = density.sample(rng, len(real))
    judge = Judge(limits, read_occupancy(shard, store), gathered.pairs, bank, grown)
    own = judge.values(real)
    scores: list[Score] = []
    for kind in Corruption:
        corrupted = corrupt(rng, real, directions, kind)
        false = judge.values(corrupted.pairs_m)
        is_far = corrupted.moved_m >= FAR_M
        for name, chosen in ((str(kind), np.ones_like(is_far)), (f"{kind}_from_20_cm", is_far)):
            rows = corrupted.rows[chosen]
            if not len(rows) or (name != kind and kind is not Corruption.LIMB_FLIPPED):
                continue
            for term, values in own.items():
                auc, paired = (
                    separation(values[rows], false[term][chosen]),
                    told_apart(values[rows], false[term][chosen]),
                )
                scores.append(Score(TOPIC, f"auc_{name}", term, auc, split="held_out", count=len(rows)))
                scores.append(Score(TOPIC, f"told_apart_{name}", term, paired, split="held_out", count=len(rows)))
    if len(grown) and len(shown):
        alone = GrowthOptions(num_sweeps=0, num_neighbours=1)
        lifted = grow(grown[:1], gathered.pairs, limits, num_grown=3 * count, options=alone).pairs_m[::3]
        truth = Coverage(lifted)
        truth.add(shown[rng.permutation(len(shown))[:NUM_REAL]])
        scores += [
            Score(
                TOPIC,
                "rank_correlation_with_nearest_real",
                term,
                float(spearmanr(-values, truth.cartesian_m).statistic),
                split="annotated",
                count=len(lifted),
            )
            for term, values in judge.values(lifted).items()
            # A term that says the same of every pair has no rank.
            if np.ptp(values) > 0.0
        ]
    note = (
        f"{len(real)} real pairs of {', '.join(held_out)}, and corruptions that their own image does not show; that "
        "image counts as annotated, so the best view of both is perfect. `auc`: the chance that a real pair scores "
        "above a corrupted one of any pair; `told_apart`: above its own corruption; 0.5 is chance. The rank "
        "correlation is between minus the term and the distance from the nearest real pair, over pairs lifted without "
        "agreement."
    )
    return TopicResult(scores=scores, notes=[note])
