"""Topic `coverage`: how well the draws cover real pairs on annotated, unannotated and held-out frames."""

from __future__ import annotations

import numpy as np

from pasdedeux.evaluation.coverage import (
    coverage_figure,
    coverage_note,
    coverage_scores,
    curve_points,
    real_frame_levels,
)
from pasdedeux.sampling.coverage import CoverageCurve, coverage_curve
from storage_schema import ArtifactRef, Store
from tasks.evaluation.topic import TopicResult, make_shard, refuse_overlap
from tasks.evaluation.truth import read_take_frames, read_takes
from tasks.stage import Shard, StageInputs, stream

__all__ = ["TOPIC", "run", "shards"]

TOPIC = "coverage"
SPLITS = ("annotated", "unannotated", "held_out")


def shards(inputs: StageInputs, *, num_truth_pairs: int, num_curve_points: int) -> list[Shard]:
    """One shard per part of the real frames, over the draws of every density and the grown seeds."""
    draws = [*inputs.of("draws"), *(seed for seed in inputs.of("seeds") if seed.facts["kind"] == "grown_seeds")]
    takes = [manifest for manifest in inputs.of("poses") if manifest.facts["num_persons"] == 2]
    annotations = [
        manifest
        for manifest in inputs.of("annotations")
        if manifest.facts["is_virtual"] and manifest.facts["purpose"] == "random_views"
    ]
    if not draws or not takes:
        return []
    has_held_out = any(take.facts["is_held_out"] for take in takes)
    return [
        make_shard(
            topic=TOPIC,
            name=split,
            inputs=[*takes, *annotations, *draws],
            parameters={
                "split": split,
                "num_takes": len(takes),
                "num_annotations": len(annotations),
                "num_truth_pairs": num_truth_pairs,
                "num_curve_points": num_curve_points,
            },
            seed=inputs.seed,
        )
        for split in SPLITS
        if split != "held_out" or has_held_out
    ]


def run(shard: Shard, store: Store) -> TopicResult:
    """Measure coverage on one part of the real frames."""
    split, parameters = shard.parameters["split"], shard.parameters
    take_refs = shard.inputs[: parameters["num_takes"]]
    annotation_refs = shard.inputs[parameters["num_takes"] : parameters["num_takes"] + parameters["num_annotations"]]
    draw_refs = shard.inputs[parameters["num_takes"] + parameters["num_annotations"] :]
    held_out = {f["take_id"] for ref in take_refs if (f := store.manifest(ref).facts)["is_held_out"]}
    for ref in draw_refs:
        refuse_overlap(
            f"artifact {store.manifest(ref).partition}", store.manifest(ref).facts["takes"], sorted(held_out)
        )
    takes = read_takes(store, take_refs, "pair17_m")
    annotated = set(read_take_frames(store, annotation_refs).values())
    generator = stream(shard.seed, TOPIC, split)
    truth, others = _split(takes, annotated, held_out, split)
    if not len(truth) or not len(others):
        return TopicResult(notes=[f"Coverage of {split.replace('_', ' ')} frames: there are none."])
    truth = truth[generator.permutation(len(truth))[: parameters["num_truth_pairs"]]]
    curves = {
        density: _curve(truth, pairs, parameters["num_curve_points"], generator)
        for density, pairs in _draws(store, draw_refs).items()
    }
    levels = real_frame_levels(truth, others, generator)
    name = f"coverage-{split}.png"
    return TopicResult(
        scores=coverage_scores(curves, levels, split=split, num_truth=len(truth)),
        pictures={name: coverage_figure(curves, levels, split=split)},
        captions={
            name: f"Coverage of {split.replace('_', ' ')} frames by the draws of each density and by grown seeds."
        },
        notes=[note] if (note := coverage_note(curves, split=split)) else [],
    )


def _split(
    takes: dict[str, np.ndarray], annotated: set[tuple[str, int]], held_out: set[str], split: str
) -> tuple[np.ndarray, np.ndarray]:
    """Give the real pairs of the part, and the other real pairs of takes that are not held out."""
    wanted, others = [], []
    for take_id, pairs in takes.items():
        is_annotated = np.array([(take_id, frame) in annotated for frame in range(len(pairs))], dtype=bool)
        if take_id in held_out:
            if split == "held_out":
                wanted.append(pairs)
            continue
        chosen = {"annotated": is_annotated, "unannotated": ~is_annotated, "held_out": np.zeros(len(pairs), dtype=bool)}
        wanted.append(pairs[chosen[split]])
        others.append(pairs[~chosen[split]])
    empty = np.zeros((0, 2, 17, 3))
    return np.concatenate([empty, *wanted]), np.concatenate([empty, *others])


def _draws(store: Store, refs: tuple[ArtifactRef, ...]) -> dict[str, np.ndarray]:
    """Give the draws (draw, 2, 17, 3) of each density, all seeds and chains, and the grown seeds."""
    found: dict[str, list[np.ndarray]] = {}
    for ref in refs:
        if "seeds" in store.manifest(ref).tables:
            table = store.read(ref, "seeds", columns=["pair17_m"])
            if table.num_rows:
                found.setdefault("grown_seeds", []).append(np.asarray(table["pair17_m"], dtype=np.float64))
            continue
        table = store.read(ref, "draws", columns=["density", "pair17_m"])
        found.setdefault(str(table["density"][0]), []).append(table["pair17_m"].astype(np.float64))
    return {density: np.concatenate(parts) for density, parts in sorted(found.items())}


def _curve(truth: np.ndarray, draws: np.ndarray, num_points: int, generator: np.random.Generator) -> CoverageCurve:
    """Measure coverage over the draws in random order, so that every seed counts from the start."""
    return coverage_curve(truth, draws[generator.permutation(len(draws))], curve_points(len(draws), num_points))
