"""2D poses that a study cannot be built from: the command line names file and frame in one sentence before any work."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from storage_schema import Store, open_table
from tests.builders.real_study import build_here, refused
from tests.builders.source_samples import openpose_text

STUDY = """
[study]
name = "bad"
stages = ["ingest"]

[ingest]
annotations = [{{ id = "walk", path = "walk"{options} }}]
"""
NUM_FRAMES = 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a study over a good OpenPose folder of two people in COCO-18."""
    (tmp_path / "walk").mkdir()
    for frame in range(NUM_FRAMES):
        (tmp_path / "walk" / name_of(frame)).write_text(openpose_text("coco18", people=2, seed=frame))
    write_study(tmp_path)
    return tmp_path


def name_of(frame: int) -> str:
    return f"walk_{frame:012d}_keypoints.json"


def write_study(folder: Path, options: str = "") -> Path:
    study = folder / "bad.toml"
    study.write_text(STUDY.format(options=options))
    return study


def test_an_unreadable_openpose_file_is_named_with_what_can_be_done(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "walk" / name_of(3)).write_text('{"version": 1.3, "people": [{"pose_keypoints_2d": [1, 2')
    found = refused(capsys, folder / "bad.toml")
    assert found.startswith(f"annotations walk: {name_of(3)}: ")
    assert found.endswith('(set on_unreadable = "skip" to go on without it)')


def test_unreadable_openpose_files_are_skipped_and_counted_when_the_study_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for frame in (3, 5):
        (folder / "walk" / name_of(frame)).write_text("{")
    study = write_study(folder, ', on_unreadable = "skip"')
    build_here(study, folder / "store")
    rows = open_table("annotations:bad", folder / "store")
    assert sorted(set(rows["frame"].tolist())) == [0, 1, 2, 4, 6, 7]
    (manifest,) = Store(folder / "store").artifacts()
    assert manifest.facts["num_skipped_frames"] == 2
    assert manifest.facts["skipped_files"] == [name_of(3), name_of(5)]


def test_a_folder_of_nothing_but_unreadable_files_is_refused_even_when_they_are_skipped(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for frame in range(NUM_FRAMES):
        (folder / "walk" / name_of(frame)).write_text("{")
    write_study(folder, ', on_unreadable = "skip"')
    assert "nobody was detected" in refused(capsys, folder / "bad.toml")


def test_an_empty_folder_and_a_missing_one_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(folder / "walk")
    assert refused(capsys, folder / "bad.toml") == f"annotations walk: file {folder / 'walk'} does not exist"
    (folder / "walk").mkdir()
    assert (
        refused(capsys, folder / "bad.toml")
        == f"annotations walk: folder {folder / 'walk'} holds no files of 2D poses (.csv, .json, .npz, .txt, .xml)"
    )


def test_a_renamed_openpose_file_is_another_frame_and_so_another_artifact(folder: Path) -> None:
    build_here(folder / "bad.toml", folder / "store")
    (folder / "walk" / name_of(7)).rename(folder / "walk" / name_of(30))
    assert build_here(folder / "bad.toml", folder / "store") == {"ingest": 1}
    rows = open_table("annotations:bad", folder / "store")
    assert sorted(set(rows["frame"].tolist())) == [0, 1, 2, 3, 4, 5, 6, 30]


def test_another_name_of_the_sequence_in_front_of_the_numbers_changes_nothing(folder: Path) -> None:
    build_here(folder / "bad.toml", folder / "store")
    for path in sorted((folder / "walk").iterdir()):
        path.rename(path.with_name(path.name.replace("walk_", "stroll_")))
    assert build_here(folder / "bad.toml", folder / "store") == {"ingest": 0}


def test_two_cameras_of_a_folder_are_two_sequences_with_their_lens(folder: Path) -> None:
    for frame in range(NUM_FRAMES):
        path = folder / "walk" / name_of(frame)
        path.with_name(path.name.replace("walk_", "side_")).write_text(openpose_text("coco18", people=2, seed=frame))
    study = write_study(folder, ", image_size_px = [640, 480], fov_deg = 90.0, rate_hz = 20.0")
    assert build_here(study, folder / "store") == {"ingest": 2}
    rows = open_table("annotations:bad", folder / "store")
    assert set(rows["sequence_id"]) == {"walk.side", "walk.walk"}
    np.testing.assert_allclose(rows["focal_px"], 320.0)
    assert max(rows["time_s"].tolist()) == pytest.approx((NUM_FRAMES - 1) / 20.0)
    assert build_here(study, folder / "store") == {"ingest": 0}
