"""Topic `chains`: how the Markov chains went."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pasdedeux.evaluation.scores import Score
from storage_schema import Store
from tasks.evaluation.topic import TopicResult, make_shard
from tasks.stage import Shard, StageInputs

__all__ = ["TOPIC", "run", "shards"]

TOPIC = "chains"
_REDUCE: dict[str, Callable[[np.ndarray], np.float64]] = {"mean": np.mean, "least": np.min, "greatest": np.max}
_FIGURES = {
    "acceptance_rate": ("", "mean"),
    "ess_min": ("", "least"),
    "rhat_max": ("", "greatest"),
    "travelled_m": ("m", "mean"),
    "log_density_first": ("", "mean"),
    "log_density_mean": ("", "mean"),
}


def shards(inputs: StageInputs) -> list[Shard]:
    """One shard over the summaries of all chains."""
    found = inputs.of("chain_info")
    return [make_shard(topic=TOPIC, name="summary", inputs=found, parameters={}, seed=inputs.seed)] if found else []


def run(shard: Shard, store: Store) -> TopicResult:
    """Summarise the chains of each density and seed."""
    scores, notes = [], []
    for ref in shard.inputs:
        table = store.read(ref, "chain_info")
        density, seed = table["density"][0], int(table["seed_index"][0])
        for name, (unit, kind) in _FIGURES.items():
            scores.append(
                Score(
                    topic=TOPIC,
                    metric=f"{name.removesuffix('_m')}_{kind}",
                    method=density,
                    value=float(_REDUCE[kind](table[name])),
                    unit=unit,
                    is_baseline=density == "prior_only",
                    item=f"seed {seed}",
                    count=table.num_rows,
                )
            )
        notes += [
            f"Density {density}, seed {seed}, chain {table['chain'][row]}: "
            f"{table['verdict'][row]} - {table['reason'][row]}."
            for row in np.nonzero(table["verdict"] != "ok")[0]
        ]
    return TopicResult(scores=scores, notes=notes)
