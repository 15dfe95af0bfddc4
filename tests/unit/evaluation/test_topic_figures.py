"""Topics that score what stages stored: each has a known answer on a tiny case."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.completion.errors import completion_errors, in_between_errors
from pasdedeux.errors import InputError
from pasdedeux.evaluation.distributions import KID_FACTOR, distances, kernel_interval
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import Score
from pasdedeux.learning.baselines import CopyModel, NaiveFkModel
from pasdedeux.reconstruction.film_alignment import FilmAlignment
from pasdedeux.skeletons import OP14
from storage_schema import Manifest, Store
from tasks.evaluation import augmentation, generation, lifting, models, realism, reconstruction, sets
from tasks.evaluation.coverage import curve_points
from tasks.evaluation.generation import distribution_scores
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.realism import _Clips, _compare
from tasks.rows.takes import read_take
from tasks.stage import StageInputs
from tests.builders.drawn_stores import Drawn, drawn_store
from tests.builders.known_truth import FRAMES, RATE_HZ, TURNS, lifted_row, pairs_of, put_lifted, put_motions, put_truth
from tests.builders.storage_rows import put, random_columns, take_rows
from tests.builders.stored_datasets import put_clips
from tests.builders.stored_models import put_model

INPUTS = StageInputs(manifests={}, seed=3)


def by_name(scores: Sequence[Score]) -> dict[tuple[str, str, str, str], Score]:
    """Return scores by metric, method, split and item, which must be unique."""
    found = {(score.metric, score.method, score.split, score.item): score for score in scores}
    assert len(found) == len(scores)
    return found


def lifted_result(store: Store, lifted: Sequence[Manifest], takes: list[Manifest], videos: list[Manifest]) -> Any:
    shard = lifting.TOPIC.shard(INPUTS, "lifted", takes=takes, annotations=videos, lifted=lifted)
    return lifting.TOPIC.compute(shard, store)


def test_lifted_pairs_are_scored_by_part_and_method_in_the_axes_of_their_camera(store: Store) -> None:
    """B is 0.4 or 0.2 m too far away: the depth error is the whole distance, the error of the pair half of it."""
    takes, videos, poses = put_truth(store)
    expected = {"expected_error_m": 0.21, "expected_low_m": 0.1, "expected_high_m": 0.3}
    rows = [
        lifted_row(poses, "seen", 1, "fitted", 0.4) | expected,
        lifted_row(poses, "seen", 4, "fitted", 0.2) | expected | {"expected_high_m": 0.09},
        lifted_row(poses, "hidden", 2, "fitted", 0.2) | expected,
        lifted_row(poses, "hidden", 2, "nearest", 0.6),
        lifted_row(poses, "seen", 1, "fitted", 9.0) | {"sequence_id": "no such film"},
    ]
    result = lifted_result(store, [put_lifted(store, "all", rows)], takes, videos)
    found = by_name(result.scores)
    distances_m = {("unannotated", "fitted"): 0.3, ("held_out", "fitted"): 0.2, ("held_out", "nearest_draw"): 0.6}
    for (split, method), apart_m in distances_m.items():
        for quantity, error_m in (("lifted_pair", apart_m / 2), ("lifted_person", 0.0), ("relative_depth", apart_m)):
            score = found[f"{quantity}_error_mean", method, split, "all"]
            assert (score.value, score.unit) == (pytest.approx(error_m, abs=1e-6), "m")
    assert {score.split for score in result.scores} == {"unannotated", "held_out"}
    assert found["lifted_pair_error_mean", "fitted", "unannotated", "all"].count == 2
    assert found["lifted_pair_error_p90", "fitted", "unannotated", "all"].value == pytest.approx(0.19, abs=1e-6)
    # Of the errors 0.2 and 0.1 m, one lies within its expected interval.
    assert found["expected_interval_share", "fitted", "unannotated", "all"].value == 0.5
    assert found["expected_interval_share", "fitted", "held_out", "all"].value == 1.0
    assert result.baselines == lifting._BASELINES


def test_only_held_out_pairs_are_judged_each_beside_the_others_of_its_image(store: Store) -> None:
    takes, videos, poses = put_truth(store)
    rows = [
        lifted_row(poses, "seen", 1, "fitted", 0.4),
        lifted_row(poses, "hidden", 2, "fitted", 0.2),
        lifted_row(poses, "hidden", 2, "mean_pair", 0.8),
        lifted_row(poses, "hidden", 4, "fitted", 0.1),
    ]
    between = [
        {key: value for key, value in lifted_row(poses, "hidden", 3, method, apart_m).items() if "expected" not in key}
        for method, apart_m in (("draws", 0.6), ("straight", 0.2))
    ]
    lifted = [put_lifted(store, "a", rows), put_lifted(store, "b", between, table="in_betweens")]
    result = lifted_result(store, lifted, takes, videos)
    items = result.items[""]
    assert list(items.takes) == ["hidden", "hidden"]
    np.testing.assert_allclose(items.times_s, [3 / RATE_HZ, 5 / RATE_HZ])
    np.testing.assert_allclose(items.values["fitted"], [0.1, 0.05], atol=1e-6)
    np.testing.assert_allclose(items.values["mean_pair"], [0.4, np.nan], atol=1e-6)
    between_items = result.items["frames between lifted pairs"]
    np.testing.assert_allclose(between_items.values["draws"], [0.3], atol=1e-6)
    np.testing.assert_allclose(between_items.times_s, [4 / RATE_HZ])
    found = by_name(result.scores)["in_between_lifted_error_mean", "straight", "held_out", "all"]
    assert (found.unit, found.count) == ("m", 1)
    assert found.value == pytest.approx(0.1, abs=1e-6)
    # Examples of each part show the truth, then methods in their order.
    assert [list(example) for example in result.shown.examples["held_out"]] == [["truth", "fitted"]] * 2
    true = poses["hidden"][3] @ TURNS["film hidden"].T
    np.testing.assert_allclose(result.shown.examples["held_out"][0]["truth"], true, atol=1e-6)


def test_random_views_are_the_annotated_part_and_lifting_that_learned_from_the_test_is_refused(store: Store) -> None:
    takes, videos, poses = put_truth(store)
    rows = [lifted_row(poses, "seen", 1, "fitted", 0.4)]
    lifted = put_lifted(store, "a", rows, purpose="random_views")
    assert {score.split for score in lifted_result(store, [lifted], takes, videos).scores} == {"annotated"}
    rows = [lifted_row(poses, "hidden", 1, "fitted", 0.4)]
    learned = put_lifted(store, "b", rows, is_held_out=True, learned_takes=["hidden"])
    with pytest.raises(InputError, match="learned from hidden, which it is evaluated on"):
        lifted_result(store, [learned], takes, videos)


def put_draws(store: Store, name: str, pairs_m: np.ndarray, takes: Sequence[str] = ()) -> Manifest:
    columns = random_columns("draws", len(pairs_m)) | {"pair17_m": pairs_m}
    facts = {"kind": "draws", "takes": list(takes), "density": "ic", "num_draws": len(pairs_m), "segment": 0}
    return put(store, "chains", name, {"draws": columns}, facts, density="ic")


def test_completed_joints_and_frames_between_are_those_of_spread_real_pairs(store: Store) -> None:
    takes, _, poses = put_truth(store)
    draws_m = np.concatenate([pairs_of(number) for number in range(5, 9)])
    draws = put_draws(store, "draws", draws_m)
    settings = lifting.LiftedPairsSettings(num_completed_pairs=3)
    shard = lifting.TOPIC.shard(INPUTS, "completed", settings, takes=takes, draws=[draws])
    result = lifting.TOPIC.compute(shard, store)
    assert result.notes == [f"Hidden joints were completed from {len(draws_m)} draws and grown pairs."]
    truth, pool, generator = lifting._truth_and_pool(shard, store)
    assert len(pool) == len(draws_m)
    for split, take_id in (("learned", "seen"), ("held_out", "hidden")):
        frames = [frame for _, frame in lifting._spread_places({take_id: poses[take_id]}, 3, 0)]
        wanted = completion_errors(generator, poses[take_id][frames], pool)
        for part, methods in wanted.items():
            for method, errors in methods.items():
                score = by_name(result.scores)["occluded_joint_error_mean", method, split, part]
                assert score.value == pytest.approx(errors.mean())
                assert (score.count, score.unit) == (3, "m")
    items = result.items["completed joints"]
    assert set(items.takes) == {"hidden"}
    np.testing.assert_allclose(items.times_s, [frame / RATE_HZ for frame in frames] * len(wanted))
    np.testing.assert_allclose(items.values["fitted"], np.concatenate([part["fitted"] for part in wanted.values()]))
    assert truth.held_out == {"hidden"}
    draws = put_draws(store, "of the test", draws_m, ["hidden"])
    with pytest.raises(InputError, match="learned from hidden"):
        lifting._truth_and_pool(lifting.TOPIC.shard(INPUTS, "completed", takes=takes, draws=[draws]), store)


def test_frames_between_have_the_errors_of_their_span(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifting, "_GAPS", (2, 4))
    takes, _, poses = put_truth(store)
    draws = put_draws(store, "draws", np.concatenate([pairs_of(number) for number in range(5, 9)]))
    settings = lifting.LiftedPairsSettings(num_completed_pairs=2)
    shard = lifting.TOPIC.shard(INPUTS, "between", settings, takes=takes, draws=[draws])
    result = lifting.TOPIC.compute(shard, store)
    _, pool, _ = lifting._truth_and_pool(shard, store)
    (_, first), (_, second) = lifting._spread_places({"hidden": poses["hidden"]}, 2, 4)
    found = by_name(result.scores)
    for gap, start in ((2, first), (4, second)):
        wanted = in_between_errors([poses["hidden"][start : start + gap + 1]], pool)
        for method, (errors,) in wanted.items():
            score = found["in_between_error_mean", method, "held_out", f"{gap} frames"]
            assert score.value == pytest.approx(errors.mean())
            assert (score.unit, score.count) == ("m", 1)
    assert ("in_between_error_mean", "real_frames", "learned", "2 frames") not in found
    assert ("in_between_error_mean", "real_frames", "held_out", "2 frames") in found
    items = result.items["frames between"]
    frames = [first + 1, second + 1, second + 2, second + 3]
    np.testing.assert_allclose(items.times_s, np.array(frames) / RATE_HZ)
    assert list(items.takes) == ["hidden"] * 4


def test_held_out_takes_of_priors_stay_out_of_the_real_frames(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    takes, *_ = put_truth(store)
    rows = pairs_of(2).swapaxes(0, 1).reshape(-1, 17, 3)
    columns, facts = take_rows("both", 2, FRAMES, rate_hz=RATE_HZ, is_held_out=True, pair17_m=rows)
    both = put(store, "ingest", "both", {"poses": columns}, facts | {"is_prior": True})
    draws = put_draws(store, "draws", np.concatenate([pairs_of(number) for number in range(5, 9)]))
    shard = sets.TOPIC.shard(INPUTS, "sets", takes=[*takes, both], draws=[draws], chains=[], limits=[])
    monkeypatch.setattr(sets, "select_pairs", lambda *_: SimpleNamespace(columns={}))
    result = sets.TOPIC.compute(shard, store)
    assert set(result.items[""].takes) == {"hidden"}
    # Real frames come from the take that is learned from: half are a set, and half are what it is compared with.
    assert {score.count for score in result.scores if score.method == "real_frames"} == {(FRAMES + 1) // 2}


@pytest.mark.parametrize(
    ("num_draws", "num_points", "wanted"),
    [(0, 4, [1]), (1, 4, [1]), (3, 9, [1, 2, 3]), (1000, 4, [1, 10, 100, 1000]), (1000, 1, [1])],
)
def test_points_of_coverage_go_from_one_draw_to_all(num_draws: int, num_points: int, wanted: list[int]) -> None:
    assert curve_points(num_draws, num_points) == wanted


def test_models_are_scored_on_every_test_variant_in_centimetres(tmp_path: Path) -> None:
    """Each variant is its take moved 1, 2 or 3 m aside, which is the error of a copy of the source."""
    takes = [Drawn("waltz", 6, False, ("pass", "pass", "warn")), Drawn("hug", 4, False, ("pass",))]
    store, poses = drawn_store(str(tmp_path / "store"), takes)
    waltz, hug = (take.name for take in poses)
    variants = [manifest for manifest in store.artifacts() if "variants" in manifest.tables]
    test = {waltz: ["v0", "v2"], hug: ["v0"]}
    stored = [put_model(store, model, "random", poses, test) for model in (CopyModel(), NaiveFkModel())]
    manifests = {"models": stored, "poses": poses, "variants": variants, "variant_quality": variants}
    (shard,) = models.TOPIC.plan(StageInputs(manifests=manifests, seed=3), models.ModelsSettings())
    result = models.TOPIC.compute(shard, store)
    found = by_name(result.scores)
    for item, value, count in (("all", 500 / 3, 3), ("waltz", 200.0, 2), ("hug", 100.0, 1)):
        score = found["E_r", "copy", "random test", item]
        assert score.value == pytest.approx(value, rel=1e-5)
        assert (score.unit, score.count) == ("cm", count)
        assert ("E_r", "solver", "random test", item) not in found, "it has no distance to itself"
    bones = found["E_b", "copy", "random test", "all"]
    assert (bones.value, bones.unit) == (pytest.approx(0.0, abs=1e-3), "mm")
    items = result.items["random"]
    assert list(items.takes) == [waltz] * 12 + [hug] * 4
    np.testing.assert_allclose(items.values["copy"], [100.0] * 6 + [300.0] * 6 + [100.0] * 4, rtol=1e-5)
    np.testing.assert_allclose(items.times_s, np.concatenate([np.arange(6), np.arange(6), np.arange(4)]) / 30.0)
    assert items.count == 3
    assert result.baselines == ["copy", "naive_fk"]
    assert result.notes[0].startswith("Split random: 3 of 3 test variants of 2 takes; trained on 2. Intervals are over")
    shown = result.shown
    keys = [(waltz, "v0"), (waltz, "v2"), (hug, "v0")]
    assert [(key.take_id, key.variant_id) for key in shown.keys] == keys
    assert [key.furthest_scale for key in shown.keys] == pytest.approx([1.0, 1.2, 1.0])
    said, cases = shown.cases
    assert list(cases) == ["best", "median", "worst"]
    assert f"worst: {waltz}, v2, " in said
    item, predicted = cases["worst"]
    assert item.variant_id == "v2"
    assert predicted.shape == item.motion_m.shape
    pictures = models.TOPIC.pictures(result)
    errors = pictures[0]
    assert errors.name == "models-random.svg"
    assert b"models on random test variants" in errors.content
    assert "on the 3 test variants of split random" in errors.caption
    (player,) = (json.loads(picture.content) for picture in pictures if picture.name.startswith("cases-"))
    assert [panel["title"].split(":")[0] for panel in player["panels"]] == list(cases)
    assert player["num_frames"] == 2, "as long as the shortest of them lasts"
    curves = models.TOPIC.pictures(replace(result, shown=shown._replace(curves={}, cases=("", {}))))
    assert [picture.name for picture in curves] == ["models-random.svg"]
    steps = {"copy": (np.array([1.0, 2.0]), np.array([3.0, 2.5]))}
    learned = models.TOPIC.pictures(replace(result, shown=shown._replace(curves=steps, cases=("", {}))))
    assert [picture.name for picture in learned] == ["models-random.svg", "learning-random.svg"]
    fewer = models.ModelsSettings(num_test_variants=1)
    (shard,) = models.TOPIC.plan(StageInputs(manifests=manifests, seed=3), fewer)
    assert by_name(models.TOPIC.compute(shard, store).scores)["E_r", "copy", "random test", "all"].count == 1


def test_generated_motion_is_judged_by_the_contacts_of_its_take_in_millimetres(store: Store) -> None:
    """The generated scene is 10 % larger, and so is the distance of each contact; the solver's variant is the take."""
    take, solved = put_clips(store, "waltz", 1, 30, ["v0", "v1"])
    hug, _ = put_clips(store, "hug", 2, 30, ["v0"])
    model = put_model(store, CopyModel(), "random", [take], {"waltz": ["v0"]})
    people = read_take(store, take.ref).source
    larger = put_clips(store, "larger", 1, 30, ["g0"])[1]
    rows = {name: store.read(larger.ref, "variants")[name] for name in ("frame", "person", "time_s", "body22_unitquat")}
    rows |= {"take_id": ["waltz"] * 60, "variant_id": ["g0"] * 60}
    rows["body22_m"] = 1.1 * people.positions_m.reshape(-1, 22, 3)
    quality = random_columns("variant_quality", 1) | {"take_id": ["waltz"], "variant_id": ["g0"], "verdict": ["pass"]}
    quality["bone_scale"] = [np.ones(44)]
    origin = {"model": "copy", "split": "random", "artifact": model.ref.key, "segment": 0, "seed": 0}
    facts = {**solved.facts, "variants": ["g0"], "origin": origin, "told": {**solved.facts["told"], "variants": ["g0"]}}
    generated = put(store, "generation", "waltz", {"variants": rows, "variant_quality": quality}, facts, (take,))
    elsewhere = {**facts, "origin": origin | {"artifact": "0" * 64}}
    not_ours = put(store, "generation", "not ours", {"variants": rows, "variant_quality": quality}, elsewhere, (take,))
    manifests = {"models": [model], "poses": [take, hug], "variants": [solved, generated, not_ours]}
    inputs = StageInputs(manifests=manifests, seed=3)
    (shard,) = generation.TOPIC.plan(inputs, generation.LearnedSettings())
    assert [len(shard.refs(role)) for role in ("generated", "solved", "takes")] == [1, 1, 2]
    result = generation.TOPIC.compute(shard, store)
    contacts = people.contacts()
    held = np.nonzero(contacts.is_held)
    vectors = contacts.vectors(people.positions_m.reshape(30, -1, 3))[held] + contacts.places_m[held]
    found = by_name(result.scores)
    error = found["contact_error", "copy", "random test", "all"]
    assert error.value == pytest.approx(100.0 * np.linalg.norm(vectors, axis=-1).mean(), rel=1e-3)
    assert (error.unit, error.count) == ("mm", len(vectors))
    for method in ("solver", "naive_fk"):
        assert found["contact_error", method, "random test", "all"].value == pytest.approx(0.0, abs=1e-2)
    items = result.items[""]
    assert set(items.takes) == {"waltz"}
    assert items.count == 1
    np.testing.assert_allclose(items.times_s, held[0] / 30.0)
    assert result.baselines == ("naive_fk", "strangers")
    assert result.notes[0].endswith("of 1 test take; the model learned from other scales of these takes.")
    assert list(result.shown.motions_m) == ["g0"]
    (picture,) = generation.TOPIC.pictures(result)
    assert (picture.name, picture.caption.split(",")[0]) == ("generated-waltz.player.json", "waltz")
    assert [panel["title"] for panel in json.loads(picture.content)["panels"]] == ["take", "g0"]
    (table,) = generation.TOPIC.tabulate({"generation": result.scores})
    assert {row[:2] for row in table.rows} >= {("random test", in_words(name)) for name in ("copy", "solver")}
    drift = {row[1]: row[table.headings.index(in_words("contact_error"))] for row in table.rows}
    assert drift[in_words("copy")] == f"{error.value:.3g} mm"


def put_motion(store: Store, poses: Mapping[str, np.ndarray], off_m: float) -> Manifest:
    """Commit a reconstruction of the hidden take: A is right, B off to the side, and a third is a passer-by."""
    people_m = (poses["hidden"][1:] @ TURNS["film hidden"].T)[:, [0, 1, 1]]
    shift_m = np.array([0.0, off_m, off_m])[:, None, None] * [1.0, 0.0, 0.0]
    larger = np.array([1.1, 1.0, 1.0])[:, None, None]
    motions_m = {"nearest_frame": larger * people_m + 2.0 * shift_m, "windows": people_m + shift_m}
    return put_motions(store, "film hidden", motions_m, person_ids=range(3), pitch_deg=10.0, methods=["windows"])


def test_people_of_virtual_video_are_scored_against_the_take_in_the_axes_of_its_camera(store: Store) -> None:
    takes, videos, poses = put_truth(store, "op14_m")
    motions = put_motion(store, poses, 0.3)
    inputs = {"motions": [motions], "annotations": [videos[1]], "takes": [takes[1]]}
    shard = reconstruction.TOPIC.shard(INPUTS, "film hidden", **inputs)
    result = reconstruction.TOPIC.compute(shard, store)
    found = by_name(result.scores)
    assert {score.split for score in result.scores} == {"held_out"}
    for person in (0, 1):
        item = f"film hidden person {person}"
        for metric in ("error_root_kept", "error_root_removed", "error_scale_free"):
            score = found[metric, "windows", "held_out", item]
            assert score.value == pytest.approx(0.0, abs=1e-6)
            assert (score.unit, score.count) == ("m", FRAMES - 1)
    assert not [score for score in result.scores if "person 2" in score.item], "he is not of the take"
    # The other method makes A 10 % too large, which is 10 % of the distance of each joint from the mid-hip.
    true = poses["hidden"][1:, 0]
    hips = true[:, OP14.indices(["left_hip", "right_hip"])].mean(axis=1, keepdims=True)
    wanted = 0.1 * np.linalg.norm(true - hips, axis=-1).mean()
    assert found["error_root_kept", "nearest_frame", "held_out", "film hidden person 0"].value == pytest.approx(wanted)
    apart = found["pair_place_error", "windows", "held_out", "film hidden person 0 with 1"]
    assert apart.value == pytest.approx(0.3, abs=1e-6)
    assert found["pair_depth_error", "windows", "held_out", apart.item].value == pytest.approx(0.0, abs=1e-6)
    assert found["camera_pitch_error", "windows", "held_out", "film hidden"].value == pytest.approx(10.0)
    assert found["camera_pitch_error", reconstruction.LEVEL, "held_out", "film hidden"].value == pytest.approx(0.0)
    items = result.items[""]
    assert list(items.takes) == ["hidden"] * 2 * (FRAMES - 1)
    np.testing.assert_allclose(items.times_s, np.tile(np.arange(1, FRAMES) / RATE_HZ, 2))


def test_people_of_film_are_scored_by_the_clock_of_the_take(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second of film is two seconds of the take, which covers 5 of its 8 frames; person 7 is A, person 3 is B."""
    takes, videos, poses = put_truth(store, "op14_m")
    frames = np.arange(8)
    camera = GroundTruth.read(store, [], [videos[1].ref]).cameras["film hidden"]
    aligned = FilmAlignment(camera, person_ids=(7, 3), offset_s=0.1, rate=2.0, residual=0.01)
    asked: list[Any] = []
    monkeypatch.setattr(reconstruction, "align_film", lambda *given: asked.append(given) or aligned)
    film = {"sequence_id": ["film"] * 16, "person_id": np.repeat([3, 7], 8), "frame": np.tile(frames, 2)}
    film |= {"time_s": film["frame"] / RATE_HZ}
    seen = random_columns("annotations", 16) | film | {"partner_id": np.repeat([7, 3], 8)}
    seen |= {"op14_px": np.zeros((16, 14, 2)), "image_width_px": [640] * 16, "image_height_px": [480] * 16}
    seen |= {"op14_confidence": np.ones((16, 14))}
    facts = {"kind": "sequences", "sequence_ids": ["film"], "takes": ["hidden"], "num_persons": 2, "rate_hz": RATE_HZ}
    video = put(store, "ingest", "film", {"annotations": seen | {"focal_px": [500.0] * 16}}, facts)
    true = poses["hidden"][np.minimum(2 + 2 * frames, FRAMES - 1)] @ TURNS["film hidden"].T
    found_m = np.stack([true[:, 1] + [0.0, 0.0, 0.4], true[:, 0]], axis=1)
    motions = put_motions(store, "film", {"windows": found_m}, person_ids=(3, 7), inputs=(video,), pitch_deg=12.0)
    manifests = {"motions": [motions], "annotations": [*videos, video], "poses": takes}
    (shard,) = reconstruction.TOPIC.plan(StageInputs(manifests=manifests, seed=3), reconstruction.Parameters())
    result = reconstruction.TOPIC.compute(shard, store)
    assert result.notes == [aligned.in_words()]
    ((tracks, motion_m, rate_hz),) = asked
    assert ([track.person_id for track in tracks], rate_hz) == ([3, 7], RATE_HZ)
    np.testing.assert_allclose(motion_m, poses["hidden"])
    scores = {name[::3]: score for name, score in by_name(result.scores).items() if name[1] in ("windows", "truth")}
    assert {score.split for score in result.scores} == {"annotated"}
    for item in ("film person 3", "film person 7"):
        assert scores["error_root_kept", item].value == pytest.approx(0.0, abs=1e-6)
        assert scores["error_root_kept", item].count == 5
    assert scores["pair_depth_error", "film person 3 with 7"].value == pytest.approx(0.4, abs=1e-6)
    figures = {"clock_offset": (0.1, "s"), "clock_rate": (2.0, ""), "image_residual": (0.01, "")}
    figures |= {"camera_pitch_error": (12.0, "deg")}
    for metric, figure in figures.items():
        assert (scores[metric, "film"].value, scores[metric, "film"].unit) == pytest.approx(figure)
    assert list(result.items[""].takes) == ["hidden"] * 10
    np.testing.assert_allclose(result.items[""].times_s, np.tile([0.1, 0.2, 0.3, 0.4, 0.5], 2))
    monkeypatch.setattr(reconstruction, "align_film", lambda *_: replace(aligned, person_ids=(8, 9)))
    notes = reconstruction.TOPIC.compute(shard, store).notes
    assert notes == ["film: nobody of its take was reconstructed; no scores."]


def test_what_is_shown_of_a_reconstruction_is_its_last_method_with_the_image_of_each_person(store: Store) -> None:
    takes, videos, poses = put_truth(store, "op14_m")
    motions = put_motion(store, poses, 0.3)
    people, truth, _ = reconstruction.read_reconstructed(store, motions.ref, [videos[1].ref], [takes[1].ref])
    keypoints = reconstruction._read_keypoints(store, [videos[1].ref], "film hidden")
    assert keypoints.keys() == {(person, frame) for person in (0, 1) for frame in range(FRAMES - 1)}
    np.testing.assert_array_equal(keypoints[1, 2], (np.arange(28.0) + 5 * 28).reshape(14, 2))
    late = [people[0], _without_first(people[1])]
    shown = reconstruction._shown("film hidden", late, keypoints, truth.cameras["film hidden"], rate_hz=RATE_HZ)
    assert shown.rate_hz == RATE_HZ
    px, found, true = shown.keypoints_px, shown.found_m, shown.truth_m
    np.testing.assert_array_equal(px[2, 1], keypoints[1, 2])
    assert np.isnan(px[0, 1]).all()
    assert np.isnan(found[0, 1]).all()
    np.testing.assert_allclose(np.linalg.norm(found[1:, 1] - true[1:, 1], axis=-1), 0.3, atol=1e-6)
    np.testing.assert_allclose(found[:, 0], true[:, 0], atol=1e-6)


def _without_first(person: Any) -> Any:
    found = {name: values[1:] for name, values in person.found_m.items()}
    return replace(
        person, truth_m=person.truth_m[1:], found_m=found, frames=person.frames[1:], times_s=person.times_s[1:]
    )


class Features:
    """A stand-in for the classifier: features are two numbers of a clip, and it knows who is on the right."""

    labels = ("left", "right")

    def features(self, clips: np.ndarray) -> np.ndarray:
        return np.asarray(clips, dtype=np.float64)[:, 0, 0, :2, 0]

    def accuracy(self, clips: Mapping[str, np.ndarray]) -> float:
        right = {kind: (found[:, 0, 0, 0, 0] > 0) == (kind == "right") for kind, found in clips.items()}
        return 100.0 * float(np.concatenate(list(right.values())).mean())


def clips(number: int, count: int, middle: float = 0.0) -> np.ndarray:
    return np.random.default_rng(number).normal(middle, 1.0, (count, 20, 2, 22, 3))


def test_models_are_compared_with_what_the_solver_made_of_the_other_half() -> None:
    clips_of = {
        name: [
            _Clips("left" if at % 2 else "right", f"take {at}", clips(10 * at + number, 2 + at % 3, middle))
            for at in range(12)
        ]
        for number, (name, middle) in enumerate({"solver": 0.0, "model": 2.0}.items())
    }
    first, second = [0, 3, 4, 7, 8, 11], [1, 2, 5, 6, 9, 10]
    found = by_name(_compare(Features(), clips_of, first, second, split="s test", item="all"))  # type: ignore[arg-type]
    real = np.concatenate([clips_of["solver"][at].clips[:, 0, 0, :2, 0] for at in second])
    units = [f"take {at}" for at in second for _ in range(2 + at % 3)]
    for name in ("solver", "model"):
        generated = np.concatenate([clips_of[name][at].clips[:, 0, 0, :2, 0] for at in first])
        generated_units = [f"take {at}" for at in first for _ in range(2 + at % 3)]
        figures = distances(real, generated)
        for metric, value in figures.items():
            assert found[metric, name, "s test", "all"].value == pytest.approx(value)
            assert found[metric, name, "s test", "all"].count == len(generated)
        low, high = kernel_interval(real, generated, units, generated_units)
        kid = found["KID", name, "s test", "all"]
        assert (kid.low, kid.high) == pytest.approx((KID_FACTOR * low, KID_FACTOR * high))
        right = [((clip.clips[:, 0, 0, 0, 0] > 0) == (clip.kind == "right")) for clip in clips_of[name]]
        share = found["recognised", name, "s test", "all"]
        assert share.value == pytest.approx(100.0 * np.concatenate(right).mean())
        assert (share.unit, share.count) == ("%", 36)
    alone = by_name(_compare(Features(), clips_of, first, [], split="s test", item="all"))  # type: ignore[arg-type]
    assert {metric for metric, *_ in alone} == {"recognised"}


class Interactions(Features):
    """A stand-in for the classifier of these interactions."""

    labels, digest = ("waltz", "hug"), "0" * 8

    def __init__(self, real: Mapping[str, np.ndarray]) -> None:
        self.learned = {kind: found.shape for kind, found in real.items()}


def test_a_model_equal_to_the_solver_scores_as_the_solver(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variant v0 equals its take, and so does a copy.  The held-out take is not learned from."""
    classifiers: list[Interactions] = []
    monkeypatch.setattr(
        "pasdedeux.learning.networks.clip_classifier.train_classifier",
        lambda real, *_: classifiers.append(Interactions(real)) or classifiers[-1],
    )
    names = ("waltz", "hug", "judo")
    stored = [put_clips(store, name, 1, 90, ["v0"], is_held_out=name == "judo") for name in names]
    takes, variants = ([manifests_of[at] for manifests_of in stored] for at in range(2))
    model = put_model(store, CopyModel(), "random", takes, {name: ["v0"] for name in names})
    manifests = {"models": [model], "poses": takes, "variants": variants}
    settings = realism.LearnedSettings(num_realism_variants=3)
    inputs = StageInputs(manifests=manifests, seed=3)
    (shard,) = realism.TOPIC.plan(inputs, settings)
    result = realism.TOPIC.compute(shard, store)
    assert classifiers[0].learned == {"waltz": (3, 20, 2, 22, 3), "hug": (3, 20, 2, 22, 3)}
    found = by_name(result.scores)
    assert {score.split for score in result.scores} == {"random test"}
    for (metric, method, split, item), score in found.items():
        twin = found[metric, "copy" if method == "solver" else "solver", split, item]
        assert (score.value, score.count, score.low) == pytest.approx((twin.value, twin.count, twin.low), nan_ok=True)
    assert found["recognised", "copy", "random test", "all"].count == 6, "3 clips of each kind that it knows"
    assert result.notes[-1] == "Split random: the classifier learned from 2 of the 3 test takes."
    assert result.notes[-2] == "Takes of the classifier: hug, waltz."
    assert realism.TOPIC.plan(inputs, realism.LearnedSettings()) == []
    (one_kind,) = realism.TOPIC.plan(StageInputs(manifests=manifests | {"poses": takes[1:]}, seed=3), settings)
    skipped = realism.TOPIC.compute(one_kind, store)
    assert (list(skipped.scores), len(skipped.notes), len(classifiers)) == ([], 1, 1)


def test_generated_motion_is_compared_with_half_of_the_real_clips_of_its_takes() -> None:
    names = [f"take {number}" for number in range(6)]
    real = {name: clips(number, 2) for number, name in enumerate(names)} | {"elsewhere": clips(7, 5)}
    kinds = dict.fromkeys(names, "waltz") | {"elsewhere": "hug"}
    generated = {
        "model": {name: [real[name] + 1.0, real[name] + 2.0] for name in names},
        "solver": {name: [real[name]] for name in names[1:]},
    }

    def compared(real: Mapping[str, np.ndarray], generated: Mapping[str, Any]) -> list[Score]:
        classifier: Any = Features()
        return distribution_scores(classifier, real, kinds, generated, np.random.default_rng(0), split="s test")

    scores = compared(real, generated)
    found = by_name(scores)
    assert {score.method for score in scores} == {"real_halves", "strangers", "model"}, "the solver lacks a take"
    assert {score.split for score in scores} == {"s test"}
    assert {score.count for score in scores} == {6}
    # Both motions of a take are a metre apart in each of two features, at every time.
    assert found["multimodality", "model", "s test", "all"].value == pytest.approx(np.sqrt(2.0))
    assert ("multimodality", "real_halves", "s test", "all") not in found
    diversity = found["diversity", "model", "s test", "all"].value
    assert 0.5 < diversity / found["diversity", "real_halves", "s test", "all"].value < 2.0
    assert found["FID", "model", "s test", "all"].value > found["FID", "real_halves", "s test", "all"].value + 1.0
    kid = found["KID", "model", "s test", "all"]
    assert kid.low < kid.value < kid.high
    assert kid.value > found["KID", "real_halves", "s test", "all"].high
    assert compared({"a": clips(1, 2)}, {"model": {"a": [clips(4, 2)]}}) == []


def test_the_truth_is_read_with_its_cameras_and_frames(store: Store) -> None:
    takes, videos, poses = put_truth(store)
    truth = GroundTruth.read(store, [manifest.ref for manifest in takes], [manifest.ref for manifest in videos])
    np.testing.assert_allclose(truth.takes["hidden"], poses["hidden"], atol=1e-6)
    assert truth.held_out == {"hidden"}
    assert truth.frames["film seen", 0] == ("seen", 1)
    assert len(truth.frames) == 2 * (FRAMES - 1)
    camera = truth.cameras["film hidden"]
    assert isinstance(camera, PinholeCamera)
    assert (camera.focal_px, camera.image_size_px) == (500.0, (640, 480))
    np.testing.assert_allclose(camera.camera_from_world_rotmat, TURNS["film hidden"])
    np.testing.assert_allclose(camera.position_m, [0.0, 1.0, 4.0])
    assert truth.where([("seen", 0), ("hidden", 4)]) == (["seen", "hidden"], [0.0, 4 / RATE_HZ])
    json.dumps(truth.where([("seen", 1)]))


def test_errors_of_models_are_means_over_variants_of_one_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(models, "curve_figure", lambda panels, **more: drawn.append((panels, more)) or b"")
    errors = {"copy": [{"E_r": value} for value in (1.0, 3.0, 5.0, 9.0)]}
    models.model_figure([0.8, 0.81, 1.2, 1.24], errors, baselines=["copy"], split="cross_scale")
    (([panel], more),) = drawn
    at, values = panel.curves["copy"]
    np.testing.assert_allclose(at, [0.8, 1.2, 1.25])
    np.testing.assert_allclose(values, [2.0, 5.0, 9.0])
    assert (more["title"], panel.baselines) == ("models on cross scale test variants", ["copy"])


def test_drifts_of_contacts_are_told_apart_by_hands_and_bodies_over_all_variants() -> None:
    found = {"interaction_mesh": np.array([[0.01, 0.5, 0.7], [0.03, 0.1, 0.3]]), "naive_fk": np.full((2, 3), 0.2)}
    drifts = augmentation.ContactDrifts(np.array([True, False, False]), np.arange(3), found)
    scores = by_name(augmentation.contact_scores(drifts, item="waltz"))
    assert {(item, score.unit) for (*_, item), score in scores.items()} == {("waltz", "m")}
    values = {(metric, method): (score.value, score.count) for (metric, method, *_), score in scores.items()}
    for name, mine, count in (("hand", [0.01, 0.03], 2), ("body", [0.1, 0.3, 0.5, 0.7], 4)):
        for which, share in (("median", 50.0), ("p95", 95.0), ("worst", 100.0)):
            metric = f"{name}_contact_drift_{which}"
            assert values[metric, "interaction_mesh"] == (pytest.approx(np.percentile(mine, share)), count)
            assert values[metric, "naive_fk"] == (pytest.approx(0.2), count)
    bodies = augmentation.ContactDrifts(np.zeros(3, dtype=bool), np.arange(3), found)
    metrics = {score.metric for score in augmentation.contact_scores(bodies, item="waltz")}
    assert metrics == {f"body_contact_drift_{which}" for which in ("median", "p95", "worst")}
