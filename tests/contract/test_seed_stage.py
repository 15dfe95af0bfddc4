"""The stage `seeds` keeps its promises over a real store."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store
from tasks import priors, seeds
from tasks.priors import PriorsParameters
from tasks.seeds import SeedFrame, SeedsParameters
from tasks.stage import StageInputs
from tests.builders.ingest_runs import judged
from tests.builders.sampling_store import pairs_of, put, run, with_seeds


def test_seeds_come_from_pair_takes_that_are_not_held_out(inputs: Any) -> None:
    store, tables = inputs
    made = with_seeds(store, tables, num_seeds=3).of("seeds")
    assert [manifest.facts["seed_index"] for manifest in made] == [0, 1, 2]
    assert {manifest.facts["take_id"] for manifest in made} == {"one", "two"}
    assert all(manifest.facts["takes"] == ["one", "two"] for manifest in made)


def test_named_frames_become_seeds_and_unknown_ones_are_refused(inputs: Any) -> None:
    store, tables = inputs
    made = with_seeds(store, tables, frames=[SeedFrame(take="two", frame=7)]).of("seeds")
    table = store.read(made[0].ref, "seeds")
    assert (table["take_id"][0], table["take_frame"][0]) == ("two", 7)
    expected = pairs_of("two")[7].astype(np.float32)
    got = np.asarray(table["pair17_m"][0])
    np.testing.assert_allclose(
        np.linalg.norm(got[0] - got[1], axis=-1), np.linalg.norm(expected[0] - expected[1], axis=-1), atol=1e-5
    )
    for frame, message in (
        (SeedFrame(take="kept_back", frame=1), "known ones: one, two"),
        (SeedFrame(take="one", frame=40), "frames 0 to 39"),
    ):
        with pytest.raises(InputError, match=message):
            seeds.plan(StageInputs(tables, seed=1), SeedsParameters(frames=[frame]))


def test_asking_for_more_seeds_keeps_the_first(inputs: Any) -> None:
    _, tables = inputs
    few = seeds.plan(StageInputs(tables, seed=1), SeedsParameters(num_seeds=2))
    more = seeds.plan(StageInputs(tables, seed=1), SeedsParameters(num_seeds=4))
    assert [shard.key for shard in few] == [shard.key for shard in more[:2]]


def test_seeds_grow_over_the_annotations_with_their_lineage(inputs: Any) -> None:
    store, tables = inputs
    made = with_seeds(store, tables, num_seeds=2, num_grown=30, num_starts=3).of("seeds")
    assert [manifest.facts["kind"] for manifest in made] == ["seed", "seed", "grown_seeds"]
    facts = made[-1].facts
    table = store.read(made[-1].ref, "seeds")
    assert table.num_rows == facts["num_grown"]
    assert 20 < table.num_rows <= 30
    assert facts["takes"] == ["one", "two"]
    assert facts["num_annotations_skipped"] == 0
    assert not any(sequence.startswith("kept_back") for sequence in table["sequence_id"])
    index, parent = np.asarray(table["seed_index"]), np.asarray(table["parent_seed_index"])
    np.testing.assert_array_equal(index, 2 + np.arange(table.num_rows))
    assert (parent < index).all()
    generation = dict(zip(index.tolist(), np.asarray(table["generation"]).tolist(), strict=True))
    assert all(generation[row] == generation.get(above, 0) + 1 for row, above in zip(index, parent, strict=True))
    assert set(facts["starts"]) <= set(index.tolist())
    assert np.isfinite(np.asarray(table["log_prior"])).all()
    verdict = judged(made[-1])
    assert (verdict.level, verdict.value, verdict.count) == (Level.PASS, 100.0 * table.num_rows / 30, 30)


def test_pairs_are_filled_in_between_grown_ones_with_their_parents(inputs: Any) -> None:
    store, tables = inputs
    made = with_seeds(store, tables, num_seeds=2, num_grown=30, num_filled=40).of("seeds")
    assert [manifest.facts["kind"] for manifest in made] == ["seed", "seed", "grown_seeds", "filled_seeds"]
    grown, filled = (store.read(manifest.ref, "seeds") for manifest in made[-2:])
    assert filled.num_rows == made[-1].facts["num_grown"] > 0
    assert set(filled["origin"]) == {"filled"}
    np.testing.assert_array_equal(np.asarray(filled["seed_index"]), 2 + 30 + np.arange(filled.num_rows))
    parents, weights = np.asarray(filled["filled_from"]), np.asarray(filled["filled_weight"])
    assert set(parents.ravel()) <= set(np.asarray(grown["seed_index"]).tolist())
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    row = np.asarray(grown["seed_index"]).tolist().index(parents[0, 0])
    assert filled["sequence_id"][0] == grown["sequence_id"][row]
    assert made[-1].facts["takes"] == made[-2].facts["takes"]
    assert (np.asarray(grown["filled_from"]) == -1).all()
    # Grown pairs stay as they were, and so do the first filled ones, however many are asked for.
    again = with_seeds(store, tables, num_seeds=2, num_grown=30, num_filled=10).of("seeds")
    assert again[-2].ref == made[-2].ref
    np.testing.assert_array_equal(store.read(again[-1].ref, "seeds")["pair17_m"], filled["pair17_m"][:10])


def test_nothing_is_filled_in_between_too_few_pairs(inputs: Any) -> None:
    store, tables = inputs
    (*_, made) = with_seeds(store, tables, num_seeds=1, num_grown=4, num_filled=5).of("seeds")
    verdict = judged(made)
    assert (verdict.level, verdict.value, store.read(made.ref, "seeds").num_rows) == (Level.WARN, 0.0, 0)


def test_pairs_are_not_filled_in_where_none_grow(inputs: Any) -> None:
    store, tables = inputs
    with pytest.raises(InputError, match=r"num_filled is 5, but none are grown here: say seeds\.num_grown"):
        with_seeds(store, tables, num_seeds=1, num_filled=5)


def _one_inside_the_other(store: Store, take: Manifest) -> Manifest:
    """Return a take whose second person stands where the first does."""

    def moved(pairs: np.ndarray) -> np.ndarray:
        return np.concatenate([pairs[:1], pairs[:1] + np.array([0.05, 0.0, 0.05])])

    return _changed(store, take, "inside", moved)


def _changed(store: Store, take: Manifest, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Manifest:
    """Return a take whose positions (person, frame, 17, 3) are others."""
    table = store.read(take.ref, "poses")
    columns = {column: np.array(table[column]) for column in table.column_names}
    positions = columns["pair17_m"].astype(np.float64)
    columns["pair17_m"] = change(positions.reshape(2, -1, 17, 3)).reshape(positions.shape).astype(np.float32)
    return put(store, "ingest", f"{take.partition}_{name}", {"poses": columns}, take.facts)


@pytest.mark.parametrize(
    "asked",
    [
        {"num_seeds": 1},
        {"frames": [SeedFrame(take="one", frame=7)]},
        {"num_seeds": 1, "num_grown": 10, "num_starts": 1},
        {"num_seeds": 0, "num_lifted": 6},
    ],
    ids=["chosen", "named", "grown", "lifted"],
)
def test_the_weights_of_the_prior_that_a_study_chooses_reach_its_seeds(inputs: Any, asked: dict[str, Any]) -> None:
    store, tables = inputs
    limits = JointLimits.published()
    tables = {**tables, "poses": [_one_inside_the_other(store, take) for take in tables["poses"][:1]]}
    for changed in ({}, {"alpha": 1e4}, {"sigma_p_m": 0.02}):
        made = with_seeds(store, tables, **changed, **asked).of("seeds")
        table = store.read(made[-1].ref, "seeds")
        pairs = np.asarray(table["pair17_m"])
        chosen, default = (
            seed_quality(pairs, limits, prior).log_prior for prior in (PriorSettings(**changed), PriorSettings())
        )
        np.testing.assert_allclose(table["log_prior"], chosen, rtol=1e-9, atol=1e-12)
        assert (not changed) == np.allclose(table["log_prior"], default)


def test_the_number_of_invalid_angles_that_a_study_allows_decides_whether_a_seed_can_start_chains(inputs: Any) -> None:
    store, tables = inputs
    mirrored = _changed(store, tables["poses"][0], "mirrored", lambda pairs: pairs * np.array([-1.0, 1.0, 1.0]))
    frames = [SeedFrame(take="one", frame=3)]
    strict, loose = (
        judged(
            with_seeds(store, {**tables, "poses": [mirrored]}, frames=frames, max_invalid_angles=count).of("seeds")[-1]
        )
        for count in (0, 58)
    )
    assert (strict.level, loose.level) == (Level.FAIL, Level.PASS)
    assert "at most 0 may be: no chain can start here" in strict.reason


@pytest.mark.parametrize(
    ("farthest_m", "asked", "level", "num_grown"),
    [(1e-6, {"num_seeds": 1}, Level.WARN, 1), (1e-12, {"frames": [SeedFrame(take="two", frame=7)]}, Level.FAIL, 0)],
)
def test_growth_that_hardly_reaches_anything_is_warned_of_and_has_failed_where_it_reaches_nothing(
    inputs: Any, monkeypatch: pytest.MonkeyPatch, farthest_m: float, asked: dict[str, Any], level: Level, num_grown: int
) -> None:
    store, tables = inputs
    monkeypatch.setattr("pasdedeux.sampling.growth.FARTHEST_M", farthest_m)
    verdict = judged(with_seeds(store, tables, **asked, num_grown=30).of("seeds")[-1])
    assert verdict.level is level
    assert f"{num_grown} of 30 pairs grew" in verdict.reason
    assert "lie farther than 0.25 m" in verdict.reason


def test_seeds_asked_of_annotations_that_are_not_there_are_refused() -> None:
    with pytest.raises(InputError, match="there are no annotated pairs with views"):
        seeds.plan(StageInputs({}, seed=1), SeedsParameters(num_seeds=0, num_lifted=2))


def test_lifted_seeds_never_see_a_torso_basis_of_their_own_takes(inputs: Any) -> None:
    """Joint limits may come from such takes: they are in the same artifact as the basis."""
    store, tables = inputs
    take = tables["poses"][0]
    table = store.read(take.ref, "poses")
    columns = {name: table[name] for name in table.column_names}
    prior_take = put(store, "ingest", "prior", {"poses": columns}, {**take.facts, "is_prior": True})
    (learned,) = run(priors.plan(StageInputs({"poses": [prior_take]}, seed=1), PriorsParameters()), priors, store)
    asked = SeedsParameters(num_seeds=0, num_lifted=2, num_grown=0)
    (shard,) = seeds.plan(StageInputs({**tables, "joint_limits": [learned], "torso_basis": [learned]}, seed=1), asked)
    assert (shard.refs("joint_limits"), shard.refs("torso_basis")) == ((learned.ref,), ())
    # The same joint limits from an artifact that holds no basis at all.
    limits = store.read(learned.ref, "joint_limits")
    alone = {"joint_limits": {name: limits[name] for name in limits.column_names}}
    bare = put(store, "priors", "bare", alone, {"takes": ["one"]})
    (plain,) = seeds.plan(StageInputs({**tables, "joint_limits": [bare]}, seed=1), asked)
    pairs = [store.read(seeds.run_shard(planned, store), "seeds")["pair17_m"] for planned in (shard, plain)]
    np.testing.assert_array_equal(*pairs)


def test_seeds_are_lifted_from_2d_alone_and_grow(inputs: Any) -> None:
    store, tables = inputs
    without_poses = {name: part for name, part in tables.items() if name != "poses"}
    asked = {"num_seeds": 0, "num_lifted": 2, "num_grown": 10, "num_starts": 1}
    made = with_seeds(store, without_poses, **asked).of("seeds")
    assert [manifest.facts["kind"] for manifest in made] == ["lifted_seeds", "grown_seeds"]
    lifted, grown = (store.read(manifest.ref, "seeds") for manifest in made)
    assert list(lifted["seed_index"]) == made[0].facts["starts"] == [0, 1]
    assert set(lifted["origin"]) == {"lifted"}
    assert grown["seed_index"][0] == 2
    assert made[0].facts["takes"] == ["one"]
    with pytest.raises(ValueError, match="at least one seed"):
        SeedsParameters(num_seeds=0, num_lifted=0)


def test_more_starts_than_grown_seeds_are_refused(inputs: Any) -> None:
    with pytest.raises(ValueError, match="only 3 are grown"):
        SeedsParameters(num_grown=3, num_starts=4)
    with pytest.raises(InputError, match="num_starts is 4, but 0 are grown here"):
        seeds.plan(StageInputs(inputs[1], seed=1), SeedsParameters(num_starts=4))
