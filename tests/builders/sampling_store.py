"""What the stages before `seeds` and `chains` would have written, small and made up, and how to run the two."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.synthetic import random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.kinematics.rotations import normalise
from storage_schema import Manifest, Store
from tasks import chains, seeds
from tasks.chains import ChainsParameters
from tasks.seeds import SeedsParameters
from tasks.stage import Shard, StageInputs
from tests.builders.storage_rows import put, take_rows

NUM_FRAMES = 40


def pairs_of(take_id: str) -> np.ndarray:
    return random_pairs(np.random.default_rng(sum(map(ord, take_id))), NUM_FRAMES, spread_rad=0.1)


def put_take(
    store: Store, take_id: str, *, is_held_out: bool = False, is_prior: bool = False, num_persons: int = 2
) -> Manifest:
    pairs = pairs_of(take_id)[:, :num_persons]
    joints = np.moveaxis(pairs, 1, 0).reshape(-1, 17, 3)
    columns, facts = take_rows(take_id, num_persons, NUM_FRAMES, is_held_out=is_held_out, pair17_m=joints)
    return put(store, "ingest", take_id, {"poses": columns}, {**facts, "is_prior": is_prior})


def put_annotations(
    store: Store,
    take_id: str,
    *,
    is_held_out: bool = False,
    spoil: Callable[[np.ndarray], None] = lambda _: None,
    has_one_view: bool = False,
) -> tuple[Manifest, Manifest]:
    """Commit annotations of a take from random views, one with a missing joint, each with the frames next to it.

    `spoil` changes the pixels (annotation, frame, person, joint, 2) in place; the annotated frame is the middle one.
    """
    rng = np.random.default_rng(5)
    pairs = pairs_of(take_id)
    directions = normalise(rng.normal(size=(NUM_FRAMES, 3)) * [1.0, 0.2, 1.0])
    if has_one_view:
        directions[:] = directions[0]
    images = project_pair(pairs, directions) * [100.0, -100.0] + 500.0
    drift = rng.normal(scale=1.5, size=images.shape)
    pixels = np.stack([images - drift, images, images + drift], axis=1)
    pixels[3, 1, 1, 4] = np.nan
    spoil(pixels)
    count = 2 * 3 * NUM_FRAMES
    sequence = [f"{take_id}/view{row:05d}" for row in range(NUM_FRAMES)]
    columns = {
        "sequence_id": np.repeat(sequence, 6).tolist(),
        "frame": np.tile(np.repeat([-1, 0, 1], 2), NUM_FRAMES),
        "person_id": np.tile([0, 1], 3 * NUM_FRAMES),
        "partner_id": np.tile([1, 0], 3 * NUM_FRAMES),
        "source_person_id": np.tile([0, 1], 3 * NUM_FRAMES),
        "time_s": np.zeros(count),
        "is_key": np.tile(np.repeat([False, True, False], 2), NUM_FRAMES),
        "is_virtual": np.ones(count, dtype=bool),
        "is_held_out": np.full(count, is_held_out),
        "take_id": [take_id] * count,
        "take_frame": np.repeat(np.arange(NUM_FRAMES), 6),
        "layout": ["pair17"] * count,
        "keypoints_px": [np.zeros(34)] * count,
        "keypoint_confidence": [np.ones(17)] * count,
        "pair17_px": pixels.reshape(count, 17, 2),
        "pair17_confidence": np.ones((count, 17)),
        "op14_px": np.zeros((count, 14, 2)),
        "op14_confidence": np.ones((count, 14)),
        "image_width_px": [1000] * count,
        "image_height_px": [1000] * count,
        "focal_px": [None] * count,
    }
    facts = {"kind": "sequences", "takes": [take_id], "is_held_out": is_held_out, "num_persons": 2, "is_virtual": True}
    annotations = put(
        store, "ingest", f"{take_id}-views", {"annotations": columns}, {**facts, "purpose": "random_views"}
    )
    views = {
        "sequence_id": sequence,
        "frame": np.zeros(NUM_FRAMES, dtype=int),
        "person_id": np.zeros(NUM_FRAMES, dtype=int),
        "partner_id": np.ones(NUM_FRAMES, dtype=int),
        "hypothesis": np.zeros(NUM_FRAMES, dtype=int),
        "depth_rule": ["zero"] * NUM_FRAMES,
        "flip": np.zeros(NUM_FRAMES, dtype=int),
        "root_depth_m": np.zeros(NUM_FRAMES),
        "direction": directions,
        "psi_rad": np.zeros(NUM_FRAMES),
        "phi_rad": np.zeros(NUM_FRAMES),
        "weight": np.ones(NUM_FRAMES),
        "trust": np.ones(NUM_FRAMES),
        "metres_per_pixel": np.full((NUM_FRAMES, 2), 0.01),
    }
    return annotations, put(store, "views", take_id, {"views": views}, facts, (annotations,))


def put_sampling_inputs(store: Store) -> dict[str, list[Manifest]]:
    """Commit two takes to learn from, one held out and one of a single person, and random views of two of them."""
    poses = [put_take(store, "one"), put_take(store, "two"), put_take(store, "kept_back", is_held_out=True)]
    poses.append(put_take(store, "single", num_persons=1))
    annotations, views = put_annotations(store, "one")
    hidden_annotations, hidden_views = put_annotations(store, "kept_back", is_held_out=True)
    return {"poses": poses, "annotations": [annotations, hidden_annotations], "views": [views, hidden_views]}


def run(shards: list[Shard], module: Any, store: Store) -> list[Manifest]:
    return [store.manifest(module.run_shard(shard, store)) for shard in shards]


def with_seeds(store: Store, tables: dict[str, list[Manifest]], **parameters: Any) -> StageInputs:
    planned = seeds.plan(StageInputs(tables, seed=1), SeedsParameters(**parameters))
    return StageInputs({**tables, "seeds": run(planned, seeds, store)}, seed=1)


QUICK = {"num_draws": 8, "segment_draws": 4, "thin": 3, "num_views": 4, "num_dispersing": 2, "num_warm_up": 2}
ONE_OF_THE_PRIOR: dict[str, Any] = {"num_chains": 1, "densities": ("prior_only",), "starts": "seeds"}
"""What gives one short chain from each seed, of the prior alone."""


def plan_chains(given: StageInputs, **changes: Any) -> list[Shard]:
    """Plan chains that are short unless the parameters say otherwise."""
    return chains.plan(given, ChainsParameters(**{**QUICK, **changes}))


def run_chains(store: Store, given: StageInputs, **changes: Any) -> list[Manifest]:
    """Plan such chains and run them."""
    return run(plan_chains(given, **changes), chains, store)


def draws_of(manifests: list[Manifest], store: Store) -> dict[tuple[str, int, int, int], np.ndarray]:
    rows = {}
    for manifest in manifests:
        if "draws" in manifest.tables:
            table = store.read(manifest.ref, "draws")
            for row in range(table.num_rows):
                place = tuple(table[name][row] for name in ("density", "seed_index", "chain", "draw"))
                rows[place] = table["parameters"][row]
    return rows
