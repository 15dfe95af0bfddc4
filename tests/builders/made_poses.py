"""Rows of what stages make of takes and videos, without their work: for tests of what goes out."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.synthetic import random_pairs
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.positions_as_motion import motion_from_positions
from pasdedeux.skeletons import BODY22, PAIR17
from storage_schema import Manifest, Store
from tasks.augmentation import BatchParameters
from tests.builders.source_samples import figure_motion
from tests.builders.storage_rows import put, random_columns

NUM_LIFTED = 3


def pair_bvh(pair_m: np.ndarray) -> tuple[str, str]:
    """Return a pair (2, 17, 3), metres, as the BVH texts of person A and person B, centimetres, one frame each."""
    first, second = (write_bvh(motion_from_positions(PAIR17, person[None], 30.0), decimals=8) for person in pair_m)
    return first, second


def put_made_poses(store: Store) -> None:
    """Commit two variants (one fails), draws, lifted pairs, in-betweens and motions of the store's take and video."""
    take = next(manifest for manifest in store.artifacts("ingest") if "poses" in manifest.tables)
    video = next(manifest for manifest in store.artifacts("ingest") if manifest.name == "video")
    parameters = BatchParameters(contacts=(), variants=("bad", "same")).model_dump(mode="json", exclude={"limits"})
    facts = {
        "takes": ["waltz"],
        "take_id": "waltz",
        "num_persons": 2,
        "num_frames": store.manifest(take.ref).tables["poses"].rows // 2,
        "told": parameters,
    }
    put(store, "augmentation", "variants", _variants(store, take), facts, (take,))
    chain = random_columns("draws", NUM_LIFTED) | {"density": ["ic"] * 3, "seed_index": [0] * 3, "chain": [0] * 3}
    pairs = random_pairs(np.random.default_rng(1), NUM_LIFTED, spread_rad=0.1)
    put(store, "chains", "draws", {"draws": chain | {"pair17_m": pairs}}, {"takes": ["waltz"]})
    annotations = store.read(video.ref, "annotations", columns=["sequence_id", "frame"])
    sequence, frames = str(annotations["sequence_id"][0]), np.arange(NUM_LIFTED)
    place = {"sequence_id": [sequence] * NUM_LIFTED, "person_id": [0] * 3, "partner_id": [1] * 3, "pair17_m": pairs}
    lifted = random_columns("lifted_pairs", NUM_LIFTED) | place | {"frame": 4 * frames, "method": ["nearest"] * 3}
    put(store, "lifting", "lifted", {"lifted_pairs": lifted}, {"takes": ["waltz"]}, (video,))
    between = random_columns("in_betweens", NUM_LIFTED) | place | {"frame": 1 + frames, "method": ["draws"] * 3}
    put(store, "lifting", "between", {"in_betweens": between}, {"takes": ["waltz"]}, (video,))
    put(store, "reconstruction", "motions", {"motions": _motions(sequence)}, {"kind": "motions"}, (video,))


def _variants(store: Store, take: Manifest) -> dict[str, Any]:
    rows = store.read(take.ref, "poses")
    order, count = np.lexsort((rows["person"], rows["frame"])), rows.num_rows
    quality = random_columns("variant_quality", 2) | {
        "take_id": ["waltz"] * 2,
        "variant_id": ["bad", "same"],
        "bone_scale": [np.ones(2 * BODY22.num_joints)] * 2,
        "verdict": ["fail", "pass"],
    }
    variants = random_columns("variants", 2 * count) | {
        "take_id": ["waltz"] * (2 * count),
        "variant_id": ["bad"] * count + ["same"] * count,
        "frame": np.tile(rows["frame"][order], 2),
        "person": np.tile(rows["person"][order], 2),
        "body22_m": np.tile(rows["body22_m"][order], (2, 1, 1)),
    }
    return {"variants": variants, "variant_quality": quality}


def _motions(sequence: str) -> dict[str, Any]:
    """Return two people who walk, the second a metre beside the first."""
    motion = figure_motion(NUM_LIFTED)
    positions = motion.world()[0]
    both = np.concatenate([positions, positions + np.array([1.0, 0.0, 0.0])])
    frames = np.tile(np.arange(NUM_LIFTED), 2)
    return random_columns("motions", len(both)) | {
        "sequence_id": [sequence] * len(both),
        "person_id": np.repeat([0, 1], NUM_LIFTED),
        "frame": frames,
        "time_s": frames / 30.0,
        "method": ["fit"] * len(both),
        "body22_m": both,
        "body22_unitquat": np.tile(motion.local_unitquat, (2, 1, 1)),
        "op14_m": both[:, :14],
        "is_bridged": np.zeros(len(both), bool),
    }
