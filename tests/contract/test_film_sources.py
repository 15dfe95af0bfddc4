"""Film as a source: what is read of it, what is refused, key frames, detectors, studies and commands."""

from __future__ import annotations

import csv
import hashlib
import io
import re
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from flows.console.annotate import _row, film_source
from flows.console.app import run_command_line
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.film.annotating import annotate_shot
from pasdedeux.film.detectors import DETECTORS, load_detector
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14, PAIR17
from storage_schema import Store
from tasks.evaluation import evaluation_stage
from tasks.evaluation import film as film_topic
from tasks.ingest.film import readers as films
from tasks.ingest.film.detector_files import KNOWN_DETECTORS, fetched_detectors
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import open_film, read_film
from tasks.ingest.film.resolution import CorrectedShot
from tasks.ingest.film.run import find_videos
from tasks.ingest.parameters import IngestParameters
from tasks.seeds.parameters import SeedsParameters
from tasks.seeds.plan import check_study
from tasks.stage import StageInputs
from tasks.stage.facts import TopicFacts
from tests.builders import tiny_networks
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.mp4_boxes import rotated, with_durations
from tests.builders.painted_film import NAMES, painted, scene, walker_px, write_keys
from tests.builders.rendered_film import render, salsa_bodies, write_film
from tests.builders.walkers import walk
from tests.builders.walkers_on_video import FRAMES, build_store, reference

COUNT = 40


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a film of two shots with two walkers, 20 frames each."""
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    return write_film(path, (painted(frame // 20, frame) for frame in range(COUNT)))


@pytest.fixture(scope="module")
def keys(film: Path) -> Path:
    return write_keys(film.with_name("keys.csv"), [0, 10, 19, 20, 30, 39])


def found(film: Path, **options: Any) -> Any:
    return find_videos(FilmOptions(id="walk", path=film, **options))


def test_a_film_is_streamed_with_its_times_and_shots(film: Path) -> None:
    opened = open_film(film)
    assert (opened.num_frames, opened.starts, opened.image_size_px) == (COUNT, (0, 20), (640, 480))
    assert (opened.rate_hz, opened.is_constant, opened.num_lost) == (pytest.approx(30.0), True, 0)
    (frame,) = read_film(opened.files, 30, 31)
    assert frame.time_s == pytest.approx(1.0)
    assert np.abs(frame.image.astype(int) - painted(1, 30)).mean() < 8


def test_key_frames_become_annotations_of_every_frame_a_sequence_for_each_shot(film: Path, keys: Path) -> None:
    shots = found(film, keys=keys)
    assert [one.parameters.id for one in shots] == ["walk.shot00", "walk.shot01"]
    for one, first in zip(shots, (0, 20), strict=True):
        frames = one.read()
        assert sorted(set(frames.frame.tolist())) == list(range(first, first + 20))
        true = np.stack([walker_px(at, person) for at, person in zip(frames.frame, frames.person_id, strict=True)])
        assert np.linalg.norm(frames.keypoints_px - true, axis=-1).mean() < 1.0
    assert len(found(film, keys=keys, has_cuts=False)) == 1


def test_a_phones_rotation_is_undone(film: Path, tmp_path: Path) -> None:
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(rotated(film.read_bytes(), 90))
    opened = open_film(turned)
    assert opened.image_size_px == (480, 640)
    (frame,) = read_film(opened.files, 0, 1)
    upright = cv2.rotate(painted(0, 0), cv2.ROTATE_90_CLOCKWISE)
    assert np.abs(frame.image.astype(int) - upright).mean() < 8


def web_film(folder: Path, *, stated_times: float = 1.0, share: float = 1.0) -> Path:
    """Write 50 frames as WebM whose stated duration is so many times the true one, cut to a share of its bytes."""
    path = folder / "web.webm"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), 25.0, (160, 120))
    rng = np.random.default_rng(0)
    for _ in range(50):
        writer.write(rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(b"\x44\x89\x88") + 3  # the duration, a float of eight bytes
    data[at : at + 8] = struct.pack(">d", stated_times * struct.unpack(">d", data[at : at + 8])[0])
    path.write_bytes(data[: round(share * len(data))])
    return path


@pytest.mark.filterwarnings("ignore")
def test_only_a_film_that_is_cut_off_lacks_frames(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert open_film(web_film(tmp_path)).num_lost == 0
    assert open_film(web_film(tmp_path, stated_times=3.0)).num_lost == 0, "its sound goes on"
    cut = open_film(web_film(tmp_path, share=0.6))
    assert cut.num_lost == 50 - cut.num_frames > 5
    keys, rows = tmp_path / "cut.csv", product((0, 1), enumerate(NAMES))
    places = "".join(f"{frame},0,{name},{20 + 4 * at},{30 + 3 * at}\n" for frame, (at, name) in rows)
    keys.write_text(f"# layout: coco17\nframe,person,joint,x,y\n{places}")
    words = ["annotate", str(tmp_path / "web.webm"), "--keys", str(keys), "--out", str(tmp_path / "out.csv")]
    assert run_command_line(words) == 0
    assert f"web.webm states {cut.num_lost} frames more than can be read" in capsys.readouterr().err
    uneven = tmp_path / "uneven.mp4"
    uneven.write_bytes(with_durations(film.read_bytes(), np.where(np.arange(COUNT) % 4 == 0, 3, 1) / 30.0))
    assert open_film(uneven).num_lost == 0


def test_film_of_a_variable_rate_is_annotated_on_its_true_times(film: Path, keys: Path, tmp_path: Path) -> None:
    durations = np.where(np.arange(COUNT) % 4 == 0, 3, 1) / 30.0
    uneven = tmp_path / "uneven.mp4"
    uneven.write_bytes(with_durations(film.read_bytes(), durations.tolist()))
    opened = open_film(uneven)
    assert (opened.is_constant, round(opened.rate_hz or 0)) == (False, 30)
    first, _ = found(uneven, keys=keys)
    frames = first.read()
    times = np.r_[0.0, np.cumsum(durations)[:-1]]
    own = frames.frame[frames.person_id == 0]
    assert own.tolist() == list(range(round(times[19] * 30) + 1))
    walked = np.interp(own / 30.0, times, np.arange(COUNT))  # frames of the film, which the walker keeps pace with
    nose = frames.keypoints_px[frames.person_id == 0, 0, 0]
    assert np.abs(nose - np.array([walker_px(0)[0, 0] + 2.0 * at for at in walked])).max() < 3.0


@pytest.mark.parametrize("kind", ["mp4", "uneven", "webm", "avi", "cut.avi"])
def test_a_frame_that_is_sought_is_the_one_that_plain_decoding_gives(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"long.{'mp4' if kind == 'uneven' else kind}"
    wall = cv2.resize(scene(7), (96, 72))
    write_film(path, (np.roll(wall, 3 * at, axis=1) for at in range(150)))
    if kind == "uneven":  # three times as dense in the middle
        dense = [(1 if 50 <= at < 100 else 3) / 60 for at in range(150)]
        path.write_bytes(with_durations(path.read_bytes(), dense))
    if kind == "cut.avi":  # its index, which seeking needs, is gone
        path.write_bytes(path.read_bytes()[: int(0.9 * path.stat().st_size)])
    opened = open_film(path)
    plain = list(read_film(opened.files))
    assert len(plain) == opened.num_frames > 120
    for first in (1, 2, 40, 77, 101, 118):
        _, at = films._opened_after(path, first, opened.after_s(first))
        assert at == first or kind == "cut.avi"
        stop = min(first + 9, opened.num_frames)
        sought = list(read_film(opened.files, first, stop, after_s=opened.after_s(first)))
        assert [one.time_s for one in sought] == [one.time_s for one in plain[first:stop]]
        np.testing.assert_array_equal([one.image for one in sought], [one.image for one in plain[first:stop]])
    (lost,) = read_film(opened.files, 77, 78, after_s=1.2345)  # no frame has this time
    np.testing.assert_array_equal(lost.image, plain[77].image)


def test_a_folder_of_images_is_a_film_whose_frames_their_names_number(tmp_path: Path) -> None:
    for frame in range(5, 15):
        cv2.imwrite(str(tmp_path / f"img_{frame:04d}.png"), painted(0, frame))
    keys = write_keys(tmp_path.parent / "images.csv", [5, 14])
    (one,) = found(tmp_path, keys=keys)
    frames = one.read()
    assert sorted(set(frames.frame.tolist())) == list(range(5, 15))
    (tmp_path / "img_0009.png").unlink()
    with pytest.raises(InputError, match="image before 10 is missing"):
        found(tmp_path, keys=keys)
    cv2.imwrite(str(tmp_path / "img_0009.png"), painted(0, 9)[:400])
    with pytest.raises(InputError, match="frame 4 is 640 x 400, those before are 640 x 480"):
        found(tmp_path, keys=keys)


@pytest.mark.parametrize("rate_hz", [None, 24.0])
def test_a_rate_that_is_stated_is_that_of_every_shot_and_else_the_films(
    film: Path, keys: Path, rate_hz: float | None
) -> None:
    shots = [shot.parameters for shot in found(film, keys=keys, rate_hz=rate_hz)]
    assert [(one.first_frame, one.num_frames) for one in shots] == [(0, 20), (20, 20)]
    assert [one.video_rate_hz for one in shots] == [pytest.approx(rate_hz or 30.0)] * 2


def test_a_shot_is_a_row_of_its_frames_people_and_how_their_keypoints_came_about() -> None:
    parameters = SimpleNamespace(id="walk.shot01", first_number=3, first_frame=5, num_frames=25)
    kinds = KeypointStatus
    status = np.array([[kinds.ANNOTATED, kinds.DETECTED], [kinds.TRACKED, kinds.INTERPOLATED], [kinds.ANNOTATED, 0]])
    frames = SimpleNamespace(person_id=np.array([4, 7, 4]), status=status)
    row = _row(SimpleNamespace(parameters=parameters), SimpleNamespace(frames=frames), [9, 30])  # type: ignore[arg-type]
    assert row == ("walk.shot01", "8-32", "2", "2%", "1%", "1%", "1%", "95%", "9 30")


def test_a_folder_of_films_needs_a_file_of_key_frames_named_like_each(film: Path, keys: Path, tmp_path: Path) -> None:
    films, annotations = tmp_path / "films", tmp_path / "keys"
    films.mkdir()
    annotations.mkdir()
    for name in ("one", "two"):
        (films / f"{name}.mp4").write_bytes(film.read_bytes())
    (annotations / "one_keys.csv").write_text(keys.read_text())
    with pytest.raises(InputError, match=r"nothing in .* is named like the film two.mp4"):
        found(films, keys=annotations)
    (annotations / "two.csv").write_text(keys.read_text())
    names = [one.parameters.id for one in found(films, keys=annotations)]
    assert names == ["walk.one.shot00", "walk.one.shot01", "walk.two.shot00", "walk.two.shot01"]


@pytest.mark.parametrize(
    ("frames", "notes", "message"),
    [
        ([0, 40], "", "frame 40 is not in the film, whose frames are 0 to 39"),
        ([0, 10], "# rate_hz: 25\n", "about a film of 25 Hz, but this one has 30"),
        ([0, 10], "# image_size: 1280x720\n", "images of 1280 x 720, but the film has 640 x 480"),
    ],
)
def test_key_frames_of_another_film_are_refused(
    film: Path, tmp_path: Path, frames: list[int], notes: str, message: str
) -> None:
    keys = write_keys(tmp_path / "other.csv", frames, notes=notes)
    with pytest.raises(InputError, match=message):
        found(film, keys=keys)


def test_key_frames_of_another_size_are_scaled_where_they_state_it_and_refused_elsewhere(
    film: Path, tmp_path: Path
) -> None:
    rows = [
        f"{frame + 1},0,{name},{2 * x:.4f},{2 * y:.4f}"
        for frame in range(20)
        for name, (x, y) in zip(NAMES, walker_px(frame), strict=True)
    ]
    head = ["# layout: coco17", "frame,person,joint,x,y"]
    keys = tmp_path / "large.csv"
    keys.write_text("\n".join(["# image_size: 1280x960", *head, *rows]))
    (one,) = found(film, keys=keys, frame_offset=-1)
    assert one.notes == ("keypoints of images of 1280 x 960 scaled to 640 x 480",)
    np.testing.assert_allclose(one.read().keypoints_px[:20], [walker_px(at) for at in range(20)], atol=0.01)
    assert one.in_words().endswith("keypoints of images of 1280 x 960 scaled to 640 x 480")
    keys.write_text("\n".join([*head, *rows]))
    with pytest.raises(InputError, match=r"\d\d% of the keypoints .* lie outside the image: .* is 640 x 480"):
        found(film, keys=keys, frame_offset=-1)


@pytest.mark.parametrize("names", [("hall.png", "beach.png"), ("IMG_2034.png", "IMG_2077.png", "IMG_2161.png")])
def test_single_photographs_are_no_film(names: tuple[str, ...], keys: Path, tmp_path: Path) -> None:
    for frame, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), painted(0, frame))
    with pytest.raises(InputError, match="holds single photographs by their names, no film; number the images"):
        found(tmp_path, keys=keys)


def test_shots_of_which_only_filled_in_joints_are_known_are_left_out(film: Path, keys: Path, tmp_path: Path) -> None:
    head, names, *rows = keys.read_text().splitlines()
    lines = [f"{row},{'annotated' if int(row.split(',')[0]) < 20 else 'tracked'}" for row in rows]
    filled = tmp_path / "filled.csv"
    filled.write_text("\n".join([head, f"{names},status", *lines]))
    assert [one.parameters.id for one in found(film, keys=filled)] == ["walk.shot00"]


def test_keypoints_that_are_shares_of_the_image_take_its_size_from_the_film(film: Path, tmp_path: Path) -> None:
    path = tmp_path / "shares.csv"
    lines = ["# layout: coco17", "frame,person,joint,x,y"]
    for frame in (0, 10, 19):
        for name, (x, y) in zip(NAMES, walker_px(frame), strict=True):
            lines.append(f"{frame},0,{name},{x / 640:.6f},{y / 480:.6f}")
    path.write_text("\n".join(lines))
    (one,) = found(film, detections=path)
    frames = one.read()
    np.testing.assert_allclose(frames.keypoints_px[0], walker_px(0), atol=0.01)


def test_films_of_a_folder_have_names_and_key_frames_of_their_own(film: Path, keys: Path, tmp_path: Path) -> None:
    films, annotations = tmp_path / "films", tmp_path / "keys"
    films.mkdir()
    annotations.mkdir()
    for name in ("one", "one-2"):
        (films / f"{name}.mp4").write_bytes(film.read_bytes())
        (annotations / f"{name}.csv").write_text(keys.read_text() + ("20,2,nose,50,50\n" if name == "one" else ""))
    given = {one.parameters.id: one.files[0].path for one in found(films, keys=annotations)}
    assert Path(given["walk.one.shot00"]).name == "one.csv"
    assert Path(given["walk.one-2.shot00"]).name == "one-2.csv"
    for end in ("json", "xml"):
        arguments = ["annotate", films, "--keys", annotations, "--out", tmp_path / f"all.{end}"]
        assert run_command_line([str(one) for one in arguments]) == 2
    (annotations / "one.csv").unlink()
    with pytest.raises(InputError, match=r"nothing in .* is named like the film one\.mp4"):
        found(films, keys=annotations)
    (films / "one-2.avi").write_bytes(film.read_bytes())
    with pytest.raises(InputError, match=r"one-2\.avi and one-2\.mp4 would have one name"):
        found(films, keys=annotations)


def test_a_film_is_not_written_over(film: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = film.read_bytes()
    out = ["--out", str(film.with_name("o.csv"))]
    assert run_command_line(["annotate", str(film), "--keys", str(keys), "--overlay", str(film), *out]) == 2
    assert "is the film itself" in capsys.readouterr().err
    assert film.read_bytes() == before


def test_a_table_of_who_is_who_overrules_a_film_too(film: Path, keys: Path, tmp_path: Path) -> None:
    table = tmp_path / "people.csv"
    table.write_text("sequence,first_frame,last_frame,person,is\nwalk.shot01,20,39,1,7\n")
    first, second = found(film, keys=keys, people_file=table)
    assert set(first.resolve().frames.person_id.tolist()) == {0, 1}
    assert set(second.resolve().frames.person_id.tolist()) == {0, 7}
    table.write_text("sequence,first_frame,last_frame,person,is\nwalk,20,39,1,7\n")
    with pytest.raises(InputError, match=r"there is no such sequence; sequences: walk\.shot00, walk\.shot01"):
        found(film, keys=keys, people_file=table)


def test_damaged_film_is_refused_or_read_as_far_as_it_goes(film: Path, keys: Path, tmp_path: Path) -> None:
    data = film.read_bytes()
    for name, content in (("empty", b""), ("cut", data[: len(data) // 2]), ("text", b"hello" * 100)):
        path = tmp_path / f"{name}.mp4"
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"film {name}.mp4 cannot be opened"):
            found(path, keys=keys)
    whole = write_film(tmp_path / "whole.avi", (painted(0, frame) for frame in range(12))).read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole[: int(0.6 * len(whole))])
    opened = open_film(cut)
    assert 2 <= opened.num_frames < 12
    with pytest.raises(InputError, match=r"no\.mp4 does not exist"):
        found(tmp_path / "no.mp4", keys=keys)


def test_libraries_say_nothing_beside_the_sentence_on_a_film_that_is_none(keys: Path, tmp_path: Path) -> None:
    film = tmp_path / "text.mp4"
    film.write_text("hello")
    words = [sys.executable, "-m", "flows.console", "annotate", str(film), "--keys", str(keys)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1, ended.stderr
    assert "film text.mp4 cannot be opened" in ended.stderr


def test_one_of_key_frames_detections_and_detector_is_needed(film: Path, keys: Path) -> None:
    for given in ({}, {"keys": keys, "detections": keys}):
        with pytest.raises(ValueError, match="one of keys, detections and detect is needed"):
            FilmOptions(id="walk", path=film, **given)


def test_the_shots_of_a_film_are_shards_of_ingest_and_their_annotations_an_attachment(
    film: Path, keys: Path, tmp_path: Path
) -> None:
    shards = planned(videos=[{"id": "walk", "path": film, "keys": keys, "licence": "CC0"}])
    assert [(one.partition, one.name) for one in shards] == [("walk.shot00", "film"), ("walk.shot01", "film")]
    store = Store(tmp_path)
    manifest = run(store, shards[:1])["walk.shot00", "film"]
    table = store.read(manifest.ref, "annotations")
    assert table["frame"].tolist() == [frame for frame in range(20) for _ in range(2)]
    assert set(table["partner_id"].tolist()) == {0, 1}
    text = store.attachment(manifest.ref, "annotations.csv").decode()
    statuses = {row["status"] for row in csv.DictReader(line for line in text.splitlines() if line[0] != "#")}
    assert {"annotated", "tracked"} <= statuses <= {"annotated", "tracked", "interpolated"}
    sheet, clip = (store.attachment(manifest.ref, f"{name}.svg") for name in ("sheet", "clip"))
    assert (sheet.count(b"<image"), sheet.count(b"<animate")) == (1, 0)
    assert clip.count(b"<image") == clip.count(b"<animate") == 10
    ElementTree.fromstring(clip)
    topics = evaluation_stage([film_topic.TOPIC])
    inputs = StageInputs(manifests={"annotations": (manifest,)}, seed=1)
    shown, page = topics.plan(inputs, topics.parameters())
    (facts,) = (TopicFacts.of(store.manifest(topics.run_shard(shown, store))),)
    assert set(facts.captions) == {"walk.shot00-sheet.svg", "walk.shot00-clip.svg"}
    assert facts.notes[0].startswith("walk.shot00: frames 0 to 19, 2 people; keypoints: 15% annotated, 8")
    assert page.name == "report" or page.partition == "report"
    film_sha = hashlib.sha256(film.read_bytes()).hexdigest()
    assert film_sha in {file.sha256 for file in shards[0].files}


@pytest.mark.parametrize("is_uneven", [False, True])
def test_tracks_follow_a_joint_that_is_corrected_as_if_it_had_been_a_key_frame_of_the_study(
    film: Path, tmp_path: Path, is_uneven: bool
) -> None:
    path, keys = tmp_path / "walk.mp4", write_keys(tmp_path / "keys.csv", [0, 8, 19, 20, 39])
    durations = [(3 if is_uneven and at % 4 == 0 else 1) / 30.0 for at in range(COUNT)]
    path.write_bytes(with_durations(film.read_bytes(), durations))
    one = found(path, keys=keys)[1]
    shot = CorrectedShot(one.parameters, one.files)
    before, wrist = shot.shot.frames, NAMES.index("left_wrist")
    wanted = shot.film_frame(int(shot.placed().frame[-1]) // 2 + 12)
    assert 22 < wanted < 38
    at = np.flatnonzero((before.frame == wanted) & (before.person_id == 1))[0]
    place = before.keypoints_px[at, wrist] + [14.0, -9.0]
    shot.correct(wanted, 1, "left_wrist", place)
    after = shot.shot.frames
    np.testing.assert_array_equal(after.keypoints_px[at, wrist], place)
    moved = np.linalg.norm(after.keypoints_px - before.keypoints_px, axis=-1) > 1e-6
    assert set(map(tuple, np.argwhere(moved)[:, 1:].tolist())) == {(wrist,)}
    assert set(after.person_id[moved.any(axis=1)].tolist()) == {1}
    assert {wanted - 1, wanted, wanted + 1} <= set(after.frame[moved.any(axis=1)].tolist())
    saved = tmp_path / "saved.csv"
    saved.write_text(write_annotation_csv(shot.given()))
    first, second = found(path, keys=saved)
    again = CorrectedShot(second.parameters, second.files).shot.frames
    np.testing.assert_allclose(again.keypoints_px, after.keypoints_px, atol=0.3)
    np.testing.assert_array_equal(again.status, after.status)
    np.testing.assert_allclose(first.read().keypoints_px, found(path, keys=keys)[0].read().keypoints_px, atol=0.01)
    with pytest.raises(
        InputError, match="pelvis is no keypoint of the layout 'coco17', but the mean of left_hip and right"
    ):
        shot.correct(wanted, 1, "pelvis", place)
    with pytest.raises(InputError, match="person 5 is not in frame"):
        shot.correct(wanted, 5, "left_wrist", place)


def test_film_can_be_lifted_from_2d_alone(film: Path, keys: Path) -> None:
    seeds = SeedsParameters(num_seeds=0, num_lifted=2)
    ingest = {"rate_hz": 30.0, "duets": [], "videos": [{"id": "walk", "path": film, "keys": keys}]}
    check_study({"seeds": seeds, "ingest": IngestParameters.model_validate(ingest)})
    with pytest.raises(InputError, match=r"no annotated pairs with views, neither of .*, \[\[ingest.videos\]\]"):
        check_study({"seeds": seeds, "ingest": IngestParameters.model_validate({"duets": []})})


def test_the_command_writes_annotations_a_sheet_and_an_overlay(
    film: Path, keys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sheet, overlay = tmp_path / "out.csv", tmp_path / "next.png", tmp_path / "seen.mp4"
    arguments = ["annotate", film, "--keys", keys, "--out", out, "--sheet", sheet, "--overlay", overlay]
    assert run_command_line([str(one) for one in arguments]) == 0
    first, second = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("walk.shot"))
    assert (first[:3], second[:3]) == (["walk.shot00", "0-19", "2"], ["walk.shot01", "20-39", "2"])
    for line in (first, second):
        shares = [int(word[:-1]) for word in line if word.endswith("%")]
        assert shares[:2] == [15, 0], "3 of 20 frames are annotated, and nothing is detected"
        assert abs(sum(shares) - 100) <= 2
    assert cv2.imread(str(sheet)).shape[1] % 320 == 0
    assert open_film(overlay).num_frames == COUNT
    for name in ("again.csv", "coco.json", "cvat.xml"):
        again = tmp_path / name
        assert run_command_line(["annotate", str(film), "--keys", str(out), "--out", str(again)]) == 0
        assert run_command_line(["annotate", str(film), "--keys", str(again), "--out", str(tmp_path / "b.csv")]) == 0
        assert (tmp_path / "b.csv").read_text() == out.read_text()
    assert run_command_line(["annotate", str(film), "--keys", str(out), "--out", str(tmp_path / "a.txt")]) == 2
    assert ".csv (ours), .json (COCO), .xml (CVAT)" in capsys.readouterr().err
    assert run_command_line(["annotate", str(film)]) == 2
    said = capsys.readouterr().err
    assert "one of keys, detections and detect is needed" in said
    assert "`pasdedeux fetch detector rtmo-m` brings one" in said


def bright(x: int, y: int) -> np.ndarray:
    image = np.full((240, 320, 3), 30, dtype=np.uint8)
    cv2.circle(image, (x, y), 2, (255, 255, 255), -1)
    image[y, x] = 255
    return cv2.GaussianBlur(image, (5, 5), 0)


def test_every_kind_of_network_has_a_name_and_outputs_of_its_own() -> None:
    assert len({one.name for one in DETECTORS}) == len(DETECTORS) == len({one.outputs for one in DETECTORS})


def test_rtmo_gives_the_people_it_is_certain_of_in_pixels_of_the_image() -> None:
    (person,) = load_detector([tiny_networks.rtmo()]).detect(bright(150, 120))
    np.testing.assert_allclose(person[:, :2], [150, 120] + tiny_networks.OFFSETS_PX * 320 / 192, atol=2.5)
    np.testing.assert_allclose(person[:, 2], 0.8)


@pytest.mark.parametrize("turned", [False, True])
def test_movenet_takes_images_of_any_shape(turned: bool) -> None:
    image = bright(150, 120)
    (person,) = load_detector([tiny_networks.movenet()]).detect(image.swapaxes(0, 1) if turned else image)
    np.testing.assert_allclose(person[:, :2], np.tile([120, 150] if turned else [150, 120], (17, 1)), atol=1.5)
    np.testing.assert_allclose(person[:, 2], 0.9)
    assert load_detector([tiny_networks.movenet(score=0.05)]).detect(image) == []


def test_a_real_network_finds_the_people_of_rendered_film_and_of_a_folder_of_images(
    data_dir: Path, tmp_path: Path
) -> None:
    network = data_dir / "movenet_multipose" / "movenet_multipose.onnx"
    rendered = render(salsa_bodies(data_dir, "03", slice(200, 213)), yaw_rad=0.5, turn_rad=0.0, blur=1, seed=2)
    for number, image in enumerate(rendered.images):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image)
    for path, every in ((write_film(tmp_path / "salsa.mp4", rendered.images), 1), (tmp_path, 3)):
        (one,) = find_videos(
            FilmOptions(id="salsa", path=path, rate_hz=30.0, detect=[str(network)], detect_every=every)
        )
        frames = one.read()
        assert set(frames.frame.tolist()) == set(range(13))
        joints = [joint for joint in NAMES if joint in PAIR17.joint_names]
        true = rendered.px[frames.frame][:, :, [PAIR17.index(joint) for joint in joints]]
        own = frames.keypoints_px[:, None, [NAMES.index(joint) for joint in joints]]
        error = np.nanmedian(np.linalg.norm(own - true, axis=-1), axis=-1)
        for person in range(2):
            best = min(np.median(error[frames.person_id == who, person]) for who in set(frames.person_id.tolist()))
            assert best < 0.06 * rendered.height_px


def packed(**files: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in files.items():
            archive.writestr(f"model/{name}.onnx" if data else name, data)
    return out.getvalue()


def test_a_network_may_be_packed_as_model_zoos_do() -> None:
    (person,) = load_detector([packed(end2end=tiny_networks.rtmo(), readme=b"")]).detect(bright(150, 120))
    np.testing.assert_array_equal(person, load_detector([tiny_networks.rtmo()]).detect(bright(150, 120))[0])


def test_rtmpose_looks_into_boxes_of_people_or_where_the_person_was() -> None:
    boxed = load_detector([tiny_networks.yolox(), tiny_networks.rtmpose()])
    for x, y in ((150, 120), (156, 118)):
        (person,) = boxed.detect(bright(x, y))
        np.testing.assert_allclose(person[:, :2], np.tile([x, y], (17, 1)), atol=1.5)
    alone = load_detector([tiny_networks.rtmpose()])
    (person,) = alone.detect(bright(150, 120))
    np.testing.assert_allclose(person[:, :2], np.tile([150, 120], (17, 1)), atol=1.5)
    # Where it was there is nothing, so the next image is looked at as a whole again.
    assert alone.detect(bright(30, 30)) == []
    assert len(alone.detect(bright(30, 30))) == 1


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([b"no network"], "no ONNX network that can be loaded"),
        ([tiny_networks.half()], r"its input is tensor\(float16\); 32-bit floats, 32-bit or 8-bit integers are needed"),
        ([packed(a=b"1", b=b"2")], "one ONNX file of at most 2 GB is needed, found model/a.onnx, model/b.onnx"),
        ([packed(a=b"1" * 99)[:60]], "ZIP archive of a network is damaged"),
        ([tiny_networks.yolox()], "0 networks of keypoints"),
        ([tiny_networks.rtmo(), tiny_networks.rtmo()], "2 networks of keypoints"),
    ],
)
def test_files_that_are_no_detector_are_refused(files: list[bytes], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_detector(files)


def test_a_detector_at_an_address_comes_by_the_command_only_and_with_its_digest(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    network, asked = tiny_networks.rtmo(size=480), list[str]()
    stated = f"https://example.org/net.onnx#sha256={hashlib.sha256(network).hexdigest()}"

    def answer(url: str, *, max_bytes: int, is_public: bool) -> bytes:
        assert max_bytes == 2e9
        assert is_public
        asked.append(url)
        return network

    monkeypatch.setattr("tasks.files.downloads.download", answer)
    monkeypatch.setattr("flows.console.fetch.download", answer)
    with pytest.raises(InputError, match=re.escape(f"bring it with `pasdedeux fetch detector '{stated}'`")):
        found(film, detect=[stated])
    assert asked == []
    for _ in range(2):
        assert run_command_line(["fetch", "detector", stated]) == 0
    assert asked == ["https://example.org/net.onnx"]
    first, _ = found(film, detect=[stated], detect_every=2)
    assert stated.rpartition("=")[2] in {file.sha256 for file in first.files}
    assert run_command_line(["fetch", "detector", f"https://example.org/net.onnx#sha256={'0' * 64}"]) == 1
    said = capsys.readouterr().err
    assert (
        said == "error: https://example.org/net.onnx: the digest of the downloaded file differs from the stated one\n"
    )
    with pytest.raises(InputError, match="does not exist; give the ONNX file"):
        found(film, detect=["none.onnx"])


def test_a_detector_that_has_a_name_is_fetched_once_its_size_and_licence_are_agreed_to(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    network = tiny_networks.rtmo(size=480)
    known = KNOWN_DETECTORS["rtmo-m"]
    address = known.address._replace(sha256=hashlib.sha256(network).hexdigest())
    monkeypatch.setitem(KNOWN_DETECTORS, "rtmo-m", replace(known, address=address))
    monkeypatch.setattr("flows.console.fetch.download", lambda *_, **__: network)
    with pytest.raises(InputError, match="bring it with `pasdedeux fetch detector rtmo-m`"):
        found(film, detect=["rtmo-m"])
    assert run_command_line(["fetch", "detector", "rtmo-m"]) == 0
    said = "".join(capsys.readouterr())
    assert "89 MB, licence Apache-2.0, from https://huggingface.co/" in said
    assert "add --yes to start" in said
    assert fetched_detectors() == ()
    assert run_command_line(["fetch", "detector", "rtmo-m", "--yes"]) == 0
    assert fetched_detectors() == ("rtmo-m",)
    assert film_source(film, (), None, None, None).detect == ("rtmo-m",)
    first, _ = found(film, detect=["rtmo-m"], detect_every=2)
    assert address.sha256 in {file.sha256 for file in first.files}


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/net.onnx",
        "HTTP://example.org/net.onnx",
        "ftp://example.org/net.onnx",
        "file:///etc/passwd",
        "https://localhost/net.onnx",
        "https://node7/net.onnx",
        "https://printer.local/net.onnx",
        "https://127.0.0.1/net.onnx",
        "https://10.0.0.1/net.onnx",
        "https://8.8.8.8/net.onnx",
        "https://2130706433/net.onnx",
        "https://0x7f.0.0.1/net.onnx",
        "https://[::1]/net.onnx",
        "https://example.org:8443/net.onnx",
        "https://user:word@example.org/net.onnx",
        "https://example.org@127.0.0.1/net.onnx",
        "https://",
    ],
)
def test_addresses_other_than_https_to_a_public_name_are_refused_before_a_word_is_sent(
    url: str, film: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.create_connection", lambda *_, **__: pytest.fail("something was sent"))
    with pytest.raises(InputError, match=r"only https to a host with a public name|an address is https://HOST"):
        found(film, detect=[f"{url}#sha256={'0' * 64}"])
    assert run_command_line(["fetch", "detector", f"{url}#sha256={'0' * 64}"]) == 2


def test_a_detector_is_run_over_the_film_and_its_gaps_are_tracked(tmp_path: Path) -> None:
    network = tmp_path / "net.onnx"
    network.write_bytes(tiny_networks.rtmo(size=320))

    def image(frame: int) -> np.ndarray:
        wall = cv2.resize(scene(3), (320, 240)) // 2
        wall[110 + frame // 2 : 114 + frame // 2, 100 + frame : 104 + frame] = 255
        return wall

    film = write_film(tmp_path / "spot.mp4", (image(frame) for frame in range(24)))
    (one,) = find_videos(FilmOptions(id="spot", path=film, detect=[str(network)], detect_every=3))
    frames = one.read()
    assert frames.frame.tolist() == list(range(24))
    middle = frames.keypoints_px[:, 8]
    true = np.stack([101.5 + np.arange(24), 111.5 + np.arange(24) // 2], axis=-1)
    assert np.abs(middle - true)[::3].max() < 4.0
    assert frames.status is not None
    assert set(frames.status[1].tolist()) <= {1, 2}


def test_a_shot_in_which_a_detector_sees_nobody_is_skipped_with_the_reason(tmp_path: Path) -> None:
    network = tmp_path / "net.onnx"
    network.write_bytes(tiny_networks.rtmo(size=320, scores=(0.1,)))
    film = write_film(tmp_path / "sea.mp4", (np.full((240, 320, 3), 90 * (at // 6), np.uint8) for at in range(12)))
    shards = planned(videos=[{"id": "sea", "path": film, "detect": [str(network)]}])
    assert [one.partition for one in shards] == ["sea.shot00", "sea.shot01"]
    manifest = run(Store(tmp_path / "store"), shards[:1])["sea.shot00", "film"]
    assert not manifest.tables
    assert "sea.shot00 skipped: " in judged(manifest).reason
    assert "nobody was detected" in judged(manifest).reason


def test_a_film_with_key_frames_becomes_bvh_glb_with_its_camera_and_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    worlds = np.stack(
        [walk(FRAMES, seed=50 + at, rate_hz=30.0) + np.array([1.4 * at, 0.0, 0.0]) for at in (0, 1)], axis=1
    )
    camera = look_at_camera(
        mid_hip(worlds).mean(axis=(0, 1)),
        distance_m=5.0,
        yaw_rad=0.3,
        pitch_rad=0.1,
        focal_px=470.0,
        image_size_px=(640, 360),
    )
    px = camera.project(worlds).px
    film = write_film(tmp_path / "walkers.mp4", (scene(1)[:360] for _ in range(FRAMES)))
    lines = ["# layout: op14", "frame,person,joint,x,y"]
    for frame in [*range(0, FRAMES, 4), FRAMES - 1]:
        for person, joint in np.ndindex(2, OP14.num_joints):
            x, y = px[frame, person, joint]
            lines.append(f"{frame},{person},{OP14.joint_names[joint]},{x:.2f},{y:.2f}")
    keys = tmp_path / "keys.csv"
    keys.write_text("\n".join(lines))
    where = [*reference(build_store(tmp_path / "store")), "--out", str(tmp_path / "out")]
    assert run_command_line(["reconstruct", str(film), "--keys", str(keys), *where]) == 0
    told = capsys.readouterr()
    assert f"walkers: frames 0 to {FRAMES - 1} of walkers.mp4, by the format 'annotation_csv'" in told.err
    for person in (0, 1):
        text = (tmp_path / "out" / f"walkers_{person}.bvh").read_text()
        assert f"Frames: {FRAMES}" in text
        found_person = np.load(tmp_path / "out" / f"walkers_{person}.npz")
        lens = found_person["camera_principal_point_px"], float(found_person["camera_focal_px"])
        turned = (found_person["positions_m"] - found_person["camera_position_m"]) @ found_person[
            "camera_from_world_rotmat"
        ].T
        seen = lens[0] + lens[1] * turned[..., :2] / -turned[..., 2:] * [1, -1]
        foot = [str(name) for name in found_person["joint_names"]].index("LeftFoot")
        assert np.median(np.linalg.norm(seen[:, foot] - px[:, person, OP14.index("left_ankle")], axis=-1)) < 15
    figures = (tmp_path / "out" / "walkers.glb").read_bytes()
    assert b'"type":"perspective"' in figures
    assert b'"name":"person 1"' in figures
    assert "data:image/svg+xml" in (tmp_path / "out" / "walkers.html").read_text()
    assert run_command_line(["reconstruct", str(film), "--keys", str(keys), "--follow", *where]) == 2
    assert "--follow reads OpenPose files, not film" in capsys.readouterr().err
    assert run_command_line(["reconstruct", str(film), *where]) == 2
    said = capsys.readouterr().err
    assert "give key frames (--keys FILE)" in said
    assert "pasdedeux fetch detector rtmo-m" in said


def test_a_long_film_is_tracked_in_the_memory_of_a_short_one(tmp_path: Path) -> None:
    walls = [painted(0, frame) for frame in range(4)]

    def images(count: int) -> Iterator[np.ndarray]:
        for frame in range(count):
            yield walls[frame % 4]

    px = np.stack([walker_px(0, at) for at in (0, 1)])
    given = AnnotatedFrames("coco17", ("a",) * 2, np.zeros(2, int), np.arange(2), px, np.ones((2, 17)), rate_hz=30.0)
    peaks = []
    for count in (55, 110):
        tracemalloc.start()
        annotate_shot(given, images(count), 0, count, is_key=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 5_000_000 < 60_000_000


def test_a_film_ends_at_the_first_frame_that_cannot_be_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    image, released = np.zeros((4, 6, 3), dtype=np.uint8), list[bool]()
    answers = iter([(True, image), (False, None), (True, image)])
    capture = SimpleNamespace(
        grab=lambda: True, retrieve=lambda: next(answers), get=lambda _: 0.0, release=lambda: released.append(True)
    )
    monkeypatch.setattr(films, "_opened_after", lambda *_: (capture, 0))
    assert len(list(films._read_video(Path("a.mp4"), 0, 9, None, None))) == 1
    assert released == [True]
