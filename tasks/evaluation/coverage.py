"""Topic `coverage`: how well the draws cover real pairs on annotated, unannotated and held-out frames."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.evaluation.coverage import (
    coverage_figure,
    coverage_scores,
    curve_points,
    nearest_by_method,
    of_prior,
    real_frame_levels,
    realism_scores,
    union_scores,
)
from pasdedeux.evaluation.embedding import PairMap, map_figure
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.experiments.exploration import exploration_table
from pasdedeux.sampling.coverage import CoverageCurve, coverage_curve
from storage_schema import ArtifactRef, Store
from tasks.draw_sets import GROWN, draw_manifests, read_draw_sets
from tasks.evaluation.ground_truth import read_rates, read_take_frames, read_takes
from tasks.evaluation.topic import Topic, TopicResult, held_out_takes, refuse_learned
from tasks.facts import DrawFacts, SeedFacts, SequenceFacts, TakeFacts
from tasks.stage import Parameters, Shard, StageInputs, stream

SPLITS = ("annotated", "unannotated", "held_out")
_NUM_MAPPED = 150
"""Real pairs on the map."""
_MAPPED_DRAWS = (10, 50, 250)
"""Draws of each method on its panels."""
_MANY_SEEDS = 5


class CoverageSettings(Parameters):
    """How finely coverage is measured."""

    num_truth_pairs: int = Field(300, ge=1, description="Real pairs of each part that coverage is measured on, at most")
    num_curve_points: int = Field(12, ge=2, description="Points of the coverage curve")


class CoverageParameters(CoverageSettings):
    """One part of the real frames."""

    split: str


def _plan(inputs: StageInputs, settings: CoverageSettings) -> list[Shard]:
    """Plan one shard per part of the real frames, over the draws of every density and the grown seeds."""
    draws = draw_manifests(inputs)
    takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).num_persons == 2]
    annotations = [
        manifest for manifest in inputs.of("annotations") if SequenceFacts.of(manifest).purpose == "random_views"
    ]
    if not draws or not takes:
        return []
    seeds = [seed for seed in inputs.of("seeds") if SeedFacts.of(seed).kind != GROWN]
    named = {"takes": takes, "annotations": annotations, "first_seed": seeds[:1], "draws": draws}
    has_held_out = any(TakeFacts.of(take).is_held_out for take in takes)
    return [
        TOPIC.shard(inputs, split, settings.part(CoverageParameters, split=split), **named)
        for split in SPLITS
        if split != "held_out" or has_held_out
    ]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Measure coverage on one part of the real frames."""
    options = shard.options(CoverageParameters)
    split, take_refs, draw_refs = options.split, shard.refs("takes"), shard.refs("draws")
    held_out = held_out_takes(store, take_refs)
    refuse_learned(store, draw_refs, held_out)
    learned = [ref for ref in take_refs if TakeFacts.of(store.manifest(ref)).is_prior]
    takes = read_takes(store, [ref for ref in take_refs if ref not in learned], "pair17_m")
    notes = []
    if learned:
        names = ", ".join(sorted(take.take_id for take in TakeFacts.read(store, learned)))
        notes.append(f"Coverage is not measured on {names}: priors learned from what people did there.")
    annotated = set(read_take_frames(store, shard.refs("annotations"), keys_only=True).values())
    generator = stream(shard.seed, TOPIC.name, split)
    truth, others, places = _split(takes, annotated, held_out, split)
    if not len(truth) or not len(others):
        return TopicResult(notes=[*notes, f"Coverage of {split.replace('_', ' ')} frames: there are none."])
    chosen = generator.permutation(len(truth))[: options.num_truth_pairs]
    truth = truth[chosen]
    draws = {name: found.pairs_m for name, found in read_draw_sets(store, draw_refs).items()}
    mapped = list(draws)
    draws |= draws_from_first_seeds(store, draw_refs)
    # In random order, so that every seed counts from the start.
    draws = {name: pairs[generator.permutation(len(pairs))] for name, pairs in draws.items()}
    curves = {
        name: coverage_curve(truth, pairs, curve_points(len(pairs), options.num_curve_points))
        for name, pairs in draws.items()
    }
    levels = real_frame_levels(truth, others, generator)
    words = split.replace("_", " ")
    scores = coverage_scores(curves, levels, split=split, num_truth=len(truth))
    scores += union_scores(curves, levels, GROWN, split=split)
    scores += realism_scores(draws, np.concatenate([truth, others]), generator, split=split)
    name = f"coverage-{split}.svg"
    pictures = {name: coverage_figure(curves, levels, split=split)}
    captions = {
        name: f"How far {words} real pairs are from their nearest draw, as draws grow in number: lower is better, and "
        "dashed is the trivial way. Grey lines: what so many real pairs in place of draws come to. From the left: by "
        "the distances between both people's joints (D_I), joint by joint (D_C), by shape (D_S)."
    }
    shown = _map(truth, {name: draws[name] for name in mapped}, _seed(store, shard.refs("first_seed")), split)
    if shown is not None:
        name = f"coverage-map-{split}.svg"
        pictures[name] = shown
        captions[name] = (
            f"A map of {words} real pairs and of draws among them, more from left to right: who is near is alike, in "
            "centimetres (Yin et al. 2018, fig. 8); the cross is the first seed. Better: draws lie wherever real pairs "
            "lie, and nowhere else."
        )
    return TopicResult(
        scores=scores,
        pictures=pictures,
        captions=captions,
        notes=notes,
        items={"": _items(curves, [places[at] for at in chosen], read_rates(store, take_refs), split)},
    )


def _items(
    curves: dict[str, CoverageCurve], places: list[tuple[str, int]], rates: dict[str, float], split: str
) -> Items:
    """Return how far each real pair is from the nearest draw; none of takes that draws were made from."""
    if split != "held_out":
        return Items()
    values = nearest_by_method(curves, GROWN)
    takes, times_s = [take for take, _ in places], [frame / rates[take] for take, frame in places]
    return Items(values, takes, times_s, {name for name in values if of_prior(name)})


def draws_from_first_seeds(store: Store, refs: tuple[ArtifactRef, ...]) -> dict[str, np.ndarray]:
    """Return the draws from the first seed alone of each density that has many others: how far chains walk."""
    facts = {ref: DrawFacts.of(one) for ref in refs if "draws" in (one := store.manifest(ref)).tables}
    seeds: dict[str, set[int]] = {}
    for fact in facts.values():
        seeds.setdefault(fact.density, set()).add(fact.seed_index)
    first = {name: min(indices) for name, indices in seeds.items() if len(indices) >= _MANY_SEEDS}
    own = tuple(ref for ref, fact in facts.items() if first.get(fact.density) == fact.seed_index)
    return {f"{name}_first_seed": found.pairs_m for name, found in read_draw_sets(store, own).items()}


def _seed(store: Store, refs: tuple[ArtifactRef, ...]) -> np.ndarray | None:
    """Return the first seed (1, 2, 17, 3)."""
    pairs = [np.asarray(store.read(ref, "seeds", columns=["pair17_m"])["pair17_m"], dtype=np.float64) for ref in refs]
    return pairs[0][:1] if pairs else None


def _map(truth: np.ndarray, draws: dict[str, np.ndarray], seed: np.ndarray | None, split: str) -> bytes | None:
    """Draw the draws among the real pairs, at three numbers of draws; nothing where the pairs are all alike."""
    try:
        plane = PairMap.of(truth[:_NUM_MAPPED])
    except InputError:
        return None
    panels = {
        f"{count} draws of each": {name: plane.place(pairs[:count].astype(np.float64)) for name, pairs in draws.items()}
        for count in _MAPPED_DRAWS
    }
    return map_figure(
        plane.places,
        panels,
        seed=None if seed is None else plane.place(seed)[0],
        title=f"{split.replace('_', ' ')} frames and draws ({plane.share:.0%} of the spread shown)",
    )


def _split(
    takes: dict[str, np.ndarray], annotated: set[tuple[str, int]], held_out: list[str], split: str
) -> tuple[np.ndarray, np.ndarray, list[tuple[str, int]]]:
    """Return the part's real pairs, other real pairs of takes that are not held out, take and frame of the first."""
    wanted, others = [], []
    places: list[tuple[str, int]] = []
    for take_id, pairs in takes.items():
        is_annotated = np.array([(take_id, frame) in annotated for frame in range(len(pairs))], dtype=bool)
        if take_id in held_out:
            if split == "held_out":
                wanted.append(pairs)
                places += [(take_id, frame) for frame in range(len(pairs))]
            continue
        chosen = {"annotated": is_annotated, "unannotated": ~is_annotated, "held_out": np.zeros(len(pairs), dtype=bool)}
        wanted.append(pairs[chosen[split]])
        places += [(take_id, int(frame)) for frame in np.flatnonzero(chosen[split])]
        others.append(pairs[~chosen[split]])
    empty = np.zeros((0, 2, 17, 3))
    return np.concatenate([empty, *wanted]), np.concatenate([empty, *others]), places


TOPIC = Topic(
    name="coverage",
    heading="Coverage",
    introduction="Whether draws reach what people really did: how far real pairs are from their nearest draw, beside "
    "chains that know only how bodies move (the trivial way) and beside real pairs in place of draws.",
    reads=("draws", "seeds", "poses", "annotations"),
    plan=_plan,
    run=_run,
    settings=CoverageSettings,
    criteria=(Criterion("coverage_D_C", "distance from a real pair to the nearest draw", "m", "real pairs"),),
    tables=lambda scores: exploration_table(scores.get("coverage", ()), scores.get("chains", ())),
)
