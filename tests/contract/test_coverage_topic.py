"""Which draws coverage is measured of, on which takes, and that nothing is evaluated on what it learned from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.interaction.coverage import CoverageCurve
from storage_schema import Store
from tasks import chains
from tasks.chains import ChainsParameters
from tasks.evaluation import coverage, reconstruction
from tasks.evaluation.coverage import (
    TOPIC,
    CoverageParameters,
    CoverageSettings,
    draws_from_first_seeds,
    real_frame_levels,
)
from tasks.rows.draw_sets import baselines_of, read_draw_sets
from tasks.stage import StageInputs
from tests.builders.sampling_store import QUICK, inputs, put_take, run, with_seeds
from tests.builders.storage_rows import put

__all__ = ["inputs"]


def test_draws_of_the_first_seed_stand_alone_where_a_density_has_many_seeds_and_only_there(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=5, num_grown=4, num_starts=1)
    options = {**QUICK, "num_chains": 1, "densities": ("prior_only",), "starts": "seeds"}
    sweep = {"grown": {"starts": "grown"}}
    made = run(chains.plan(given, ChainsParameters(**options, sweep=sweep)), chains, store)
    found = draws_from_first_seeds(store, tuple(one.ref for one in made))
    assert {name: len(draws.pairs_m) for name, draws in found.items()} == {"prior_only_first_seed": 8}
    # A sweep of the prior alone is a baseline, whatever its name.
    assert baselines_of(read_draw_sets(store, [one.ref for one in made if "draws" in one.tables])) == [
        "grown",
        "prior_only",
    ]


def test_coverage_is_not_measured_on_takes_that_priors_learned_from_and_says_so(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables)
    options = {**QUICK, "num_chains": 1, "densities": ("prior_only",), "starts": "seeds"}
    draws = run(chains.plan(given, ChainsParameters(**options)), chains, store)
    evaluated = {
        **given.manifests,
        "poses": [put_take(store, "learned", is_prior=True)],
        "annotations": [],
        "draws": draws,
    }
    for shard in TOPIC.plan(StageInputs(evaluated, 1), CoverageSettings()):
        assert TOPIC.compute(shard, store).notes == [
            "Coverage is not measured on learned, because the priors were learned from these takes.",
            f"Coverage of {shard.name} frames is not measured: there are no such frames.",
        ]


def test_what_learned_from_a_take_is_not_evaluated_on_it(inputs: Any) -> None:
    store, tables = inputs
    leaky = put(store, "chains", "leaky", {}, {"takes": ["one", "kept_back"]})
    motions = put(store, "reconstruction", "film", {}, {"database_takes": ["one", "two"], "sequence_takes": ["two"]})
    nothing, held_out = StageInputs({}, seed=1), CoverageParameters(split="held_out")
    for topic, shard in (
        (coverage.TOPIC, coverage.TOPIC.shard(nothing, "held_out", held_out, takes=tables["poses"], draws=[leaky])),
        (reconstruction.TOPIC, reconstruction.TOPIC.shard(nothing, "film", motions=[motions])),
    ):
        with pytest.raises(InputError, match=r"learned from (kept_back|two), which it is evaluated on"):
            topic.compute(shard, store)


def sampled(inputs: Any) -> tuple[Store, StageInputs]:
    """Return the store with chains of one seed, and what the topic reads of it."""
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=4)
    options = {**QUICK, "num_chains": 1, "densities": ("prior_only",), "starts": "seeds"}
    made = run(chains.plan(given, ChainsParameters(**options)), chains, store)
    return store, StageInputs({**given.manifests, "draws": [one for one in made if "draws" in one.tables]}, seed=1)


def test_chains_that_run_side_by_side_cover_in_the_order_in_which_they_drew(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=2)
    made = run(chains.plan(given, ChainsParameters(**QUICK, densities=("prior_only",))), chains, store)
    refs = [one.ref for one in made if "draws" in one.tables]
    (found,) = read_draw_sets(store, refs).values()
    parts = [store.read(ref, "draws", columns=["draw", "pair17_m"]) for ref in refs]
    numbers, pairs = (np.concatenate([part[name] for part in parts]) for name in ("draw", "pair17_m"))
    by_draw = [pair for number in range(QUICK["num_draws"]) for pair in pairs[numbers == number]]
    np.testing.assert_array_equal(found.in_order, by_draw)


def test_real_pairs_that_cover_are_not_those_to_be_covered(inputs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    store, known = sampled(inputs)
    compared: list[set[bytes]] = []

    def levels(truth_m: np.ndarray, real_m: np.ndarray, generator: np.random.Generator) -> CoverageCurve:
        compared.extend({pair.tobytes() for pair in pairs} for pairs in (truth_m, real_m))
        return real_frame_levels(truth_m, real_m, generator)

    monkeypatch.setattr(coverage, "real_frame_levels", levels)
    for shard in coverage.TOPIC.plan(known, CoverageSettings(num_truth_pairs=300)):
        coverage.TOPIC.compute(shard, store)
        truth, real = compared[-2:]
        assert truth
        assert real
        assert truth.isdisjoint(real)
    assert len(compared) == 6
