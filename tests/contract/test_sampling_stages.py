"""The stage `chains` keeps its promises over a real store."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.frames import project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity, interaction_dissimilarity
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.chain import proposal_from_json
from pasdedeux.sampling.densities.density import PairDensity, PriorOnly
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.verdict import Level
from storage_schema import Store
from tasks import chains
from tasks.chains import ChainSegmentParameters, ChainsParameters
from tasks.chains.run import chain_problem
from tasks.rows.annotated_pairs import gather, gather_tracks
from tasks.stage import StageInputs
from tests.builders.ingest_runs import judged
from tests.builders.sampling_store import draws_of, plan_chains, run, run_chains, with_seeds
from tests.builders.storage_rows import having, put


@pytest.fixture
def seeded(inputs: Any) -> tuple[Store, StageInputs]:
    """Return the store and what chains read of it, with one seed."""
    store, tables = inputs
    return store, with_seeds(store, tables, num_seeds=1)


def test_chains_start_from_some_of_the_grown_seeds(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=2)
    planned = plan_chains(given, num_chains=1, densities=("ic",))
    starts = given.of("seeds")[-1].facts["starts"]
    assert (
        starts == with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=5).of("seeds")[-1].facts["starts"][:2]
    )
    assert [shard.parameters.seed_index for shard in planned if shard.name == "summary"] == [0, *starts]
    of_grown = [shard for shard in planned if shard.parameters.seed_index == starts[0]]
    made = run(of_grown, chains, store)
    draws = store.read(made[0].ref, "draws")
    table = store.read(given.of("seeds")[-1].ref, "seeds")
    row = np.asarray(table["seed_index"]).tolist().index(starts[0])
    start, seed = np.asarray(draws["pair17_m"][0], dtype=np.float64), np.asarray(table["pair17_m"][row])
    assert np.linalg.norm(start - seed, axis=-1).mean() < 0.1
    assert draws["take_id"][0] is None


def test_chains_write_draws_states_and_a_summary(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables)
    made = run_chains(store, given)
    assert len(made) == 2 * 2 * (2 * 2 + 1)
    assert len(draws_of(made, store)) == 2 * 2 * 2 * 8
    summaries = having("chain_info", made)
    assert len(summaries) == 4
    for manifest in summaries:
        info = store.read(manifest.ref, "chain_info")
        assert list(info["num_draws"]) == [8, 8]
        assert ((np.asarray(info["acceptance_rate"]) > 0) & (np.asarray(info["acceptance_rate"]) <= 1)).all()
        assert set(info["verdict"]) == {"warn"}
        assert all("not mixed: " in reason for reason in info["reason"])
        verdict = judged(manifest)
        assert (verdict.level, verdict.figure, verdict.count) == (Level.WARN, "effective sample size", 2)


def test_every_draw_keeps_the_annotation_it_is_nearest_to(seeded: Any) -> None:
    store, given = seeded
    for shard in (shard for shard in plan_chains(given) if shard.name == "chain1-segment0"):
        options = shard.options(ChainSegmentParameters)
        table = store.read(chains.run_shard(shard, store), "draws")
        likelihood = chain_problem(shard, options, store).evidence.likelihood
        if likelihood.sigma_l is None:
            assert table.is_null("sequence_id").all()
            assert np.isnan(np.asarray(table["dissimilarity_m"])).all()
            continue
        chart = PairChart(np.asarray(store.read(shard.ref("seed"), "seeds")["pair17_m"][0]))
        placed = gather(store, annotations=shard.refs("annotations"), views=shard.refs("views"), num_hypotheses=4)
        for row in range(table.num_rows):
            pair = chart.positions(np.asarray(table["parameters"][row]))
            place = (str(table["sequence_id"][row]), int(table["sequence_frame"][row]))
            index = next(at for at, seen in enumerate(placed.places) if (seen.sequence_id, seen.frame) == place)
            is_it = placed.gathered.pairs.annotation_index == index
            shown = placed.gathered.pairs.points_m[is_it][0].reshape(-1, 2)
            seen = np.isfinite(shown).all(axis=1)
            image = project_pair(pair, np.asarray(table["view"][row])[None]).reshape(-1, 2)
            distance = table["dissimilarity_m"][row]
            if seen.all():
                assert interaction_dissimilarity(image, shown) == pytest.approx(distance, rel=1e-6)
            # The mean over the views is at most the best of them.
            assert table["log_likelihood"][row] <= -distance / (2.0 * likelihood.sigma_l**2) + 1e-6


def test_chains_of_a_seed_start_apart_unless_they_are_told_not_to(seeded: Any) -> None:
    store, given = seeded
    apart = {}
    for count in (0, 30):
        planned = plan_chains(given, num_warm_up=0, densities=("ic",), num_dispersing=count)
        begun = [chains.run_shard(shard, store) for shard in planned if shard.name.endswith("segment0")]
        first, second = (store.read(ref, "draws")["pair17_m"][0] for ref in begun)
        apart[count] = cartesian_dissimilarity(first.reshape(-1, 3), second.reshape(-1, 3))
    assert apart[30] > 2.0 * apart[0]


def test_held_out_annotations_never_enter_a_chain(inputs: Any) -> None:
    store, tables = inputs
    planned = plan_chains(with_seeds(store, tables))
    hidden = {manifest.ref for manifest in (*tables["annotations"], *tables["views"]) if manifest.facts["is_held_out"]}
    assert not any(hidden.intersection(shard.all_inputs) for shard in planned)
    made = run(planned[:1], chains, store)
    assert made[0].facts["takes"] == ["one", "two"]
    assert made[0].facts["num_annotations_skipped"] == 0


def test_images_that_are_left_out_never_enter_a_chain(inputs: Any) -> None:
    store, tables = inputs
    annotations, views = tables["annotations"][0], tables["views"][0]
    rows = store.read(annotations.ref, "annotations")
    out = ["one/view00003", "one/view00007"]
    columns = {name: rows[name] for name in rows.column_names}
    columns["is_held_out"] = np.isin(np.array(list(rows["sequence_id"])), out)
    cut = put(store, "ingest", "cut", {"annotations": columns}, dict(annotations.facts))
    whole, left = (
        gather(store, annotations=[manifest.ref], views=[views.ref], num_hypotheses=1)
        for manifest in (annotations, cut)
    )
    assert {place.sequence_id for place in set(whole.places) - set(left.places)} == set(out)
    assert not {place.sequence_id for place in left.frames}.intersection(out)


def test_stills_numbered_like_a_video_have_no_speed(inputs: Any) -> None:
    store, tables = inputs
    refs = {name: [tables[name][0].ref] for name in ("annotations", "views")}
    placed = gather(store, **refs, num_hypotheses=1)
    name = placed.places[7].sequence_id
    stills = gather_tracks(replace(placed, stills=frozenset([name])))
    moving = gather_tracks(placed)
    of_stills = np.array([placed.places[index].sequence_id == name for index in placed.gathered.pairs.annotation_index])
    assert np.isnan(stills[of_stills][:, [0, 1, 3, 4]]).all()
    np.testing.assert_array_equal(stills[of_stills][:, 2], moving[of_stills][:, 2])
    np.testing.assert_array_equal(stills[~of_stills], moving[~of_stills])
    assert np.isfinite(moving[of_stills][:, [1, 3]]).all()


def test_more_draws_and_chains_extend_and_never_recompute(seeded: Any) -> None:
    _, given = seeded
    few = {shard.key for shard in plan_chains(given) if shard.name != "summary"}
    assert few < {shard.key for shard in plan_chains(given, num_draws=16, num_chains=3)}


def test_prior_only_depends_neither_on_annotations_nor_on_likelihood_or_proposal(seeded: Any) -> None:
    _, given = seeded
    blind = StageInputs({**given.manifests, "annotations": [], "views": []}, seed=1)
    planned = [
        plan_chains(given, densities=("prior_only",), proposal="unbiased"),
        plan_chains(given, densities=("prior_only",), proposal="velocity"),
        plan_chains(blind, densities=("prior_only",), num_views=7, sigma_l=0.02),
    ]
    assert len({tuple(shard.key for shard in shards) for shards in planned}) == 1


@pytest.mark.parametrize(
    "options", [{"num_warm_up": 0}, {"proposal": "velocity", "num_warm_up": 6}], ids=["plain", "everything"]
)
def test_segments_continue_exactly_and_order_of_chains_does_not_matter(
    seeded: Any, options: dict[str, Any], tmp_path: Path
) -> None:
    store, given = seeded
    short = plan_chains(given, **options)
    first = draws_of(run(short, chains, store), store)
    second = draws_of(run_chains(store, given, **options, segment_draws=8), store)
    assert first.keys() == second.keys()
    for place, parameters in first.items():
        np.testing.assert_array_equal(parameters, second[place])
    by_chain = sorted((s for s in short if s.name != "summary"), key=lambda s: (-s.parameters.chain, s.name))
    digests = {shard.key: store.find("chains", shard.key).ref.content_digest for shard in by_chain}
    # Evidence is kept by store: in a copy it is read anew.
    again = Store(shutil.copytree(store.root, tmp_path / "again"))
    for shard in by_chain:
        again.discard(again.find("chains", shard.key).ref)
    for shard in by_chain:
        assert chains.run_shard(shard, again).content_digest == digests[shard.key]


def test_log_density_recomputed_from_stored_draws_is_the_stored_one(seeded: Any) -> None:
    store, given = seeded
    for shard in (shard for shard in plan_chains(given) if shard.name == "chain0-segment0"):
        table = store.read(chains.run_shard(shard, store), "draws")
        options = shard.options(ChainSegmentParameters)
        chart = PairChart(np.asarray(store.read(shard.ref("seed"), "seeds")["pair17_m"][0]))
        likelihood = chain_problem(shard, options, store).evidence.likelihood
        assert isinstance(likelihood, PriorOnly) == (options.density == "prior_only")
        density = PairDensity(chart, PhysicalPrior(chart, JointLimits.published()), likelihood)
        for row in range(table.num_rows):
            evaluation = density(np.asarray(table["parameters"][row]))
            for name in ("log_density", "log_prior", "log_likelihood"):
                assert getattr(evaluation, name) == pytest.approx(table[name][row], rel=1e-9, abs=1e-9)
            positions = chart.positions(np.asarray(table["parameters"][row]))
            np.testing.assert_allclose(table["pair17_m"][row], positions, atol=1e-6)


def test_warm_up_learns_scales_that_every_later_segment_keeps(seeded: Any) -> None:
    store, given = seeded
    made = run_chains(store, given, proposal="velocity", num_warm_up=20, num_chains=1)
    states = [store.read(manifest.ref, "chain_states") for manifest in having("chain_states", made)]
    for first, second in zip(states[::2], states[1::2], strict=True):
        learned = [proposal_from_json(str(state["proposal_state"][0]))[0] for state in (first, second)]
        assert np.count_nonzero(learned[0]) > 10
        np.testing.assert_array_equal(learned[0], learned[1])
        assert list(first["num_draws"]) == [4]


def test_variants_are_sampled_beside_densities_under_their_own_names(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=2)
    options: dict[str, Any] = {"num_chains": 1, "densities": ("ic",), "starts": "seeds"}
    sweep = {
        "hotter": {"sigma_l": 0.05},
        "grown_prior": {"densities": ["prior_only"], "starts": "grown", "num_draws": 4},
    }
    base = [shard.key for shard in plan_chains(given, **options)]
    planned = plan_chains(given, **options, sweep=sweep)
    assert [shard.key for shard in planned[: len(base)]] == base
    made = run(planned, chains, store)
    found = draws_of(made, store)
    starts = given.of("seeds")[-1].facts["starts"]
    assert {place[:2] for place in found} == {("ic", 0), ("hotter", 0), *(("grown_prior", index) for index in starts)}
    assert sum(place[0] == "grown_prior" for place in found) == 4 * len(starts)
    assert any((found["ic", 0, 0, draw] != found["hotter", 0, 0, draw]).any() for draw in range(8))
    assert {manifest.facts["density"] for manifest in made} == {"ic", "hotter", "grown_prior"}


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"sweep": {"ic": {}}}, "sweep"),
        ({"sweep": {"Hot": {}}}, "sweep"),
        ({"proposal": "faster"}, "there is no proposal 'faster'; there are: unbiased, velocity"),
    ],
)
def test_proposals_and_names_of_sweeps_that_cannot_be_are_refused(section: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ChainsParameters(**section)


def test_no_views_means_no_chains_of_the_full_density(inputs: Any) -> None:
    store, tables = inputs
    planned = plan_chains(with_seeds(store, {"poses": tables["poses"]}, num_seeds=1))
    assert {shard.parameters.name for shard in planned} == {"prior_only"}


def test_a_missing_segment_is_named(seeded: Any) -> None:
    store, given = seeded
    later = next(shard for shard in plan_chains(given) if shard.name == "chain0-segment1")
    with pytest.raises(InputError, match="is not in the store"):
        chains.run_shard(later, store)
