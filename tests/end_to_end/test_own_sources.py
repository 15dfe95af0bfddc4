"""A user's own sources go through every stage: a walk of one person, and a duet filmed and detected in 2D."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from flows.console.study_new import write_new_study
from pasdedeux.skeletons import OP14
from storage_schema import Store, open_table, read_latest
from tests.builders.own_sources import FilmedDuet, film_duet, write_coco, write_csv, write_openpose, write_walk
from tests.builders.real_study import STUDIES, build_here, call_in_process, graph
from tests.builders.toy_runs import run_toys

pytestmark = pytest.mark.slow

GIVEN = ("detected", "known", "labelled", "table")
UNREADABLE = "detected_000000000005_keypoints.json"


@dataclass(frozen=True)
class Own:
    """The study, its store, its report and the truth behind the 2D poses."""

    study: Path
    store: Path
    report: str
    card: str
    duet: FilmedDuet


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Own:
    """Build the study in this process."""
    folder = tmp_path_factory.mktemp("own")
    duet = film_duet("hug", duration_s=1.5, rate_hz=12.0)
    write_walk(folder)
    write_openpose(folder / "detected", duet, "body25")
    (folder / "detected" / UNREADABLE).write_text('{"people": [')
    write_openpose(folder / "known", duet, "coco18")
    write_coco(folder / "labelled.json", duet)
    write_csv(folder / "table.csv", duet)
    study, store = Path(shutil.copy(STUDIES / "own.toml", folder)), folder / "store"
    build_here(study, store)
    (report,) = (store / "runs").glob("*/report")
    return Own(study, store, (report / "report.html").read_text(), (report / "card.md").read_text(), duet)


def test_a_walk_of_one_person_stands_upright_and_moves_at_its_true_size(own: Own) -> None:
    takes = open_table("takes:own/walk", own.store)
    assert (takes.num_rows, list(takes["layout"]), list(takes["source_format"])) == (1, ["cmu_asf"], ["asf_amc"])
    np.testing.assert_allclose(takes["source_rate_hz"], 120.0)
    poses = open_table("poses:own/walk", own.store)
    op14 = poses["op14_m"]
    assert len(op14) == 12
    head, left, right = (op14[:, OP14.index(name)] for name in ("head", "left_ankle", "right_ankle"))
    assert np.all(head[:, 1] > 1.4)
    assert np.all(head[:, 1] < 1.8)
    assert np.all(np.minimum(left[:, 1], right[:, 1]) < 0.35)
    assert poses["op14_m"][-1, 0, 2] - poses["op14_m"][0, 0, 2] == pytest.approx(1.2 * 11 / 12, abs=0.05)
    assert np.all(op14[:, OP14.index("left_shoulder"), 0] > op14[:, OP14.index("right_shoulder"), 0])


def test_stages_that_need_pairs_skip_the_walk_and_the_report_says_so(own: Own) -> None:
    latest = read_latest(Store(own.store), "own")
    assert latest is not None
    for stage in ("seeds", "chains"):
        takes = {take for ref in latest.refs(stage) for take in Store(own.store).manifest(ref).facts["takes"]}
        assert "walk" not in takes - set(prior_takes(own)), stage
    assert "walk" in set(open_table("variants:own", own.store)["take_id"])
    assert "walk" in set(open_table("projections:own", own.store)["take_id"])
    assert "Take walk: 1 person" in own.report
    assert "Take walk: 1 person" in own.card
    assert "walk.video00: 12 frames skipped, nobody has a partner" in own.report


def prior_takes(own: Own) -> list[str]:
    (priors,) = Store(own.store).artifacts("priors")
    return list(priors.facts["takes"])


def test_what_was_unreadable_or_not_reconstructed_is_said(own: Own) -> None:
    for text in (own.report, own.card):
        assert UNREADABLE in text
        assert "table, person 2" in text


@pytest.mark.parametrize("sequence", GIVEN)
def test_given_2d_poses_become_upright_motions_near_the_truth_and_not_mirrored(own: Own, sequence: str) -> None:
    motions = open_table(f"motions:own/{sequence}", own.store)
    assert set(motions["person_id"]) == {0, 1}
    last = list(dict.fromkeys(motions["method"]))[-1]
    for person in (0, 1):
        rows = (motions["person_id"] == person) & (motions["method"] == last)
        moved = motions["op14_m"][rows].astype(np.float64)
        frames = motions["frame"][rows]
        assert frames.tolist() == list(range(18))
        np.testing.assert_allclose(motions["time_s"][rows], frames / 12.0, atol=1e-6)
        truth = own.duet.op14_m[frames, person] @ own.duet.camera.camera_from_world_rotmat.T
        error = {side: error_m(moved, points) for side, points in (("true", truth), ("mirrored", mirrored(truth)))}
        assert error["true"] < 0.2, error
        assert error["true"] < error["mirrored"], error
        assert np.all(moved[:, OP14.index("head"), 1] > moved[:, OP14.index("left_ankle"), 1] + 0.8)


def test_given_sequences_are_pictured_in_the_report_and_scored_where_their_take_is_known(own: Own) -> None:
    (report,) = (own.store / "runs").glob("*/report")
    for sequence in GIVEN:
        assert (report / f"reconstruction-{sequence}.player.json").is_file()
        caption = "2D poses and their reconstruction" if sequence == "known" else "reconstructed"
        assert f"{sequence}: {caption} (" in own.report
    assert own.report.count("a video without ground truth; no scores.") == 1
    scores = open_table("scores:own", own.store)
    items = {item for topic, item in zip(scores["topic"], scores["item"], strict=True) if topic == "reconstruction"}
    people = ("person 0", "person 1", "person 0 with 1")
    videos = {"hug.video00", "known"}
    assert items == videos | {f"{video} {person}" for video in videos for person in people}


def error_m(positions: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean distance over frames and joints, mid-hips laid on each other."""
    hips = OP14.indices(["left_hip", "right_hip"])
    centred = [points - points[:, hips].mean(axis=1, keepdims=True) for points in (positions, truth)]
    return float(np.linalg.norm(centred[0] - centred[1], axis=-1).mean())


def mirrored(points: np.ndarray) -> np.ndarray:
    """Return what an exchange of left and right would make of the points."""
    names = [name.replace("left", "?").replace("right", "left").replace("?", "right") for name in OP14.joint_names]
    return points[:, OP14.indices(names)]


def test_nothing_learned_from_a_take_that_a_video_is_known_to_show(own: Own) -> None:
    (motions,) = [m for m in Store(own.store).artifacts("reconstruction") if m.partition == "known"]
    assert motions.facts["sequence_takes"] == ["hug"]
    assert "hug" not in motions.facts["database_takes"]
    for manifest in Store(own.store).artifacts("chains"):
        assert "hug" not in manifest.facts["takes"]


def test_every_given_sequence_has_a_clip_and_every_source_a_line_in_the_card(own: Own) -> None:
    (report,) = (own.store / "runs").glob("*/report")
    clips = {path.name.removesuffix(".player.json") for path in report.glob("clip-*")}
    assert {f"clip-{name}" for name in GIVEN} <= clips
    assert "clip-walk.video00" in clips
    for line in ("CC BY 4.0", "Filmed by us", "CC0-1.0", "From mocap.cs.cmu.edu", "pasdedeux built-in duets"):
        assert line in own.card, line


def test_the_lineage_ends_at_the_source_files(own: Own, capsys: pytest.CaptureFixture[str]) -> None:
    shown = call_in_process(capsys, "show", "motions:own", "--store", own.store, "--json").json
    names = {file["name"] for file in shown["files"]}
    assert {"90_01.amc", "90.asf", "labelled.json", "table.csv"} <= names
    assert len([name for name in names if name.startswith("detected_")]) == 18
    assert all(len(file["sha256"]) == 64 for file in shown["files"])


def test_one_changed_source_file_is_named_and_rebuilds_what_rests_on_it(
    own: Own, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Path(shutil.copytree(own.store, tmp_path / "store"))
    path = own.study.with_name("labelled.json")
    before = path.read_text()
    path.write_text(before.replace('"track_id": 0', '"track_id": 7'))
    try:
        answer = call_in_process(capsys, "plan", own.study, "--store", store, "--json")
        computed = build_here(own.study, store)
    finally:
        path.write_text(before)
    stages = {stage["stage"]: stage for stage in answer.json["stages"]}
    unfinished = [shard for shard in stages["ingest"]["shards"] if shard["state"] != "fresh"]
    assert [(shard["partition"], shard["state"], shard["reason"]) for shard in unfinished] == [
        ("labelled", "stale", "file labelled.json changed")
    ]
    assert {stage["state"] for name, stage in stages.items() if name != "ingest"} == {"pending"}
    assert (computed["ingest"], computed["views"], computed["reconstruction"]) == (1, 1, 1)
    assert computed["chains"] == 2, "a segment and a summary of the density that looks at annotations"
    untouched = ("priors", "seeds", "projections", "augmentation", "training")
    assert {name: computed[name] for name in untouched} == dict.fromkeys(untouched, 0)


def test_a_new_study_of_2d_poses_alone_gives_3d(own: Own, tmp_path: Path) -> None:
    study = tmp_path / "video.toml"
    write_new_study(study, [own.study.with_name("labelled.json")])
    small = ("seeds.num_lifted=3", "seeds.num_grown=10", "chains.num_draws=4", "chains.num_candidates=8")
    outcome = run_toys(study, tmp_path / "store", *small, graph=graph())
    assert outcome.missing == ()
    for table in ("seeds", "draws", "lifted_pairs", "projections", "motions"):
        assert open_table(f"{table}:video", tmp_path / "store").num_rows > 0, table


def test_a_new_study_of_one_person_alone_says_what_it_needs(own: Own, tmp_path: Path) -> None:
    table, study = tmp_path / "one.csv", tmp_path / "one.toml"
    lines = own.study.with_name("table.csv").read_text().splitlines()
    table.write_text("\n".join(line for line in lines if line.split(",")[1:2] not in (["1"], ["2"])))
    write_new_study(study, [table])
    outcome = run_toys(study, tmp_path / "store", graph=graph())
    (missing,) = outcome.missing
    assert missing.startswith("nothing was made by reconstruction: one: there is no projection database without")
    assert "projections.include_draws" in missing


@pytest.mark.parametrize("source", ["90_01.amc", "known", "labelled.json", "table.csv"])
def test_a_new_study_from_a_source_can_be_planned_as_it_is(
    own: Own, tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    study = tmp_path / "mine.toml"
    answer = call_in_process(capsys, "study", "new", study, "--from", own.study.with_name(source))
    assert answer.code == 0, answer.err
    planned = call_in_process(capsys, "plan", study, "--store", tmp_path / "store", "--json")
    assert planned.code == 0, planned.err
    ingest = planned.json["stages"][0]
    assert ingest["stage"] == "ingest"
    assert ingest["shards"]
