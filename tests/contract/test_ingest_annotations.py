"""2D poses through ingest: every format, damaged frames, a wrong layout, and how a source is judged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14
from pasdedeux.verdict import Level
from storage_schema import Store
from tasks.stage.facts import SequenceFacts
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.rigs import SMALL_BVH
from tests.builders.source_samples import coco_text, csv_text, openpose_text


def write_openpose(folder: Path, count: int = 6) -> None:
    folder.mkdir()
    for frame in range(count):
        (folder / f"w_{frame:012d}_keypoints.json").write_text(
            openpose_text("coco18", people=2, seed=frame, missing=(4,))
        )


def test_2d_poses_of_every_format_become_annotations(tmp_path: Path) -> None:
    write_openpose(tmp_path / "walk")
    (tmp_path / "c.json").write_text(coco_text())
    (tmp_path / "t.csv").write_text(csv_text())
    store = Store(tmp_path / "store")
    stated = {"camera_height_m": 1.5, "statures_m": [[0, 1.8]]}
    shards = planned(
        annotations=[
            {"id": "walk", "path": tmp_path / "walk", "rate_hz": 25.0, "licence": "mine", "credit": "me", **stated},
            {"id": "coco", "path": tmp_path / "c.json"},
            {"id": "table", "path": tmp_path / "t.csv"},
        ]
    )
    manifests = run(store, shards)
    walk = manifests["walk", "annotations"]
    assert walk.facts["purpose"] == "given"
    assert walk.facts["takes"] == []
    assert (walk.facts["num_frames"], walk.facts["num_persons"]) == (6, 2)
    facts = SequenceFacts.of(walk)
    assert (facts.camera_height_m, facts.statures_m) == (1.5, {0: 1.8})
    assert walk.sources[0].licence == "mine"
    rows = store.read(walk.ref, "annotations")
    assert rows.num_rows == 12
    assert np.isnan(rows["op14_px"][:, OP14.index("right_wrist")]).all()
    assert (rows["op14_confidence"][:, OP14.index("right_wrist")] == 0).all()
    np.testing.assert_allclose(rows["time_s"][-1], 5 / 25.0)
    assert manifests["table", "annotations"].facts["rate_hz"] == 25.0
    coco = store.read(manifests["coco", "annotations"].ref, "annotations")
    assert set(coco["layout"]) == {"coco17"}


def test_a_preview_takes_the_first_frames_of_each_sequence_and_of_the_table_of_who_is_who(tmp_path: Path) -> None:
    write_openpose(tmp_path / "walk")
    last = tmp_path / "walk" / "w_000000000005_keypoints.json"
    last.write_text(openpose_text("coco18", people=3, seed=5))
    (tmp_path / "people.csv").write_text(
        "sequence,first_frame,last_frame,person,is\n"
        "walk,0,3,0,1\nwalk,0,3,1,0\nwalk,4,5,0,0\nwalk,4,5,1,1\nwalk,0,5,2,nobody\n"
    )
    source = {"id": "walk", "path": tmp_path / "walk", "rate_hz": 25.0, "people_file": tmp_path / "people.csv"}
    store = Store(tmp_path / "store")
    whole, short = (
        run(store, planned(annotations=[source], take_seconds=seconds))["walk", "annotations"]
        for seconds in (None, 0.12)
    )
    assert (whole.facts["num_frames"], short.facts["num_frames"]) == (6, 3)
    rows = store.read(short.ref, "annotations")
    assert rows["frame"].tolist() == [0, 0, 1, 1, 2, 2]


def test_2d_poses_are_judged_by_what_is_seen_and_what_was_left_out(tmp_path: Path) -> None:
    write_openpose(tmp_path / "walk")
    section = {"id": "walk", "path": tmp_path / "walk", "on_unreadable": "skip"}
    whole = judged(run(Store(tmp_path / "a"), planned(annotations=[section]))["walk", "annotations"])
    assert whole.level is Level.PASS
    assert 80 < whole.value < 100
    (tmp_path / "walk" / "w_000000000003_keypoints.json").write_text("{")
    cut = judged(run(Store(tmp_path / "b"), planned(annotations=[section]))["walk", "annotations"])
    assert (cut.level, cut.reason) == (Level.WARN, "1 of 6 frames could not be read and were skipped")


def test_every_so_many_th_moment_is_left_out_of_what_draws_are_made_from(tmp_path: Path) -> None:
    write_openpose(tmp_path / "walk", count=61)
    source = {"id": "walk", "path": tmp_path / "walk", "rate_hz": 30.0, "leave_one_out_every": 2}
    view = {"num_random_views": 7, "leave_one_out_every": 3}
    shards = planned(annotations=[source], duets=[{"name": "hug", "duration_s": 1.0}], virtual_video=view)
    store = Store(tmp_path / "store")
    made = run(store, [shard for shard in shards if shard.name != "video"])
    walk, views = (
        store.read(made[name].ref, "annotations", columns=["sequence_id", "frame", "is_held_out"])
        for name in (("walk", "annotations"), ("hug", "random_views"))
    )
    assert {frame for frame, is_out in zip(walk["frame"], walk["is_held_out"], strict=True) if is_out} == {
        *range(30, 60)
    }
    out = {name for name, is_out in zip(views["sequence_id"], views["is_held_out"], strict=True) if is_out}
    assert len(set(views["sequence_id"])) == 7
    assert out == set(sorted(set(views["sequence_id"]))[1::3])


def test_a_large_source_is_read_when_its_shard_runs_and_a_small_one_while_planning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.json"
    path.write_text(coco_text()[:-30])
    with pytest.raises(InputError, match=r"annotations c: c.json: .*not valid JSON"):
        planned(annotations=[{"id": "c", "path": path}])
    monkeypatch.setattr("tasks.ingest.poses2d.resolution._MAX_PLANNED_BYTES", path.stat().st_size - 1)
    shards = planned(annotations=[{"id": "c", "path": path}])
    with pytest.raises(InputError, match=r"c.json: .*not valid JSON"):
        run(Store(tmp_path / "store"), shards)


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
