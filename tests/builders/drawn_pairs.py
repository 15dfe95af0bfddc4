"""Seeds and draws whose pairs are given, as the stages `seeds` and `chains` would have written them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.sampling.parameters import PairChart
from storage_schema import Manifest, Store
from tests.builders.storage_rows import put, random_columns


def put_seeds(store: Store, pairs_m: np.ndarray, name: str = "seeds", **told: Any) -> Manifest:
    """Commit pairs as grown seeds of take `one`."""
    count = len(pairs_m)
    rows = random_columns("seeds", count) | {"pair17_m": pairs_m, "seed_index": np.arange(count)}
    rows |= {"origin": ["lifted"] * count, "take_id": ["one"] * count}
    return put(store, "seeds", name, {"seeds": rows}, {"kind": "grown_seeds", "takes": ["one"]}, **told)


def put_draws(
    store: Store,
    name: str,
    pairs_m: np.ndarray,
    inputs: tuple[Manifest, ...],
    seed_m: np.ndarray,
    *,
    matched: str | None = None,
    density: str = "ic",
    segment: int = 0,
    chain: int = 0,
) -> Manifest:
    """Commit pairs as draws of a chain that began at a seed; the first matches frame 0 of a sequence, or none does."""
    count = len(pairs_m)
    rows = random_columns("draws", count) | {
        "density": [density] * count,
        "seed_index": [0] * count,
        "chain": [chain] * count,
        "draw": list(range(count)),
        "pair17_m": pairs_m,
        "parameters": PairChart(seed_m).parameters_of(pairs_m),
        "num_accepted": [3] * count,
        "log_prior": -1.0 * np.arange(count),
        "view": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "sequence_id": [matched, *[None] * (count - 1)],
        "sequence_frame": [None if matched is None else 0, *[None] * (count - 1)],
    }
    facts = {"kind": "draws", "density": density, "takes": ["one"], "num_draws": count, "segment": segment}
    facts |= {"chain": chain, "seed_index": 0}
    return put(store, "chains", name, {"draws": rows}, facts, inputs, density=density)
