"""The stage `lifting` keeps its promises over a real store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.projections.retarget import centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store, TableData, open_table
from tasks import lifting
from tasks.evaluation import STAGE
from tasks.evaluation.lifting import TOPIC
from tasks.lifting import LiftingParameters, _baselines, _lifted_from, _spans
from tasks.rows.annotated_pairs import PairPlace, read_seen_pairs
from tasks.rows.draw_sets import GROWN, read_draw_sets, reference_to
from tasks.stage import StageInputs
from tasks.stage.facts import SeedFacts
from tests.builders.drawn_pairs import put_draws
from tests.builders.ingest_runs import judged
from tests.builders.sampling_store import pairs_of, put_sampling_inputs, run, run_chains, with_seeds
from tests.builders.storage_rows import having, put, random_columns, take_rows

VIDEO = {"purpose": "video", "rate_hz": 30.0}


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, StageInputs]:
    """Return a store and what is lifted in it; what a test commits besides needs a name of its own."""
    store = Store(tmp_path_factory.mktemp("grown"))
    return store, with_seeds(store, put_sampling_inputs(store), num_seeds=1, num_grown=30)


def lift(store: Store, given: StageInputs, **parameters: Any) -> dict[str, Manifest]:
    found = run(lifting.plan(given, LiftingParameters(**parameters)), lifting, store)
    return {manifest.partition: manifest for manifest in found}


def lifted_from(store: Store, given: StageInputs, **parameters: Any) -> TableData:
    """Return the pairs lifted from the views of take `one`."""
    return store.read(lift(store, given, **parameters)["one-views"].ref, "lifted_pairs")


def test_annotations_are_lifted_from_grown_seeds(grown: Any) -> None:
    store, given = grown
    made = lift(store, given, max_frames=6)
    assert set(made) == {"one-views", "kept_back-views"}
    facts = made["kept_back-views"].facts
    assert facts["is_held_out"]
    assert facts["learned_takes"] == ["one", "two"]
    assert facts["takes"] == ["kept_back", "one", "two"]
    table = store.read(made["one-views"].ref, "lifted_pairs")
    assert sorted(set(table["method"])) == ["fitted", "mean_pair", "nearest", "neighbours"]
    assert table.num_rows == 4 * facts["num_lifted"]
    assert np.isfinite(table["pair17_m"]).all()
    residual = {name: table["residual_m"][table["method"] == name].mean() for name in set(table["method"])}
    assert residual["fitted"] < residual["neighbours"] < residual["mean_pair"]
    verdict = judged(made["one-views"])
    assert verdict.level is Level.PASS
    assert verdict.value < verdict.baseline


def test_a_lifted_pair_names_the_draw_it_came_from(grown: Any) -> None:
    store, given = grown
    table = lifted_from(store, given, max_frames=3)
    row = list(table["method"]).index("nearest")
    lifted = np.asarray(table["pair17_m"][row], dtype=np.float64)
    draw = np.asarray(open_table(str(table["draw"][row]), store)["pair17_m"])[0]
    np.testing.assert_allclose(
        np.linalg.norm(lifted[0] - lifted[1], axis=-1), np.linalg.norm(draw[0] - draw[1], axis=-1), atol=1e-4
    )
    baseline = list(table["method"]).index("mean_pair")
    assert table["draw"][baseline] is None


def test_seeds_of_which_none_grew_stand_beside_others(grown: Any) -> None:
    store, given = grown
    (seeds,) = (seeds for seeds in given.of("seeds") if seeds.facts["kind"] == "grown_seeds")
    table = store.read(seeds.ref, "seeds")
    none = put(store, "seeds", "none", {"seeds": {name: table[name][:0] for name in table.column_names}}, seeds.facts)
    both = StageInputs({**given.manifests, "seeds": [*given.of("seeds"), none]}, seed=1)
    alone, beside = (lifted_from(store, some, max_frames=2)["pair17_m"] for some in (given, both))
    np.testing.assert_array_equal(beside, alone)


def test_what_is_expected_of_a_pair_rests_on_no_draw_of_that_person_at_that_moment(grown: Any) -> None:
    store, given = grown
    # A second couple with the same person A, lifted so badly that no draw of it is near anything.
    alone, both = (expected_errors(store, some) for some in (given, lifted_more_often(store, given, [9.0])))
    np.testing.assert_allclose(both, alone, rtol=1e-6)


def test_draws_of_the_same_image_make_nobody_surer_however_many_agree(grown: Any) -> None:
    store, given = grown
    alone, many = (expected_errors(store, some) for some in (given, lifted_more_often(store, given, [1.0] * 9)))
    assert many.mean() > alone.mean()


def lifted_more_often(store: Store, given: StageInputs, sizes: Sequence[float]) -> StageInputs:
    """Return inputs in which each lifted seed stands once more for each of these sizes."""
    (seeds,) = (seeds for seeds in given.of("seeds") if seeds.facts["kind"] == "grown_seeds")
    table = store.read(seeds.ref, "seeds")
    lifted = np.flatnonzero([name is not None for name in table["sequence_id"]])
    rows = [*range(table.num_rows), *np.tile(lifted, len(sizes))]
    scale = np.append(np.ones(table.num_rows), np.repeat(sizes, len(lifted)))
    columns = {name: [table[name][row] for row in rows] for name in table.column_names}
    columns["pair17_m"] = [np.asarray(pair) * size for pair, size in zip(columns["pair17_m"], scale, strict=True)]
    columns["seed_index"] = list(range(len(rows)))
    more = put(store, "seeds", f"{len(sizes)} more", {"seeds": columns}, seeds.facts)
    return StageInputs({**given.manifests, "seeds": [more]}, seed=1)


def expected_errors(store: Store, given: StageInputs) -> np.ndarray:
    found = lifted_from(store, given, max_frames=5)["expected_error_m"]
    return found[np.isfinite(found)]


def test_pairs_of_a_trio_are_scored_and_only_pairs_of_couples_hidden(grown: Any) -> None:
    store, given = grown
    takes = [
        put(store, "ingest", name, {"poses": rows}, facts)
        for name, people in (("trio", 3), ("couple", 2))
        for rows, facts in [take_rows(name, people, 10)]
    ]
    lifted = list(lift(store, given, max_frames=1).values())
    seen = [replace(manifest, facts={**manifest.facts, "is_virtual": True}) for manifest in given.of("annotations")]
    tables = {**given.manifests, "annotations": seen, "poses": takes, "lifted_pairs": lifted}
    shards = {shard.name: shard for shard in TOPIC.plan(StageInputs(tables, seed=1), STAGE.parameters())}
    assert set(shards["lifted"].refs("takes")) == {take.ref for take in takes}
    assert shards["completed"].refs("takes") == (takes[1].ref,)


def test_hidden_joints_are_completed_and_counted(grown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.rows.lifted_rows._NUM_COMPLETING", 5)
    store, given = grown
    table = lifted_from(store, given)
    seen, method = table["num_joints_seen"], table["method"]
    assert (seen[method == "completed"] == 27).all()
    assert (method == "completed").sum() == 1
    # The last pair that was made of an image has an error to expect: whole images are fitted, others completed.
    answers = (method == "completed") | ((method == "fitted") & (seen == 28))
    expected, low, high = (table[f"expected_{name}_m"] for name in ("error", "low", "high"))
    np.testing.assert_array_equal(np.isfinite(expected), answers)
    assert (low[answers] < expected[answers]).all()
    assert (expected[answers] < high[answers]).all()


def test_the_nearest_draw_of_each_set_that_is_compared_stands_beside_that_of_all(grown: Any) -> None:
    store, given = grown
    made = run_chains(store, given, num_chains=1, densities=("ic", "cartesian"), starts="seeds")
    draws = having("draws", made)
    known = StageInputs({**given.manifests, "draws": draws}, seed=1)
    table = lifted_from(store, known, max_frames=2, compared=("ic", "grown_seeds"))
    method, far = table["method"], table["residual_m"]
    assert {name for name in method if name.startswith("nearest_of_")} == {"nearest_of_ic", "nearest_of_grown_seeds"}
    # Chains of a few steps stay at their seed; the annotations that are lifted were grown over.
    assert (far[method == "nearest_of_ic"] > far[method == "nearest_of_grown_seeds"]).all()
    np.testing.assert_allclose(far[method == "nearest_of_grown_seeds"], far[method == "nearest"])
    with pytest.raises(InputError, match="no draws 'shape_context'; there are: cartesian, grown_seeds, ic"):
        lift(store, known, compared=("ic", "shape_context"))


def test_baselines_without_draws_stand_beside(grown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.lifting._NUM_NAIVE", 40)
    store, given = grown
    methods = set(
        lifted_from(store, given, max_frames=1, baselines=("lifting", "lifting_ik", "naive_sampling"))["method"]
    )
    assert {"lifting", "lifting_ik", "naive_sampling"} <= methods


def filmed(store: Store, given: StageInputs, facts: dict[str, Any], *, every: int = 1) -> StageInputs:
    """Return inputs whose annotations one camera has seen, one frame after the other, with their views."""
    annotations, views = given.of("annotations")[0], given.of("views")[0]
    table, seen = store.read(annotations.ref, "annotations"), store.read(views.ref, "views")
    columns = {name: table[name] for name in table.column_names}
    columns["sequence_id"] = ["film"] * table.num_rows
    columns["frame"] = columns["take_frame"].astype(int)
    columns["time_s"] = columns["frame"] / 30.0
    columns["op14_px"] = columns["pair17_px"][:, PAIR17.indices(OP14.joint_names)]
    keep = np.flatnonzero(columns["is_key"] & (columns["frame"] % every == 0))
    columns = {name: [values[row] for row in keep] for name, values in columns.items()}
    name = f"film of {'-'.join([*facts, str(every)])}"
    film = put(store, "ingest", name, {"annotations": columns}, {**annotations.facts, **facts})
    columns = {name: list(seen[name]) for name in seen.column_names}
    columns["frame"] = [int(name[-5:]) for name in columns["sequence_id"]]
    columns["sequence_id"] = ["film"] * seen.num_rows
    film_views = put(store, "views", name, {"views": columns}, views.facts, (film,))
    return StageInputs({**given.manifests, "annotations": [film], "views": [film_views]}, seed=1)


def pairs_over_time(table: TableData) -> np.ndarray:
    return np.asarray(table["pair17_m"][table["method"] == "over_time"], dtype=float)


def test_frames_of_a_video_are_filled_in_between(grown: Any) -> None:
    store, given = grown
    (made,) = lift(store, filmed(store, given, VIDEO), max_frames=2, between_frames=5, num_spans=1).values()
    between = store.read(made.ref, "in_betweens")
    assert list(between["method"]) == ["draws", "straight"] * 4
    np.testing.assert_array_equal(between["frame"], np.repeat(between["first_frame"][0] + 1 + np.arange(4), 2))
    # One camera saw all of it, so each pair is lifted with the others too, and that is what is expected to err so much.
    table = store.read(made.ref, "lifted_pairs")
    method = table["method"]
    assert (method == "over_time").sum() == (method == "fitted").sum() == made.facts["num_lifted"]
    np.testing.assert_array_equal(np.isfinite(table["expected_error_m"]), method == "over_time")
    # What is stated of the people is believed, and the camera is one of those that see the database.
    tall = filmed(store, given, {**VIDEO, "statures_m": {"0": 2.3, "1": 2.3}})
    (made,) = lift(store, tall, max_frames=2, between_frames=0).values()
    tall_m, usual_m = (pairs_over_time(found) for found in (store.read(made.ref, "lifted_pairs"), table))
    assert np.median(bone_lengths(PAIR17, tall_m)) > 1.15 * np.median(bone_lengths(PAIR17, usual_m))


def test_frames_of_a_video_are_lifted_by_other_takes_and_others_grow_from_them(inputs: Any) -> None:
    store, tables = inputs
    video = filmed(store, StageInputs(tables, seed=1), VIDEO)
    both = {name: [*tables[name], *video.of(name)] for name in ("annotations", "views")}
    given = with_seeds(store, {**tables, **both}, num_seeds=1, num_grown=20, num_filled=5, num_over_time=16)
    (film,) = video.of("annotations")
    names = [manifest.name for manifest in given.of("seeds")]
    assert names == ["seed", f"{film.partition}-{film.name}", "grown", "filled"]
    over_time = given.of("seeds")[1]
    # Nothing of the video's own take: that would be to know the answer.
    read = [store.manifest(ref) for ref in over_time.inputs]
    assert {manifest.partition for manifest in read if "poses" in manifest.tables} == {"two"}
    assert SeedFacts.of(over_time).start_indices == ()
    _, found, grown, _ = seeds = [store.read(manifest.ref, "seeds") for manifest in given.of("seeds")]
    assert set(found["origin"]) == {"over_time"}
    assert set(found["sequence_id"]) == {"film"}
    indices = np.concatenate([table["seed_index"] for table in seeds])
    assert len(set(indices.tolist())) == len(indices)
    assert set(grown["parent_seed_index"]) <= set(indices.tolist())
    assert np.isfinite(found["pair17_m"]).all()
    draws = read_draw_sets(store, [manifest.ref for manifest in given.of("seeds")[1:]])
    assert len(draws[GROWN].pairs_m) == found.num_rows + grown.num_rows


def put_projections(store: Store, take_id: str, *, origin: str = "take") -> Manifest:
    """Commit a part of a projection database: the couples of a take, or as if they were draws."""
    op14 = op14_from_working(pairs_of(take_id), PAIR17)
    poses = centre_and_face(retarget_proportions(op14.reshape(-1, 14, 3)))
    rows = np.arange(len(poses.poses_m))
    columns = {
        **random_columns("projections", len(rows)),
        "take_id": [take_id] * len(rows),
        "person": rows % 2,
        "partner_row": rows ^ 1,
        "op14_m": poses.poses_m,
        "heading_rad": poses.heading_rad,
        "root_translation_m": poses.root_translation_m,
    }
    facts = {"kind": "projections", "origin": origin, "takes": [take_id], "rate_hz": 24.0, "pitches_deg": (10.0,)}
    return put(store, "projections", f"{origin}-{take_id}", {"projections": columns}, facts)


def test_frames_of_a_video_are_lifted_by_the_projection_database_without_its_own_take(grown: Any) -> None:
    store, given = grown
    video = filmed(store, given, VIDEO)
    database = [put_projections(store, take_id) for take_id in ("one", "two")]
    seen = StageInputs({**video.manifests, "projections": database}, seed=1)
    (shard,) = lifting.plan(seen, LiftingParameters())
    assert shard.refs("projections") == (database[1].ref,)
    assert shard.options(lifting.LiftingShard).pitches_deg == (10.0,)
    by_draws, by_database = (
        store.read(manifest.ref, "lifted_pairs")
        for some in (video, seen)
        for manifest in lift(store, some, max_frames=2, between_frames=0).values()
    )
    fitted = [table["pair17_m"][table["method"] == "fitted"] for table in (by_draws, by_database)]
    np.testing.assert_array_equal(*fitted)
    assert np.isfinite(pairs_over_time(by_database)).all()
    assert np.abs(pairs_over_time(by_draws) - pairs_over_time(by_database)).max() > 0.02
    # Draws in the database are draws: so many as are here are lifted from themselves, and expected to err as such.  The
    # pitches are those of the study, whatever of its database may be used.
    for parts in ([put_projections(store, "two", origin="draw")], database[:1]):
        (shard,) = lifting.plan(StageInputs({**video.manifests, "projections": parts}, seed=1), LiftingParameters())
        assert shard.refs("projections") == ()
        assert shard.options(lifting.LiftingShard).pitches_deg == (10.0,)
    # Random views are frames of many cameras.
    views = StageInputs({**given.manifests, "projections": database}, seed=1)
    assert not any(shard.refs("projections") for shard in lifting.plan(views, LiftingParameters()))


def test_key_frames_of_ones_own_video_are_filled_in_between_and_stills_are_not(grown: Any) -> None:
    store, given = grown
    facts = {"purpose": "given", "rate_hz": 30.0}
    (made,) = lift(store, filmed(store, given, facts, every=7), max_frames=2, num_spans=1).values()
    between = store.read(made.ref, "in_betweens")
    assert between["last_frame"][0] - between["first_frame"][0] == 7
    assert between.num_rows == 2 * 6
    stills = filmed(store, given, {**facts, "why_no_video": {"film": "stills"}})
    (made,) = lift(store, stills, max_frames=2).values()
    assert "in_betweens" not in made.tables
    assert "over_time" not in set(store.read(made.ref, "lifted_pairs")["method"])


def test_without_draws_nothing_is_planned(inputs: Any) -> None:
    _, tables = inputs
    assert lifting.plan(StageInputs(tables, seed=1), LiftingParameters()) == []


def test_annotations_that_show_nothing_are_passed_over_and_told(grown: Any) -> None:
    store, given = grown
    annotations, views = given.of("annotations")[0], given.of("views")[0]
    table, seen = store.read(annotations.ref, "annotations"), store.read(views.ref, "views")
    columns = {name: table[name] for name in table.column_names}
    columns["pair17_px"] = np.full_like(columns["pair17_px"], np.nan)
    blind = put(store, "ingest", "blind", {"annotations": columns}, annotations.facts)
    columns = {name: seen[name] for name in seen.column_names}
    views = put(store, "views", "blind", {"views": columns}, annotations.facts, (blind,))
    (made,) = lift(store, StageInputs({**given.manifests, "annotations": [blind], "views": [views]}, seed=1)).values()
    assert not made.tables
    verdict = judged(made)
    assert verdict.level is Level.FAIL
    assert "40 annotated pairs show too little" in verdict.reason
    assert made.facts["skipped"] == ["blind: 40 annotated pairs were not lifted, too little was seen"]


def test_spans_are_a_gap_apart_and_those_between_key_frames_up_to_twice_that() -> None:
    def at(*frames: int, name: str = "a", person: int = 0) -> list[PairPlace]:
        return [PairPlace(name, frame, person, 9) for frame in frames]

    every = [(one.frame, two.frame) for one, two in _spans(at(*range(11)), 7, 4)]
    assert every == [(frame, frame + 4) for frame in range(7)]
    assert [one.frame for one, _ in _spans(at(*range(11)), 3, 4)] == evenly_spread(7, 3).tolist()
    places = [*at(20, 8, 3, 1, 0), *at(5, 12, name="b"), *at(7, 16, name="b", person=1), *at(9, name="c")]
    assert set(_spans(places, 9, 4)) == {tuple(at(1, 3)), tuple(at(3, 8)), tuple(at(5, 12, name="b"))}
    assert _spans(at(3), 2, 4) == []


def test_what_was_lifted_or_filled_in_from_an_image_is_known_of_seeds_and_of_what_was_repaired(tmp_path: Path) -> None:
    """Draws of a chain are of no image; a pair that was filled in from two others is of the images of both."""
    store, pairs_m = Store(tmp_path / "store"), pairs_of("one")
    rows = random_columns("seeds", 3) | {"pair17_m": pairs_m[:3], "seed_index": [0, 1, 2]}
    rows |= {"sequence_id": ["s", None, "t"], "sequence_frame": [5, None, 7], "sequence_person_id": [0, None, 1]}
    rows["filled_from"] = np.array([[-1] * 7, [0, 2, *[-1] * 5], [-1] * 7])
    seeds = put(store, "seeds", "filled", {"seeds": rows}, {"kind": "filled_seeds"})
    chain = put_draws(store, "chain", pairs_m[:2], (seeds,), pairs_m[0])
    columns = random_columns("draws", 2) | {"pair17_m": pairs_m[:2], "seed_index": [2, 0], "density": ["ic"] * 2}
    facts = {"kind": "draws", "density": "ic", "num_starts": 2, "num_draws": 2}
    repaired = put(store, "chains", "repaired", {"draws": columns}, facts, (seeds,), density="ic")
    refs = [chain.ref, seeds.ref, repaired.ref]
    names = [reference_to(table, ref) for table, ref in zip(("draws", "seeds", "draws"), refs, strict=True)]
    draws = SimpleNamespace(refs=names, artifacts=np.repeat([0, 1, 2], [2, 3, 2]))
    found = _lifted_from(store, refs, draws)  # type: ignore[arg-type]
    assert {image: sorted(numbers) for image, numbers in found.items()} == {
        ("s", 5, 0): [2, 3, 6],
        ("t", 7, 1): [3, 4, 5],
    }


def test_baselines_pass_over_annotations_that_are_not_seen_as_a_whole(grown: Any) -> None:
    store, given = grown
    shard = lifting.plan(given, LiftingParameters(baselines=("lifting",)))[0]
    every, _ = read_seen_pairs(store, shard.refs("annotations")[0], shard.refs("views")[0], num_hypotheses=1)
    whole = [seen for seen in every.values() if seen.is_seen.all()][:1]
    partial = [seen for seen in every.values() if not seen.is_seen.all()][:1]
    assert len(partial) == 1
    rows = _baselines(shard, store, [*partial, *whole], every)
    assert [(row["method"], row["sequence_id"]) for row in rows] == [("lifting", whole[0].place.sequence_id)]
    assert _baselines(shard, store, partial, dict.fromkeys(every, partial[0])) == []
    bare = lifting.plan(given, LiftingParameters())[0]
    assert _baselines(bare, store, whole, every) == []
