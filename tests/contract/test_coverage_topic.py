"""Which draws coverage is measured of, on which takes, and that nothing is evaluated on what it learned from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.interaction.coverage import CoverageCurve
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
from tests.builders.sampling_store import ONE_OF_THE_PRIOR, QUICK, put_take, run_chains, with_seeds
from tests.builders.storage_rows import having, put


def test_draws_of_the_first_seed_stand_alone_where_a_density_has_many_seeds_and_only_there(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=5, num_grown=4, num_starts=1)
    made = run_chains(store, given, **ONE_OF_THE_PRIOR, sweep={"grown": {"starts": "grown"}})
    found = draws_from_first_seeds(store, tuple(manifest.ref for manifest in made))
    assert {name: len(draws.pairs_m) for name, draws in found.items()} == {"prior_only_first_seed": 8}
    # A sweep of the prior alone is a baseline, whatever its name.
    draw_sets = read_draw_sets(store, [manifest.ref for manifest in having("draws", made)])
    assert baselines_of(draw_sets) == ["grown", "prior_only"]


def test_coverage_is_not_measured_on_takes_that_priors_learned_from_and_says_so(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables)
    learned = {"poses": [put_take(store, "learned", is_prior=True)], "annotations": []}
    draws = run_chains(store, given, **ONE_OF_THE_PRIOR)
    for shard in TOPIC.plan(StageInputs({**given.manifests, **learned, "draws": draws}, 1), CoverageSettings()):
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


def test_chains_that_run_side_by_side_cover_in_the_order_in_which_they_drew(inputs: Any) -> None:
    store, tables = inputs
    made = run_chains(store, with_seeds(store, tables, num_seeds=2), densities=("prior_only",))
    refs = [manifest.ref for manifest in having("draws", made)]
    (found,) = read_draw_sets(store, refs).values()
    parts = [store.read(ref, "draws", columns=["draw", "pair17_m"]) for ref in refs]
    numbers, pairs = (np.concatenate([part[name] for part in parts]) for name in ("draw", "pair17_m"))
    by_draw = [pair for number in range(QUICK["num_draws"]) for pair in pairs[numbers == number]]
    np.testing.assert_array_equal(found.in_order, by_draw)


def test_real_pairs_that_cover_are_not_those_to_be_covered(inputs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=4)
    made = run_chains(store, given, **ONE_OF_THE_PRIOR)
    draws = having("draws", made)
    compared: list[set[bytes]] = []

    def levels(truth_m: np.ndarray, real_m: np.ndarray, generator: np.random.Generator) -> CoverageCurve:
        compared.extend({pair.tobytes() for pair in pairs} for pairs in (truth_m, real_m))
        return real_frame_levels(truth_m, real_m, generator)

    monkeypatch.setattr(coverage, "real_frame_levels", levels)
    known = StageInputs({**given.manifests, "draws": draws}, seed=1)
    for shard in coverage.TOPIC.plan(known, CoverageSettings(num_truth_pairs=300)):
        coverage.TOPIC.compute(shard, store)
        truth, real = compared[-2:]
        assert truth
        assert real
        assert truth.isdisjoint(real)
    assert len(compared) == 6
