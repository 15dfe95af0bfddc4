"""Chains that start from every grown and filled pair: one end of each, whoever runs them, and where they are read."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.repair import learn_scales
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import MIN_LOG_PRIOR, PairSelector
from storage_schema import Manifest, Store
from tasks import chains
from tasks.chains import ChainsParameters
from tasks.rows.draw_sets import FILLED, GROWN, read_draw_sets
from tasks.rows.selection import select_pairs
from tasks.seeds.files import pair_of_draw
from tasks.stage import StageInputs
from tasks.summary import summary_of
from tests.builders.ingest_runs import judged
from tests.builders.sampling_store import put_sampling_inputs, run, run_chains, with_seeds

REPAIR = {"starts": "every", "densities": ("ic",), "num_views": 4, "repair_steps": 20}


@pytest.fixture(scope="module")
def repaired(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Store, StageInputs, list[Manifest]]]:
    """Give a store, what chains read of it, and what is repaired in shards of 12 pairs."""
    store = Store(tmp_path_factory.mktemp("repaired"))
    given = with_seeds(store, put_sampling_inputs(store), num_seeds=1, num_grown=20, num_filled=15)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules["tasks.chains.plan"], "_STARTS_OF_A_SHARD", 12)
        yield store, given, run(chains.plan(given, ChainsParameters(**REPAIR)), chains, store)


def test_every_grown_and_filled_pair_is_repaired_once(repaired: Any) -> None:
    store, given, made = repaired
    assert [manifest.name for manifest in made] == ["grown0", "grown12", "filled0", "filled12"]
    draws = read_draw_sets(store, [manifest.ref for manifest in (*made, *given.of("seeds")[1:])])
    assert set(draws) == {"ic_repaired", GROWN, FILLED}
    starts = np.concatenate([draws[GROWN].pairs_m, draws[FILLED].pairs_m]).astype(np.float64)
    is_possible = seed_quality(starts, JointLimits.published()).is_possible
    found = draws["ic_repaired"].pairs_m.astype(np.float64)
    assert len(found) == is_possible.sum() > 20
    moved_m = np.linalg.norm(found - starts[is_possible], axis=-1).mean(axis=(1, 2))
    assert 0.001 < moved_m.mean() < 0.1
    assert judged(made[0]).count == 12
    firsts = [int(store.read(manifest.ref, "draws")["seed_index"][0]) for manifest in made]
    assert [manifest.facts["seed_index"] for manifest in made] == firsts
    table = store.read(made[0].ref, "draws")
    pair = pair_of_draw(store, f"draws@{made[0].ref.key}#3").pair.pair_m
    np.testing.assert_allclose(pair, table["pair17_m"][3], atol=1e-5)
    assert table["sequence_id"][3].startswith("one/")


def test_more_plausible_than_before_and_as_near_to_the_annotations(repaired: Any) -> None:
    store, given, made = repaired
    grown = store.read(given.of("seeds")[1].ref, "seeds")
    table = store.read(made[0].ref, "draws")
    rows = np.searchsorted(np.asarray(grown["seed_index"]), np.asarray(table["seed_index"]))
    assert np.mean(table["log_prior"]) > np.mean(np.asarray(grown["log_prior"])[rows])


def test_what_a_pair_becomes_hangs_on_no_other_shard(repaired: Any) -> None:
    _, given, made = repaired
    again = chains.plan(given, ChainsParameters(**REPAIR))
    assert [shard.key for shard in again] == [manifest.ref.key for manifest in made]
    wider = chains.plan(given, ChainsParameters(**REPAIR, repair_sigma_p=1.0))
    assert not {shard.key for shard in again} & {shard.key for shard in wider}


def test_of_a_study_with_repaired_pairs_only_those_are_selected_as_independent_ones(repaired: Any) -> None:
    store, given, made = repaired
    drawn = run_chains(store, given, num_chains=1, densities=("ic",), starts="seeds")
    selected = select_pairs(store, tuple(manifest.ref for manifest in (*drawn, *made, *given.of("seeds"))), 30)
    assert set(selected.columns["origin"]) == {"repaired"}
    (kept,) = read_draw_sets(store, [manifest.ref for manifest in made]).values()
    pairs = kept.pairs_m.astype(np.float64)
    assert (selected.num_draws, selected.num_grown, selected.num_repaired) == (0, 0, len(pairs))
    assert f" of {len(pairs)} repaired pairs, " in selected.in_words()
    log_prior = np.concatenate([store.read(manifest.ref, "draws")["log_prior"] for manifest in made])
    pairs = pairs[log_prior >= MIN_LOG_PRIOR]
    assert len(pairs) == selected.num_plausible
    # No two of those that count alone are the same within 2 cm, whatever artifacts they are in.
    assert selected.num_independent == PairSelector(1, min_room=len(pairs)).add(pairs, np.ones(len(pairs))).sum()


def test_every_shard_learns_its_scales_with_numbers_of_its_own(repaired: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    store, given, made = repaired
    states = set()

    def learn(targets: Any, rng: np.random.Generator) -> Any:
        states.add(str(rng.bit_generator.state))
        return learn_scales(targets, rng)

    monkeypatch.setattr(sys.modules["tasks.chains.run"], "learn_scales", learn)
    run(chains.plan(given, ChainsParameters(**REPAIR)), chains, store)
    assert len(states) == len(made)


def test_repaired_pairs_are_counted_apart_from_the_draws_of_chains(repaired: Any) -> None:
    store, given, made = repaired
    drawn = run_chains(store, given, num_chains=1, densities=("ic",), starts="seeds")
    (alone,) = summary_of(drawn).made
    draws, others = summary_of([*drawn, *made]).made
    assert draws == alone
    assert alone.independent is not None
    assert (others.thing, others.independent) == ("repaired pairs", None)
    assert others.count == sum(manifest.tables["draws"].rows for manifest in made)


def test_nothing_is_repaired_where_nothing_grows(inputs: Any) -> None:
    store, tables = inputs
    with pytest.raises(InputError, match=r"starts is every, but no pairs grow to start from: say seeds\.num_grown"):
        chains.plan(with_seeds(store, tables, num_seeds=1), ChainsParameters(**REPAIR))
