"""Topics that show and score what stages stored: each has a known answer on a tiny case."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.cameras.frames import project_pair, true_direction
from pasdedeux.errors import InputError
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.score_tables import format_value
from pasdedeux.interaction.nearest import pair_table
from pasdedeux.interaction.pair_map import PairMap
from pasdedeux.kinematics.rotations import rotate, unitquat_from_rotvec
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.reconstruction.unseen_views import CONDITIONS, UnseenMotion
from pasdedeux.skeletons import OP14
from pasdedeux.spread import evenly_spread
from storage_schema import Store
from tasks.evaluation import chains, coverage, detector, lifting, unseen_views, views
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.annotated_pairs import read_seen_pairs
from tasks.rows.draw_sets import read_draw_sets
from tasks.stage import StageInputs
from tasks.stage.streams import stream
from tests.builders.drawn_pairs import put_draws, put_seeds
from tests.builders.known_truth import FRAMES, RATE_HZ, TURNS, put_lifted, put_motions, put_truth
from tests.builders.sampling_store import NUM_FRAMES, pairs_of, put_annotations, put_take
from tests.builders.storage_rows import put, random_columns, take_rows
from tests.builders.walkers import database_of, walk

PAIRS = pairs_of("one")


def computed(topic: Topic[Any], store: Store, name: str, inputs: StageInputs) -> TopicResult[Any]:
    """Return the result of the shard of this name, as the topic plans it."""
    planned = {shard.name: shard for shard in topic.plan(inputs, topic.settings())}
    return topic.compute(planned[name], store)


def values_of(result: TopicResult[Any]) -> dict[tuple[str, str, str, str], float]:
    found = {(score.metric, score.method, score.split, score.item): score.value for score in result.scores}
    assert len(found) == len(result.scores)
    return found


@pytest.fixture
def sampled(store: Store) -> tuple[Store, StageInputs]:
    """Return annotations with their views, and chains of two densities, the first of them in two segments."""
    annotations, seen = put_annotations(store, "one")
    seeds = put_seeds(store, PAIRS[:3])
    known = (seeds, annotations, seen)
    draws = [
        put_draws(store, "ic second", PAIRS[20:40], known, PAIRS[0], segment=1),
        put_draws(store, "ic first", PAIRS[:20], known, PAIRS[0]),
        put_draws(store, "ic other chain", PAIRS[5:9] + 9.0, known, PAIRS[0], chain=1),
        put_draws(store, "prior", PAIRS[:4], (seeds,), PAIRS[0], density="prior_only"),
    ]
    info = {"density": ["ic", "ic"], "seed_index": [4, 4], "chain": [0, 1], "num_draws": [20, 30]}
    info |= {"acceptance_rate": [0.2, 0.4], "ess_min": [11.0, 9.0], "rhat_max": [1.1, 1.3], "sigma_l": [0.5, 0.7]}
    info |= {"log_density_first": [-9.0, -7.0], "log_density_mean": [-5.0, -6.0], "ceiling_share": [0.1, 0.3]}
    info |= {"travelled_m": [2.0, 3.0], "verdict": ["pass", "warn"], "reason": ["", "it hardly moves"]}
    alone = {name: [value[0]] for name, value in info.items()} | {"density": ["prior_only"], "sigma_l": [np.nan]}
    infos = [
        put(store, "chains", f"info {at}", {"chain_info": random_columns("chain_info", len(rows["chain"])) | rows}, {})
        for at, rows in enumerate((info, alone))
    ]
    tables = {"annotations": [annotations], "views": [seen], "seeds": [seeds], "draws": draws, "chain_info": infos}
    return store, StageInputs(tables, seed=1)


def test_chains_are_summed_up_by_density_and_seed_and_those_that_did_not_pass_are_named(sampled: Any) -> None:
    store, inputs = sampled
    result = computed(chains.TOPIC, store, "summary", inputs)
    found = values_of(result)
    wanted = {"acceptance_rate_mean": 0.3, "ess_min": 9.0, "rhat_max": 1.3, "sigma_l_mean": 0.6}
    wanted |= {"log_density_first_mean": -8.0, "log_density_mean": -5.5, "travelled_mean": 2.5}
    of_seed = {
        metric: value for (metric, method, _, item), value in found.items() if (method, item) == ("ic", "seed 4")
    }
    assert of_seed == pytest.approx(wanted | {"ceiling_share_mean": 0.2})
    assert {score.count for score in result.scores if score.method == "ic"} == {2}
    assert not [metric for metric, method, *_ in found if method == "prior_only" and "sigma" in metric]
    assert result.notes == [
        f"{in_words('ic')}: 1 of 2 chains did not pass, for example (warn, seed 4): it hardly moves."
    ]
    assert set(result.baselines) == {"prior_only"}


def test_states_of_the_first_chain_of_each_density_are_shown_from_its_seed_on(sampled: Any) -> None:
    store, inputs = sampled
    result = computed(chains.TOPIC, store, "draws", inputs)
    states_m, labels = result.shown.states["ic"]
    np.testing.assert_allclose(states_m, PAIRS, atol=1e-6)
    assert labels == [f"draws:STUDY/ic second#{index}" for index in range(40)]
    assert len(result.shown.states["prior_only"][0]) == 4
    found = values_of(result)
    means = {method: value for (metric, method, *_), value in found.items() if metric == "log_prior_mean"}
    assert means == {"ic": pytest.approx(-9.5), "prior_only": pytest.approx(-1.5)}
    pictures = {picture.name: picture for picture in chains.TOPIC.pictures(result)}
    assert list(pictures) == ["draws-ic.player.json", "draws-prior_only.player.json"]
    scene = json.loads(pictures["draws-ic.player.json"].content)
    assert (scene["num_frames"], scene["labels"]) == (40, labels)
    assert in_words("ic") in pictures["draws-ic.player.json"].caption


def test_states_of_a_chain_stand_beside_the_annotations_most_like_them(sampled: Any) -> None:
    """The states are annotated pairs themselves: each is nearest to its own image."""
    store, inputs = sampled
    result = computed(chains.TOPIC, store, "nearest", inputs)
    (annotations,), (seen,) = inputs.of("annotations"), inputs.of("views")
    every, _ = read_seen_pairs(store, annotations.ref, seen.ref, num_hypotheses=1)
    by_frame = {int(place.sequence_id[-5:]): pair for place, pair in every.items()}
    rows = result.shown.neighbours["ic"]
    assert len(rows) == 4
    for words, (draw, *near) in rows:
        at = int(words.removeprefix("draw ")) - 1
        assert draw[0] == "draw"
        np.testing.assert_allclose(draw[1], project_pair(PAIRS[at], by_frame[at].directions[0]), atol=1e-6)
        assert len(near) == 3
        assert near[0][0] == "annotation, 0 cm"
        np.testing.assert_array_equal(near[0][1], by_frame[at].image_m)
        assert all(float(label.split()[1]) > 0.0 for label, _ in near[1:])
    shown_at = [int(words.removeprefix("draw ")) for words, _ in rows]
    assert shown_at == sorted(shown_at)
    assert shown_at[0] > 0
    assert shown_at[-1] < NUM_FRAMES
    assert [picture.name for picture in chains.TOPIC.pictures(result)] == [
        f"draws-nearest-{density}.svg" for density in result.shown.neighbours
    ]


def test_lifted_pairs_stand_beside_their_nearest_annotations_and_draws_with_their_expected_error(sampled: Any) -> None:
    store, inputs = sampled
    (annotations,) = inputs.of("annotations")
    expected = {"expected_error_m": 0.204, "expected_low_m": 0.1, "expected_high_m": 0.346}
    row = {"frame": 0, "person_id": 0, "partner_id": 1} | expected | {"method": "fitted"}
    rows = [
        row | {"sequence_id": "one/view00007", "pair17_m": PAIRS[7]},
        row | dict.fromkeys(expected) | {"sequence_id": "one/view00008", "pair17_m": PAIRS[8], "method": "mean_pair"},
        row | {"sequence_id": "nowhere", "pair17_m": PAIRS[9], "expected_error_m": 0.4},
    ]
    lifted = put_lifted(store, "all", rows, inputs=(annotations,))
    given = StageInputs({**inputs.manifests, "lifted_pairs": [lifted]}, seed=1)
    result = computed(lifting.TOPIC, store, "nearest", given)
    ((label, row),) = result.shown.neighbours
    assert label == "one/view00007, frame 0: expected error 20 cm, 10 to 35"
    images = dict(row[:3])
    np.testing.assert_allclose(images["lifted"], PAIRS[7][..., :2], atol=1e-6)
    np.testing.assert_allclose(images["from the side"], PAIRS[7][..., [2, 1]], atol=1e-6)
    assert [words.split(",")[0] for words, _ in row[3:]] == ["annotation"] * 3 + ["draw"] * 3
    near, draws = row[3:6], row[6:]
    assert all(float(words.split()[1]) > 0.0 for words, _ in near), "its own annotation is excluded"
    assert draws[0][0] == "draw, 0 cm"
    np.testing.assert_allclose(
        draws[0][1] - draws[0][1].mean(axis=(0, 1)), images["image"] - images["image"].mean(axis=(0, 1)), atol=0.01
    )
    found = values_of(result)
    (expected_m,) = (value for (metric, method, *_), value in found.items() if metric == "expected_error_mean")
    assert expected_m == pytest.approx(0.302)
    assert [picture.name for picture in lifting.TOPIC.pictures(result)] == ["nearest.svg"]


def test_views_are_scored_by_their_angle_to_the_true_view(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """The heaviest hypothesis is off by a known angle, and the other one is the truth."""
    takes, videos, _ = put_truth(store)
    stored = []
    for number, (video, off_deg) in enumerate(zip(videos, (10.0, 25.0), strict=True)):
        truth = GroundTruth.read(store, [take.ref for take in takes], [video.ref])
        name, count = list(TURNS)[number], FRAMES - 1
        directions = []
        for frame in range(count):
            take_id, at = truth.frames[name, frame]
            true = true_direction(truth.takes[take_id][at], truth.cameras[name])
            axis = np.cross(true, [0.3, -0.5, 0.8])
            turn = unitquat_from_rotvec(np.radians(off_deg) * axis / np.linalg.norm(axis))
            directions += [rotate(turn, true), true]
        rows = random_columns("views", 2 * count) | {
            "sequence_id": [name] * 2 * count,
            "frame": np.repeat(np.arange(count), 2),
            "person_id": [0] * 2 * count,
            "partner_id": [1] * 2 * count,
            "hypothesis": np.tile([0, 1], count),
            "direction": np.array(directions),
            "weight": np.tile([0.6, 0.4], count),
            "psi_rad": np.linspace(-1.0, 1.0, 2 * count),
            "phi_rad": np.linspace(0.5, 2.0, 2 * count),
        }
        facts = {"kind": "views", "learned_takes": [], "torso_basis": "", "sequence_ids": [name], "purpose": None}
        facts |= {"is_held_out": bool(number), "num_annotations": count, "num_without_view": 0, "num_hypotheses": 2}
        facts |= {"size_ratio": 1.0, "skipped": [f"{name}: one is skipped"]}
        stored.append(put(store, "views", name, {"views": rows}, facts, (video,)))
    inputs = StageInputs({"views": stored, "annotations": videos, "poses": takes}, seed=1)
    result = computed(views.TOPIC, store, "accuracy", inputs)
    found = values_of(result)
    for split, off_deg in (("annotated", 10.0), ("held_out", 25.0)):
        assert found["view_error_mean", "heaviest_hypothesis", split, "all"] == pytest.approx(off_deg, abs=1e-3)
        assert found["view_error_mean", "best_hypothesis", split, "all"] == pytest.approx(0.0, abs=1e-3)
    assert result.notes == [f"{name}: one is skipped" for name in TURNS]
    items = result.items[""]
    assert set(items.takes) == {"hidden"}
    np.testing.assert_allclose(items.times_s, (np.arange(FRAMES - 1) + 1) / RATE_HZ)
    np.testing.assert_allclose(items.values["heaviest_hypothesis"], 25.0, atol=1e-3)
    assert (len(result.shown.psi_rad), result.baselines) == (4 * (FRAMES - 1), ("mean_view",))
    (picture,) = views.TOPIC.pictures(result)
    assert picture.content.count(b"<use") + picture.content.count(b"<path") > 4
    drawn: list[Any] = []
    monkeypatch.setattr(views, "figure_svg", lambda figure, title: drawn.append(figure) or b"")
    views.TOPIC.pictures(result)
    (axis,) = drawn[0].axes
    assert (axis.get_xlim(), axis.get_ylim()) == ((-180.0, 180.0), (180.0, 0.0)), "from above to below"
    (dots,) = axis.collections
    np.testing.assert_allclose(dots.get_offsets(), np.degrees(np.stack(result.shown[:2], axis=1)))
    np.testing.assert_allclose(dots.get_sizes(), 1.0 + 12.0 * np.asarray(result.shown.weight))
    shard = views.TOPIC.shard(inputs, "accuracy", views=[stored[0]], annotations=[], takes=[])
    alone = views.TOPIC.compute(shard, store)
    assert (alone.scores, alone.items) == ([], {})
    assert alone.notes[-1] == "No true camera is known, so the error of views cannot be measured."


def test_a_detector_is_scored_by_who_is_who_and_by_errors_beside_those_of_noise_alone(store: Store) -> None:
    """Joints are a tenth too far from the mid-hip with noise alone, and three tenths with the detector."""
    takes, (_, video), poses = put_truth(store, "op14_m")
    table = store.read(video.ref, "annotations")
    columns = {column.name: table[column.name] for column in table.table.columns}
    name = "film hidden"
    seen_columns = columns | {"sequence_id": [f"{name}.detector"] * table.num_rows, "time_s": table["frame"] / RATE_HZ}
    plain_columns = columns | {"time_s": 3.0 * table["frame"] / RATE_HZ}
    cameras = store.read(video.ref, "cameras")
    camera = {column.name: cameras[column.name] for column in cameras.table.columns}
    settled = {"sequence_id": f"{name}.detector", "num_people": 4, "num_true_people": 2, "num_identity_switches": 3}
    facts = dict(video.facts)
    detected = put(
        store,
        "ingest",
        "detected",
        {"annotations": seen_columns, "cameras": camera | {"sequence_id": [f"{name}.detector"]}},
        facts | {"sequence_ids": [f"{name}.detector"], "detected": [settled | {"couples": [[0, 2], [1, 3]]}]},
        (takes[1],),
    )
    plain = put(store, "ingest", "plain", {"annotations": plain_columns, "cameras": camera}, facts, (takes[1],))
    true = poses["hidden"][1:] @ TURNS[name].T
    hip = true[:, :, OP14.indices(["left_hip", "right_hip"])].mean(axis=2, keepdims=True)
    motions = [
        put_motions(store, f"{name}{end}", {"fit": hip + factor * (true - hip)})
        for end, factor in ((".detector", 1.3), ("", 1.1))
    ]
    inputs = StageInputs({"motions": motions, "annotations": [detected, plain], "poses": takes}, seed=1)
    result = computed(detector.TOPIC, store, f"{name}.detector", inputs)
    assert [shard.name for shard in detector.TOPIC.plan(inputs, detector.TOPIC.settings())] == [f"{name}.detector"]
    found = values_of(result)
    for person in (0, 1):
        median = np.median(np.linalg.norm(true - hip, axis=-1).mean(axis=-1)[:, person])
        for method, off in (("detector", 0.3), ("noise_alone", 0.1)):
            value = found["median_error", method, "fit", f"{name} person {person}"]
            assert value == pytest.approx(off * median, rel=1e-4)
    minutes = 3.0 * (FRAMES - 2) / RATE_HZ / 60.0
    figures = {metric: value for (metric, method, *_), value in found.items() if method == "followed"}
    assert figures == {
        "identity_switches_per_minute": pytest.approx(3.0 / minutes, rel=1e-4),
        "extra_people": 2.0,
        "wrong_pairs": 3.0,
    }
    items = result.items[""]
    assert (list(items.takes), result.baselines) == ([f"{name}.detector"], ("noise_alone",))
    np.testing.assert_allclose(items.values["followed"], 3.0 / minutes, rtol=1e-4)


def test_the_map_of_coverage_shows_more_draws_in_each_panel(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = [put_take(store, "one"), put_take(store, "kept_back", is_held_out=True)]
    pairs_m = random_pairs(np.random.default_rng(3), 300, spread_rad=0.3)
    seeds = put_seeds(store, PAIRS[:1])
    draws = put_draws(store, "ic", pairs_m, (seeds,), PAIRS[0])
    inputs = StageInputs({"poses": takes, "draws": [draws], "seeds": [seeds]}, seed=1)
    assert [shard.name for shard in coverage.TOPIC.plan(inputs, coverage.TOPIC.settings())] == list(coverage.SPLITS)
    assert computed(coverage.TOPIC, store, "annotated", inputs).notes == [
        "Coverage of annotated frames is not measured: there are no such frames."
    ]
    result = computed(coverage.TOPIC, store, "held_out", inputs)
    drawn: list[Any] = []
    monkeypatch.setattr(coverage, "map_figure", lambda *given, **more: drawn.append((given, more)) or b"<svg/>")
    pictures = coverage.TOPIC.pictures(result)
    assert [picture.name for picture in pictures] == ["coverage-held_out.svg", "coverage-map-held_out.svg"]
    (((places, panels), more),) = drawn
    plane = PairMap.of(result.shown.truth_m)
    np.testing.assert_allclose(places, plane.places)
    assert list(panels) == ["3 draws of each", "30 draws of each", "300 draws of each"]
    for count, of_method in zip((3, 30, 300), panels.values(), strict=True):
        assert set(of_method) == {"grown_seeds", "ic"}
        in_order = read_draw_sets(store, (draws.ref,))["ic"].in_order.astype(np.float64)
        wanted = plane.place(pair_table(in_order[evenly_spread(count, 400)]))
        np.testing.assert_allclose(of_method["ic"], wanted, atol=1e-5)
    assert (more["seed"], more["title"].split(" (")[0]) == (None, "held-out frames and draws")
    given = result.shown._replace(seed_m=pair_table(PAIRS[:1]))
    coverage.TOPIC.pictures(replace(result, shown=given))
    np.testing.assert_allclose(drawn[-1][1]["seed"], plane.place(pair_table(PAIRS[:1]))[0])
    alike = result.shown._replace(truth_m=np.repeat(result.shown.truth_m[:1], 5, axis=0))
    names = [picture.name for picture in coverage.TOPIC.pictures(replace(result, shown=alike))]
    assert names == ["coverage-held_out.svg"], "pairs that are all alike have no map"


def test_a_held_out_take_is_seen_and_reconstructed_from_every_direction_in_each_condition(store: Store) -> None:
    rows, facts = take_rows("held", 2, 24, rate_hz=24.0, is_held_out=True)
    people = np.stack([walk(24, seed=7), walk(24, seed=8)])
    take = put(store, "ingest", "held", {"poses": rows | {"op14_m": people.reshape(-1, 14, 3)}}, facts)
    database = database_of([walk(40, seed=seed) for seed in (1, 2)], rate_hz=24.0)
    known = random_columns("projections", 80) | {"op14_m": database.poses_m}
    known["is_sequence_start"] = database.is_sequence_start
    known["body22_unitquat"] = np.tile([0.0, 0.0, 0.0, 1.0], (80, 22, 1))
    facts_of_parts = {"kind": "projections", "rate_hz": 24.0, "pitches_deg": [12.0], "num_poses": 80}
    parts = [
        put(store, "projections", name, {"projections": known}, facts_of_parts | {"takes": takes})
        for name, takes in (("other", ["other"]), ("same", ["held"]))
    ]
    inputs = StageInputs({"poses": [take], "projections": parts}, seed=1)
    settings = unseen_views.UnseenViewsSettings(unseen_views_deg=(0.0, 75.0))
    assert unseen_views.PARALLEL_VIEWS.plan(inputs, unseen_views.UnseenViewsSettings()) == []
    planned = unseen_views.PARALLEL_VIEWS.plan(inputs, settings)
    assert [shard.name for shard in planned] == [f"held-{number}" for number in range(len(CONDITIONS))]
    assert [shard.refs("parts") for shard in planned] == [(parts[0].ref,)] * len(CONDITIONS), "none knows the take"
    result = unseen_views.PARALLEL_VIEWS.compute(planned[0], store)
    searcher = Searcher.of(database)
    found = values_of(result)
    assert {split for _, _, split, _ in found} == {CONDITIONS[0].name}
    for person in (0, 1):
        label = f"held person {person}"
        motion = UnseenMotion(label, people[person].astype(np.float32).astype(np.float64), 24.0, (0.0, 75.0))
        draw = partial(stream, 1, "evaluation", "parallel_views", "held", person, 0)
        scores, _ = unseen_views.unseen_view_scores(searcher, motion, CONDITIONS[0], draw)
        for score in scores:
            wanted = pytest.approx(score.value, abs=1e-4)
            assert found[score.metric, score.method, score.split, score.item] == wanted, score
    items = result.items[""]
    assert (set(items.takes), len(items.takes)) == ({"held"}, 2 * 2 * 24)
    assert result.notes[0].startswith(f"held against {80 * 30:,} projections; ")
    pictures = unseen_views.PARALLEL_VIEWS.pictures(result)
    assert [picture.name for picture in pictures] == [f"parallel_views-held-person-{at}.player.json" for at in (0, 1)]
    assert json.loads(pictures[0].content)["num_frames"] > 10
    (table,) = unseen_views.PARALLEL_VIEWS.tabulate({"parallel_views": result.scores})
    item = f"held person 0, {unseen_views._ALL_VIEWS}"
    fit = found["error_root_kept", "fit", CONDITIONS[0].name, item]
    row = dict(zip(table.headings, table.rows[0], strict=True))
    assert (row["motion"], row["paper"], row["VNect"]) == (item, *unseen_views._STATED[unseen_views._ALL_VIEWS])
    assert row[in_words("fit")] == format_value(fit, "m")
    shard = unseen_views.PARALLEL_VIEWS.shard(
        inputs, "x", planned[0].parameters, take=[take], parts=[parts[1]], clusters=[]
    )
    with pytest.raises(InputError, match="the projection database learned from held"):
        unseen_views.PARALLEL_VIEWS.compute(shard, store)
