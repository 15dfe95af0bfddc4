"""The stages `seeds` and `chains` keep their promises over a real store."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras import project_pair
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling import PairChart, PairDensity, PhysicalPrior, kernel_from_json
from pasdedeux.sampling.synthetic import random_pairs
from storage_schema import Manifest, SourceCredit, Store, artifact_key
from tasks import chain_problem, chains, seeds
from tasks.chains import ChainsParameters
from tasks.evaluation import density
from tasks.seeds import SeedFrame, SeedsParameters
from tasks.stage import Shard, StageInputs

NUM_FRAMES = 40


def put(
    store: Store,
    stage: str,
    name: str,
    tables: dict[str, Any],
    facts: dict[str, Any],
    inputs: tuple[Manifest, ...] = (),
) -> Manifest:
    """Commit what an earlier stage would have written."""
    ref = store.commit(
        stage=stage,
        key=artifact_key(stage=stage, version=1, parameters={"name": name}, input_digests=[], seed=0),
        partition=name,
        name=name,
        version=1,
        parameters={"name": name},
        seed=0,
        inputs=[manifest.ref for manifest in inputs],
        files=[],
        tables=tables,
        facts=facts,
        sources=[SourceCredit("pairs", "CC0", "made up for tests")],
    )
    return store.manifest(ref)


def pairs_of(take_id: str) -> np.ndarray:
    return random_pairs(np.random.default_rng(sum(map(ord, take_id))), NUM_FRAMES, spread_rad=0.1)


def put_take(store: Store, take_id: str, *, is_held_out: bool = False, num_persons: int = 2) -> Manifest:
    pairs = pairs_of(take_id)[:, :num_persons]
    count = num_persons * NUM_FRAMES
    columns = {
        "take_id": [take_id] * count,
        "person": np.repeat(np.arange(num_persons), NUM_FRAMES),
        "frame": np.tile(np.arange(NUM_FRAMES), num_persons),
        "time_s": np.tile(np.arange(NUM_FRAMES), num_persons) / 30.0,
        "root_translation_m": np.zeros((count, 3)),
        "local_unitquat": [np.zeros(4)] * count,
        "pair17_m": np.moveaxis(pairs, 1, 0).reshape(count, 17, 3),
        "op14_m": np.zeros((count, 14, 3)),
        "body22_m": np.zeros((count, 22, 3)),
        "body22_world_unitquat": np.zeros((count, 22, 4)),
    }
    facts = {
        "kind": "take",
        "take_id": take_id,
        "takes": [take_id],
        "num_persons": num_persons,
        "num_frames": NUM_FRAMES,
        "rate_hz": 30.0,
        "is_held_out": is_held_out,
    }
    return put(store, "ingest", take_id, {"poses": columns}, facts)


def put_annotations(
    store: Store, take_id: str, *, is_held_out: bool = False, spoil: Callable[[np.ndarray], None] = lambda _: None
) -> tuple[Manifest, Manifest]:
    """Commit annotations of a take from random views, one with a missing joint, each with the frames next to it.

    `spoil` changes the pixels (annotation, frame, person, joint, 2) in place; the annotated frame is the middle one.
    """
    rng = np.random.default_rng(5)
    pairs = pairs_of(take_id)
    directions = normalise(rng.normal(size=(NUM_FRAMES, 3)) * [1.0, 0.2, 1.0])
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
    }
    facts = {"kind": "sequences", "takes": [take_id], "is_held_out": is_held_out, "num_persons": 2}
    annotations = put(
        store, "ingest", f"{take_id}-views", {"annotations": columns}, {**facts, "purpose": "random_views"}
    )
    views = {
        "sequence_id": sequence,
        "frame": np.zeros(NUM_FRAMES, dtype=int),
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


@pytest.fixture
def inputs(tmp_path: Path) -> tuple[Store, dict[str, list[Manifest]]]:
    store = Store(tmp_path / "store")
    poses = [put_take(store, "one"), put_take(store, "two"), put_take(store, "kept_back", is_held_out=True)]
    poses.append(put_take(store, "single", num_persons=1))
    annotations, views = put_annotations(store, "one")
    hidden_annotations, hidden_views = put_annotations(store, "kept_back", is_held_out=True)
    return store, {
        "poses": poses,
        "annotations": [annotations, hidden_annotations],
        "views": [views, hidden_views],
    }


def run(shards: list[Shard], module: Any, store: Store) -> list[Manifest]:
    return [store.manifest(module.run_shard(shard, store)) for shard in shards]


def with_seeds(store: Store, tables: dict[str, list[Manifest]], **parameters: Any) -> StageInputs:
    planned = seeds.plan(StageInputs(tables, seed=1), SeedsParameters(**parameters))
    return StageInputs({**tables, "seeds": run(planned, seeds, store)}, seed=1)


QUICK = {"num_draws": 8, "segment_draws": 4, "thin": 3, "num_views": 4, "num_warm_up": 2}


def draws_of(manifests: list[Manifest], store: Store) -> dict[tuple[str, int, int, int], np.ndarray]:
    rows = {}
    for manifest in manifests:
        if "draws" in manifest.tables:
            table = store.read(manifest.ref, "draws")
            for row in range(table.num_rows):
                place = tuple(table[name][row] for name in ("density", "seed_index", "chain", "draw"))
                rows[place] = table["parameters"][row]
    return rows


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
    assert facts["num_annotations_skipped"] == 1
    assert not any(sequence.startswith("kept_back") for sequence in table["sequence_id"])
    index, parent = np.asarray(table["seed_index"]), np.asarray(table["parent_seed_index"])
    np.testing.assert_array_equal(index, 2 + np.arange(table.num_rows))
    assert (parent < index).all()
    generation = dict(zip(index.tolist(), np.asarray(table["generation"]).tolist(), strict=True))
    assert all(generation[row] == generation.get(above, 0) + 1 for row, above in zip(index, parent, strict=True))
    assert set(facts["starts"]) <= set(index.tolist())
    assert np.isfinite(np.asarray(table["log_prior"])).all()


def test_chains_start_from_some_of_the_grown_seeds(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=2)
    options = {**QUICK, "num_chains": 1, "densities": ("ic",)}
    planned = chains.plan(given, ChainsParameters(**options))
    starts = given.of("seeds")[-1].facts["starts"]
    assert (
        starts == with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=5).of("seeds")[-1].facts["starts"][:2]
    )
    assert [shard.parameters["seed_index"] for shard in planned if shard.name == "summary"] == [0, *starts]
    of_grown = [shard for shard in planned if shard.parameters["seed_index"] == starts[0]]
    made = run(of_grown, chains, store)
    draws = store.read(made[0].ref, "draws")
    table = store.read(given.of("seeds")[-1].ref, "seeds")
    row = np.asarray(table["seed_index"]).tolist().index(starts[0])
    start, seed = np.asarray(draws["pair17_m"][0], dtype=np.float64), np.asarray(table["pair17_m"][row])
    assert np.linalg.norm(start - seed, axis=-1).mean() < 0.1
    assert draws["take_id"][0] is None


@pytest.mark.parametrize("density", ["cartesian", "shape_context", "agreement"])
def test_every_density_is_sampled_from_what_it_needs(inputs: Any, density: str) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20)
    planned = chains.plan(given, ChainsParameters(**{**QUICK, "num_chains": 1, "densities": (density,)}))
    made = run(planned, chains, store)
    draws = store.read(made[0].ref, "draws")
    logs = np.asarray(draws["log_likelihood"])
    assert np.isfinite(logs).all()
    assert (logs <= 1e-9).all()
    assert set(draws["density"]) == {density}
    read = {table for ref in made[0].inputs for table in store.manifest(ref).tables}
    assert ("annotations" in read) == (density != "agreement")


def test_agreement_without_grown_seeds_is_refused_alone_and_left_out_beside_others(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    with pytest.raises(InputError, match="grown seeds"):
        chains.plan(given, ChainsParameters(**{**QUICK, "densities": ("agreement",)}))
    planned = chains.plan(given, ChainsParameters(**{**QUICK, "densities": ("prior_only", "agreement")}))
    assert {shard.parameters["density"] for shard in planned} == {"prior_only"}


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
        SeedsParameters(num_seeds=0)


def test_more_starts_than_grown_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="only 3 are grown"):
        SeedsParameters(num_grown=3, num_starts=4)


def test_terms_of_the_density_are_judged_on_takes_that_are_held_out(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=10)
    assert density.shards(given, num_judged_pairs=0) == []
    (shard,) = density.shards(given, num_judged_pairs=4)
    hidden = {manifest.ref for manifest in tables["annotations"] if manifest.facts["is_held_out"]}
    assert not hidden.intersection(shard.inputs)
    scores = density.run(shard, store).scores
    assert all(np.isfinite(score.value) and -1.0 <= score.value <= 1.0 for score in scores)
    assert {"auc_depth_mirrored", "rank_correlation_with_nearest_real"} <= {score.metric for score in scores}
    assert {"likelihood", "prior", "grown_D_I"} <= {score.method for score in scores}


def test_chains_write_draws_states_and_a_summary(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables)
    planned = chains.plan(given, ChainsParameters(**QUICK))
    assert len(planned) == 2 * 2 * (2 * 2 + 1)
    made = run(planned, chains, store)
    assert len(draws_of(made, store)) == 2 * 2 * 2 * 8
    summaries = [manifest for manifest in made if "chain_info" in manifest.tables]
    assert len(summaries) == 4
    for manifest in summaries:
        info = store.read(manifest.ref, "chain_info")
        assert list(info["num_draws"]) == [8, 8]
        assert ((np.asarray(info["acceptance_rate"]) > 0) & (np.asarray(info["acceptance_rate"]) <= 1)).all()
        assert set(info["verdict"]) <= {"ok", "stuck", "left_range"}


def test_held_out_annotations_never_enter_a_chain(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables)
    planned = chains.plan(given, ChainsParameters(**QUICK))
    hidden = {manifest.ref for manifest in (*tables["annotations"], *tables["views"]) if manifest.facts["is_held_out"]}
    assert not any(hidden.intersection(shard.inputs) for shard in planned)
    made = run(planned[:1], chains, store)
    assert made[0].facts["takes"] == ["one", "two"]
    assert made[0].facts["num_annotations_skipped"] == 1


def test_more_draws_and_chains_extend_and_never_recompute(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    few = {shard.key for shard in chains.plan(given, ChainsParameters(**QUICK)) if shard.name != "summary"}
    more = {**QUICK, "num_draws": 16, "num_chains": 3}
    assert few < {shard.key for shard in chains.plan(given, ChainsParameters(**more))}


def test_prior_only_does_not_depend_on_annotations_or_the_likelihood(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    options = {**QUICK, "densities": ("prior_only",)}
    base = [shard.key for shard in chains.plan(given, ChainsParameters(**options))]
    other = StageInputs({**given.manifests, "annotations": [], "views": []}, seed=1)
    changed = ChainsParameters(**{**options, "num_views": 7, "sigma_l": 0.02})
    assert [shard.key for shard in chains.plan(other, changed)] == base


ALL_MOVES = {"few": 2.0, "limb": 1.0, "person": 1.0, "roots": 1.0}


@pytest.mark.parametrize(
    "options",
    [
        {"num_warm_up": 0},
        {
            "kernel": "velocity",
            "moves": ALL_MOVES,
            "num_warm_up": 6,
            "guided_share": 0.5,
            "joint_limits": "learned",
            "reference": "left_out",
        },
    ],
    ids=["plain", "everything"],
)
def test_segments_continue_exactly_and_order_of_chains_does_not_matter(inputs: Any, options: dict[str, Any]) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    short = chains.plan(given, ChainsParameters(**{**QUICK, **options}))
    long = chains.plan(given, ChainsParameters(**{**QUICK, **options, "segment_draws": 8}))
    first = draws_of(run(short, chains, store), store)
    second = draws_of(run(long, chains, store), store)
    assert first.keys() == second.keys()
    for place, parameters in first.items():
        np.testing.assert_array_equal(parameters, second[place])
    by_chain = sorted((s for s in short if s.name != "summary"), key=lambda s: (-s.parameters["chain"], s.name))
    digests = {shard.key: store.find("chains", shard.key).ref.content_digest for shard in by_chain}
    for shard in by_chain:
        store.discard(store.find("chains", shard.key).ref)
    chain_problem._KEPT.clear()
    for shard in by_chain:
        assert chains.run_shard(shard, store).content_digest == digests[shard.key]


def test_log_density_recomputed_from_stored_draws_is_the_stored_one(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    planned = [s for s in chains.plan(given, ChainsParameters(**QUICK)) if s.name == "chain0-segment0"]
    for shard in planned:
        table = store.read(chains.run_shard(shard, store), "draws")
        chart = PairChart(np.asarray(store.read(shard.inputs[0], "seeds")["pair17_m"][0]))
        is_full = shard.parameters["density"] == "ic"
        likelihood = chain_problem.look_at_annotations(shard, store).likelihood if is_full else None
        density = PairDensity(chart, PhysicalPrior(chart, JointLimits.published()), likelihood)
        for row in range(table.num_rows):
            evaluation = density(np.asarray(table["parameters"][row]))
            assert evaluation.log_density == pytest.approx(table["log_density"][row], rel=1e-9, abs=1e-9)
            assert evaluation.log_prior == pytest.approx(table["log_prior"][row], rel=1e-9, abs=1e-9)
            assert evaluation.log_likelihood == pytest.approx(table["log_likelihood"][row], rel=1e-9, abs=1e-9)
            positions = chart.positions(np.asarray(table["parameters"][row]))
            np.testing.assert_allclose(table["pair17_m"][row], positions, atol=1e-6)


def test_warm_up_learns_scales_that_every_later_segment_keeps(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    options = {**QUICK, "kernel": "velocity", "moves": ALL_MOVES, "num_warm_up": 20, "num_chains": 1}
    made = run(chains.plan(given, ChainsParameters(**options)), chains, store)
    states = [store.read(one.ref, "chain_states") for one in made if "chain_states" in one.tables]
    for first, second in zip(states[::2], states[1::2], strict=True):
        kernels = [kernel_from_json(str(one["kernel_state"][0]))[0] for one in (first, second)]
        assert np.count_nonzero(kernels[0].log_block) > 10
        np.testing.assert_array_equal(kernels[0].log_block, kernels[1].log_block)
        np.testing.assert_array_equal(kernels[0].log_move, kernels[1].log_move)
        assert list(first["num_draws"]) == [4]


def test_the_kernel_does_not_enter_the_keys_of_densities_without_annotations(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    options = {**QUICK, "densities": ("prior_only",)}
    keys = [
        [shard.key for shard in chains.plan(given, ChainsParameters(**options, kernel=kernel))]
        for kernel in ("unbiased", "velocity")
    ]
    assert keys[0] == keys[1]


def test_variants_are_sampled_beside_densities_under_their_own_names(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_starts=2)
    options = {**QUICK, "num_chains": 1, "densities": ("ic",), "starts": "seeds"}
    variants = {
        "hotter": {"sigma_l": 0.05},
        "grown_prior": {"density": "prior_only", "starts": "grown", "num_draws": 4},
    }
    base = [shard.key for shard in chains.plan(given, ChainsParameters(**options))]
    planned = chains.plan(given, ChainsParameters(**options, variants=variants))
    assert [shard.key for shard in planned[: len(base)]] == base
    made = run(planned, chains, store)
    found = draws_of(made, store)
    starts = given.of("seeds")[-1].facts["starts"]
    assert {place[:2] for place in found} == {("ic", 0), ("hotter", 0), *(("grown_prior", index) for index in starts)}
    assert sum(place[0] == "grown_prior" for place in found) == 4 * len(starts)
    assert any((found["ic", 0, 0, draw] != found["hotter", 0, 0, draw]).any() for draw in range(8))
    assert {one.facts["density"] for one in made} == {"ic", "hotter", "grown_prior"}


@pytest.mark.parametrize(
    ("variants", "message"),
    [
        ({"ic": {}}, "'ic' is no name for a variant"),
        ({"Hot": {}}, "'Hot' is no name for a variant"),
        ({"hot": {"sigma": 1.0}}, "there is no setting 'sigma' of a variant"),
        ({"hot": {"variants": {}}}, "there is no setting 'variants'"),
        ({"hot": {"sigma_l": -1.0}}, r"chains\.variants\.hot: sigma_l"),
        ({"hot": {"density": "warm"}}, r"chains\.variants\.hot: densities"),
    ],
)
def test_variants_that_cannot_be_are_refused(variants: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ChainsParameters(variants=variants)


def test_kernels_that_cannot_be_are_refused_before_anything_runs() -> None:
    with pytest.raises(ValueError, match="every kind of move the weight 0"):
        ChainsParameters(moves={"few": 0.0})
    with pytest.raises(ValueError, match="needs positive root_rotation_rad"):
        ChainsParameters(kernel="velocity", root_position_m=0.0)


def test_no_views_means_no_chains_of_the_full_density(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, {"poses": tables["poses"]}, num_seeds=1)
    planned = chains.plan(given, ChainsParameters(**QUICK))
    assert {shard.parameters["density"] for shard in planned} == {"prior_only"}


def test_a_missing_segment_is_named(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1)
    later = next(s for s in chains.plan(given, ChainsParameters(**QUICK)) if s.name == "chain0-segment1")
    with pytest.raises(InputError, match="is not in the store"):
        chains.run_shard(later, store)
