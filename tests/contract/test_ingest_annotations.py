"""2D poses through ingest: every format, damaged frames, a wrong layout, and how a source is judged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store
from tasks.stage.facts import SequenceFacts
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.rigs import SMALL_BVH
from tests.builders.source_samples import coco_text, csv_text, openpose_text


def name_of(frame: int) -> str:
    return f"walk_{frame:012d}_keypoints.json"


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Return an OpenPose folder of two people in COCO-18, 6 frames."""
    (tmp_path / "walk").mkdir()
    write_frames(tmp_path / "walk", 6)
    return tmp_path / "walk"


def write_frames(folder: Path, count: int) -> None:
    for frame in range(count):
        (folder / name_of(frame)).write_text(openpose_text("coco18", people=2, seed=frame, missing=(4,)))


def ingested(store: Store, walk: Path, **options: Any) -> Manifest:
    (made,) = run(store, planned(annotations=[{"id": "walk", "path": walk, **options}])).values()
    return made


def test_2d_poses_of_every_format_become_annotations(store: Store, walk: Path, tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(coco_text())
    (tmp_path / "t.csv").write_text(csv_text())
    stated = {"camera_height_m": 1.5, "statures_m": [[0, 1.8]], "licence": "mine", "credit": "me"}
    others = [{"id": "coco", "path": tmp_path / "c.json"}, {"id": "table", "path": tmp_path / "t.csv"}]
    manifests = run(store, planned(annotations=[{"id": "walk", "path": walk, "rate_hz": 25.0, **stated}, *others]))
    made = manifests["walk", "annotations"]
    facts = SequenceFacts.of(made)
    assert (facts.purpose, facts.takes, facts.num_frames, facts.num_persons) == ("given", (), 6, 2)
    assert (facts.camera_height_m, facts.statures_m) == (1.5, {0: 1.8})
    assert made.sources[0].licence == "mine"
    rows = store.read(made.ref, "annotations")
    assert rows.num_rows == 12
    assert np.isnan(rows["op14_px"][:, OP14.index("right_wrist")]).all()
    assert (rows["op14_confidence"][:, OP14.index("right_wrist")] == 0).all()
    np.testing.assert_allclose(rows["time_s"][-1], 5 / 25.0)
    assert manifests["table", "annotations"].facts["rate_hz"] == 25.0
    coco = store.read(manifests["coco", "annotations"].ref, "annotations")
    assert set(coco["layout"]) == {"coco17"}


def test_unreadable_files_are_named_or_skipped_and_counted_where_the_study_says_so(store: Store, walk: Path) -> None:
    whole = judged(ingested(store, walk))
    assert whole.level is Level.PASS
    assert 80 < whole.value < 100
    (walk / name_of(3)).write_text('{"version": 1.3, "people": [{"pose_keypoints_2d": [1, 2')
    with pytest.raises(InputError, match=rf'walk: {name_of(3)}: .*\(set on_unreadable = "skip" to go on without it\)$'):
        planned(annotations=[{"id": "walk", "path": walk}])
    made = ingested(store, walk, on_unreadable="skip")
    assert sorted(set(store.read(made.ref, "annotations")["frame"].tolist())) == [0, 1, 2, 4, 5]
    assert (made.facts["num_skipped_frames"], made.facts["skipped_files"]) == (1, [name_of(3)])
    verdict = judged(made)
    assert (verdict.level, verdict.reason) == (Level.WARN, "1 of 6 frames could not be read and were skipped")
    for path in walk.iterdir():
        path.write_text("{")
    with pytest.raises(InputError, match="nobody was detected"):
        planned(annotations=[{"id": "walk", "path": walk, "on_unreadable": "skip"}])


def test_an_empty_folder_and_a_missing_one_are_named(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    with pytest.raises(InputError, match=f"^annotations walk: file {walk} does not exist$"):
        planned(annotations=[{"id": "walk", "path": walk}])
    walk.mkdir()
    with pytest.raises(InputError, match=f"^annotations walk: folder {walk} holds no files of 2D poses .*csv, .*xml"):
        planned(annotations=[{"id": "walk", "path": walk}])


def test_numbers_in_names_of_files_are_their_frames_and_what_is_before_them_changes_nothing(
    store: Store, walk: Path
) -> None:
    write_frames(walk, 8)
    section = {"annotations": [{"id": "walk", "path": walk}]}
    (before,) = planned(**section)
    for path in sorted(walk.iterdir()):
        path.rename(path.with_name(path.name.replace("walk_", "stroll_")))
    (after,) = planned(**section)
    assert after.key == before.key
    (walk / name_of(7).replace("walk", "stroll")).rename(walk / name_of(30).replace("walk", "stroll"))
    made = ingested(store, walk)
    assert made.ref.key != before.key
    assert sorted(set(store.read(made.ref, "annotations")["frame"].tolist())) == [*range(7), 30]


def test_two_cameras_of_a_folder_are_two_sequences_with_their_lens(store: Store, walk: Path) -> None:
    for frame in range(6):
        (walk / name_of(frame).replace("walk_", "side_")).write_text(openpose_text("coco18", people=2, seed=frame))
    source = {"id": "walk", "path": walk, "image_size_px": [640, 480], "fov_deg": 90.0, "rate_hz": 20.0}
    made = run(store, planned(annotations=[source]))
    assert {partition for partition, _ in made} == {"walk.side", "walk.walk"}
    for manifest in made.values():
        rows = store.read(manifest.ref, "annotations")
        np.testing.assert_allclose(rows["focal_px"], 320.0)
        assert max(rows["time_s"]) == pytest.approx(5 / 20.0)


def test_a_preview_takes_the_first_frames_of_each_sequence_and_of_the_table_of_who_is_who(
    store: Store, walk: Path, tmp_path: Path
) -> None:
    (walk / name_of(5)).write_text(openpose_text("coco18", people=3, seed=5))
    (tmp_path / "people.csv").write_text(
        "sequence,first_frame,last_frame,person,is\n"
        "walk,0,3,0,1\nwalk,0,3,1,0\nwalk,4,5,0,0\nwalk,4,5,1,1\nwalk,0,5,2,nobody\n"
    )
    source = {"id": "walk", "path": walk, "rate_hz": 25.0, "people_file": tmp_path / "people.csv"}
    whole, short = (
        run(store, planned(annotations=[source], take_seconds=seconds))["walk", "annotations"]
        for seconds in (None, 0.12)
    )
    assert (whole.facts["num_frames"], short.facts["num_frames"]) == (6, 3)
    rows = store.read(short.ref, "annotations")
    assert rows["frame"].tolist() == [0, 0, 1, 1, 2, 2]


def test_every_so_many_th_moment_is_left_out_of_what_draws_are_made_from(store: Store, walk: Path) -> None:
    write_frames(walk, 61)
    source = {"id": "walk", "path": walk, "rate_hz": 30.0, "leave_one_out_every": 2}
    view = {"num_random_views": 7, "leave_one_out_every": 3}
    shards = planned(annotations=[source], duets=[{"name": "hug", "duration_s": 1.0}], virtual_video=view)
    made = run(store, [shard for shard in shards if shard.name != "video"])
    frames, views = (
        store.read(made[name].ref, "annotations", columns=["sequence_id", "frame", "is_held_out"])
        for name in (("walk", "annotations"), ("hug", "random_views"))
    )
    assert set(frames["frame"][frames["is_held_out"]]) == {*range(30, 60)}
    assert len(set(views["sequence_id"])) == 7
    assert set(views["sequence_id"][views["is_held_out"]]) == set(sorted(set(views["sequence_id"]))[1::3])


def test_a_large_source_is_read_when_its_shard_runs_and_a_small_one_while_planning(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.json"
    path.write_text(coco_text()[:-30])
    with pytest.raises(InputError, match=r"annotations c: c.json: .*not valid JSON"):
        planned(annotations=[{"id": "c", "path": path}])
    monkeypatch.setattr("tasks.ingest.poses2d.resolution._MAX_PLANNED_BYTES", path.stat().st_size - 1)
    shards = planned(annotations=[{"id": "c", "path": path}])
    with pytest.raises(InputError, match=r"c.json: .*not valid JSON"):
        run(store, shards)


def test_a_plan_shows_what_readers_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.bvh").write_text(SMALL_BVH.replace("Frames: 4", "Frames: 3"))
    content = json.loads(coco_text())
    for image in content["images"]:
        image |= {"width": 6400, "height": 6400}
    (tmp_path / "c.json").write_text(json.dumps(content))
    study = tmp_path / "mine.toml"
    study.write_text(
        '[study]\nname = "mine"\n[ingest]\ntakes = [{ id = "t", files = ["a.bvh"] }]\n'
        'annotations = [{ id = "c", path = "c.json" }]\n'
    )
    asked = ["plan", str(study), "--store", str(tmp_path / "store"), "--only", "ingest"]
    assert run_command_line(asked) == 0
    said = capsys.readouterr().out
    assert "note: t: a.bvh: it states 3 frames and holds 4, which are read" in said
    assert "note: c: the keypoints of 'c' lie in a quarter of the image" in said
    assert "note: c: keypoints without names taken as 'coco17'" in said
    assert run_command_line([*asked, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["notes"]) == 3
