"""Find sources of 2D poses as users have them: several cameras, a video beside the files, a video in place of files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pasdedeux.errors import InputError
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import FoundAnnotations, find_annotations
from tests.builders.source_samples import (
    coco_text,
    csv_text,
    image_text,
    openpose_text,
    person_px,
    result_texts,
    yolo_text,
)


def found_in(path: Path, **options: Any) -> list[FoundAnnotations]:
    return find_annotations(AnnotationOptions(id="clip", path=path, **options))


def write_frames(folder: Path, front: str = "", count: int = 6, *, layout: str = "coco18") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(count):
        (folder / f"{front}{frame:012d}_keypoints.json").write_text(openpose_text(layout, people=2, seed=frame))
    return folder


def write_video(path: Path, *, rate_hz: float = 12.0, size: tuple[int, int] = (640, 480)) -> None:
    path.parent.mkdir(exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, size)
    for _ in range(3):
        writer.write(np.zeros((size[1], size[0], 3), dtype=np.uint8))
    writer.release()


def test_a_format_keeps_its_former_name(tmp_path: Path) -> None:
    assert AnnotationOptions(id="clip", path=tmp_path, format="mediapipe").format == "points"


def frames_of(source: FoundAnnotations) -> list[int]:
    return sorted(set(source.read().frame.tolist()))


def test_cameras_by_the_beginning_of_names_are_sequences_and_none_vanishes(tmp_path: Path) -> None:
    write_frames(tmp_path, "cam1_", 6)
    write_frames(tmp_path, "cam2_", 4)
    cameras = found_in(tmp_path)
    assert [camera.parameters.id for camera in cameras] == ["clip.cam1", "clip.cam2"]
    assert [frames_of(camera) for camera in cameras] == [list(range(6)), list(range(4))]
    assert [set(camera.read().sequence_id) for camera in cameras] == [{"clip.cam1"}, {"clip.cam2"}]


@pytest.mark.parametrize("num_notes", [1, 20])
def test_texts_beside_files_of_frames_are_notes(tmp_path: Path, num_notes: int) -> None:
    write_frames(tmp_path, count=4)
    for number in range(num_notes):
        (tmp_path / f"note_{number:02d}.txt").write_text(yolo_text(seed=number))
    (source,) = found_in(tmp_path)
    assert (source.parameters.format, frames_of(source)) == ("openpose", list(range(4)))


@pytest.mark.parametrize("beside", ["classes.txt", "film.json.bak"])
def test_a_folder_of_yolos_text_files_is_a_camera_for_each_beginning_of_their_names(
    tmp_path: Path, beside: str
) -> None:
    for camera in (1, 2):
        for frame in range(6):
            (tmp_path / f"cam{camera}_{frame + 1}.txt").write_text(yolo_text(seed=frame))
    (tmp_path / beside).write_text("person")
    cameras = found_in(tmp_path, image_size_px=(640, 480), frame_offset=-1)
    assert [(camera.parameters.id, camera.parameters.format, frames_of(camera)) for camera in cameras] == [
        (camera, "yolo", list(range(6))) for camera in ("clip.cam1", "clip.cam2")
    ]


def test_folders_of_a_folder_are_cameras_as_pose2sim_writes_them(tmp_path: Path) -> None:
    for camera, count in (("cam1", 5), ("cam2", 3)):
        write_frames(tmp_path / "pose" / f"{camera}_json", f"{camera}_", count, layout="halpe26")
        write_video(tmp_path / "videos" / f"{camera}.avi", rate_hz=10.0 + count)
    cameras = found_in(tmp_path / "pose")
    assert [camera.parameters.id for camera in cameras] == ["clip.cam1", "clip.cam2"]
    assert [camera.read().layout for camera in cameras] == ["halpe26"] * 2
    assert [camera.read().rate_hz for camera in cameras] == pytest.approx([15.0, 13.0])


@pytest.mark.parametrize(
    ("tool", "nobody"),
    [
        ("mmpose", "[]"),
        ("mmpose demo", '{"meta_info": {"num_keypoints": 17}, "instance_info": []}'),
        ("ultralytics", '[{"name": "dog", "class": 16, "confidence": 0.8}]'),
    ],
)
def test_a_file_for_each_image_is_a_frame_of_one_sequence_even_where_nobody_is_in_the_first(
    tmp_path: Path, tool: str, nobody: str
) -> None:
    (tmp_path / "img_0007.json").write_text(nobody)
    for frame in (8, 9, 12):
        (tmp_path / f"img_{frame:04d}.json").write_text(image_text(tool, seed=frame))
    (source,) = found_in(tmp_path)
    assert (source.parameters.format, source.parameters.id) == ("image_results", "clip")
    frames = source.read()
    assert sorted(frames.frame.tolist()) == [8, 8, 9, 9, 12, 12]
    shift = np.tile([[[0.0, 0.0]], [[300.0, 0.0]]], (3, 1, 1))
    expected = np.array([person_px("coco17", seed=frame) for frame in (8, 8, 9, 9, 12, 12)]) + shift
    order = np.lexsort((frames.keypoints_px[:, 0, 0], frames.frame))
    np.testing.assert_allclose(frames.keypoints_px[order], expected)
    np.testing.assert_allclose(frames.confidence, 0.9)


def test_files_of_whole_videos_in_a_folder_are_a_sequence_each(tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text(csv_text())
    (tmp_path / "two.json").write_text(coco_text())
    kinds = {source.parameters.id: source.parameters.format for source in found_in(tmp_path)}
    assert kinds == {"clip.one": "annotation_csv", "clip.two": "coco"}


def test_rate_and_size_come_from_the_option_else_the_file_else_the_video_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "walk_keypoints.json"
    path.write_text(result_texts()["detectron2"])
    (found,) = found_in(path)
    assert (found.read().rate_hz, found.read().image_size_px, found.video) == (30.0, {}, None)
    assert "30 frames a second assumed" in found.in_words()
    assert "image size unknown" in found.in_words()
    write_video(tmp_path / "walk.avi")
    write_video(tmp_path / "other.avi", rate_hz=50.0)
    (found,) = found_in(path)
    assert (found.read().rate_hz, found.read().image_size_px) == (pytest.approx(12.0), {"clip": (640, 480)})
    assert "12 frames a second (walk.avi), 640 x 480 (walk.avi)" in found.in_words()
    (found,) = found_in(path, rate_hz=25.0, image_size_px=(640, 480), fov_deg=90.0)
    assert (found.read().rate_hz, found.read().image_size_px) == (25.0, {"clip": (640, 480)})
    assert found.read().focal_px["clip"] == pytest.approx(320.0)
    (tmp_path / "walk.csv").write_text(csv_text())
    (found,) = found_in(tmp_path / "walk.csv")
    assert (found.read().rate_hz, found.read().image_size_px) == (25.0, {"clip": (640, 480)})
    with pytest.raises(InputError, match="a field of view needs the size of the image"):
        found_in(write_frames(tmp_path / "frames"), fov_deg=60.0)


def test_another_rate_of_the_video_beside_is_another_shard(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "walk")
    write_video(tmp_path / "walk.avi")
    (before,) = found_in(folder)
    write_video(tmp_path / "walk.avi", rate_hz=24.0)
    (after,) = found_in(folder)
    assert before.parameters != after.parameters
    assert after.read().rate_hz == pytest.approx(24.0)


@pytest.mark.parametrize("name", ["walk.mp4", "walk.MOV", "photos"])
def test_a_video_and_images_are_answered_with_what_to_run_first(tmp_path: Path, name: str) -> None:
    (tmp_path / "photos").mkdir()
    for path in ("walk.mp4", "walk.MOV", "photos/a.jpg"):
        (tmp_path / path).write_bytes(b"\0")
    with pytest.raises(InputError, match=r"annotated or detected: give key frames \(--keys FILE\), .* or a detector"):
        found_in(tmp_path / name)
    with pytest.raises(InputError, match=r"film .*lost\.mp4 does not exist$"):
        found_in(tmp_path / "lost.mp4")


def test_a_cut_off_last_file_costs_its_frame_and_is_said(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "walk")
    last = max(folder.iterdir())
    last.write_text(last.read_text()[:50])
    (found,) = found_in(folder)
    assert frames_of(found) == list(range(5))
    assert f"1 damaged files skipped ({last.name})" in found.in_words()


def write_results(path: Path, tables: Sequence[Sequence[np.ndarray]]) -> Path:
    """Write COCO results of people (frame, person, keypoint, 3)."""
    items = [
        {"image_id": frame, "keypoints": table.ravel().tolist()}
        for frame, people in enumerate(tables)
        for table in people
    ]
    path.write_text(json.dumps(items))
    return path


def test_junk_of_low_confidence_is_nothing_whatever_the_scale_of_the_detector(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for scale in (0.3, 1.0, 5.0):
        tables = np.zeros((12, 2, 25, 3))
        for frame in range(12):
            person, ghost = tables[frame]
            person[:] = np.column_stack([person_px("body25", frame), np.full(25, scale * 0.9)])
            for row, junk in ((person, rng.choice(25, 3, replace=False)), (ghost, range(3))):
                row[junk] = np.column_stack([rng.uniform(0, 2000, (3, 2)), np.full(3, scale * 0.1)])
        path = write_results(tmp_path / f"junk{scale:g}.json", tables)
        frames = found_in(path)[0].read()
        assert frames.num_rows == 12
        assert (frames.confidence > 0).sum() == 12 * 22
        assert np.nanmax(frames.keypoints_px) < 400
        assert found_in(path, min_confidence=0.0)[0].read().num_rows == 24


@pytest.mark.parametrize(
    ("best", "stated", "num_left"),
    [(0.3, None, 9), (0.3, 0.05, 21), (0.3, 0.25, 5), (0.03, None, 21), (5.0, None, 21), (5.0, 0.5, 23)],
)
def test_a_bad_source_is_no_scale_and_a_stated_minimum_counts_on_the_values_of_the_file(
    tmp_path: Path, best: float, stated: float | None, num_left: int
) -> None:
    confidence = np.linspace(0.0, best, 26)[1:]
    people = [[np.column_stack([person_px("body25", frame), confidence])] for frame in range(12)]
    options = {} if stated is None else {"min_confidence": stated}
    frames = found_in(write_results(tmp_path / "bad.json", people), **options)[0].read()
    assert (frames.confidence > 0).sum() == 12 * num_left
