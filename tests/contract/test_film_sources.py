"""Film as a source: what is read of it, what is refused, key frames, studies and commands."""

from __future__ import annotations

import csv
import hashlib
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from flows.console.annotate import _row
from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.film.annotating import annotate_shot
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.skeletons import OP14
from storage_schema import Store
from tasks.evaluation import evaluation_stage
from tasks.evaluation import film as film_topic
from tasks.ingest.film import readers as films
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import open_film, read_film
from tasks.ingest.film.resolution import CorrectedShot
from tasks.ingest.film.run import find_videos
from tasks.ingest.parameters import IngestParameters
from tasks.seeds.parameters import SeedsParameters
from tasks.seeds.plan import check_study
from tasks.stage import StageInputs
from tasks.stage.facts import TopicFacts
from tests.builders.ingest_runs import planned, run
from tests.builders.mp4_boxes import rotated, with_durations
from tests.builders.painted_film import NAMES, painted, scene, walker_px, write_keys
from tests.builders.rendered_film import write_film
from tests.builders.walkers_on_video import FRAMES, build_store, camera_of, reference, walkers

COUNT = 40


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a film of two shots with two walkers, 20 frames each."""
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    return write_film(path, (painted(frame // 20, frame) for frame in range(COUNT)))


@pytest.fixture(scope="module")
def keys(film: Path) -> Path:
    return write_keys(film.with_name("keys.csv"), [0, 10, 19, 20, 30, 39])


def shots_of(film: Path, **options: Any) -> Any:
    return find_videos(FilmOptions(id="walk", path=film, **options))


def test_a_film_is_streamed_with_its_times_and_shots(film: Path) -> None:
    opened = open_film(film)
    assert (opened.num_frames, opened.starts, opened.image_size_px) == (COUNT, (0, 20), (640, 480))
    assert (opened.rate_hz, opened.is_constant, opened.num_lost) == (pytest.approx(30.0), True, 0)
    (frame,) = read_film(opened.files, 30, 31)
    assert frame.time_s == pytest.approx(1.0)
    assert np.abs(frame.image.astype(int) - painted(1, 30)).mean() < 8


def test_key_frames_become_annotations_of_every_frame_a_sequence_for_each_shot(film: Path, keys: Path) -> None:
    shots = shots_of(film, keys=keys)
    assert [shot.parameters.id for shot in shots] == ["walk.shot00", "walk.shot01"]
    for shot, first in zip(shots, (0, 20), strict=True):
        frames = shot.read()
        assert sorted(set(frames.frame.tolist())) == list(range(first, first + 20))
        true = np.stack([walker_px(at, person) for at, person in zip(frames.frame, frames.person_id, strict=True)])
        assert np.linalg.norm(frames.keypoints_px - true, axis=-1).mean() < 1.0
    assert len(shots_of(film, keys=keys, has_cuts=False)) == 1


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
def test_only_a_film_that_is_cut_off_lacks_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert open_film(web_film(tmp_path)).num_lost == 0
    assert open_film(web_film(tmp_path, stated_times=3.0)).num_lost == 0, "its sound goes on"
    cut = open_film(web_film(tmp_path, share=0.6))
    assert cut.num_lost == 50 - cut.num_frames > 5
    keys = write_keys(tmp_path / "cut.csv", (0, 1), scale=(0.25, 0.25))
    words = ["annotate", str(tmp_path / "web.webm"), "--keys", str(keys), "--out", str(tmp_path / "out.csv")]
    assert run_command_line(words) == 0
    assert f"web.webm states {cut.num_lost} frames more than can be read" in capsys.readouterr().err


def test_film_of_a_variable_rate_is_annotated_on_its_true_times(film: Path, keys: Path, tmp_path: Path) -> None:
    durations = np.where(np.arange(COUNT) % 4 == 0, 3, 1) / 30.0
    uneven = tmp_path / "uneven.mp4"
    uneven.write_bytes(with_durations(film.read_bytes(), durations.tolist()))
    opened = open_film(uneven)
    assert (opened.is_constant, round(opened.rate_hz or 0), opened.num_lost) == (False, 30, 0)
    first, _ = shots_of(uneven, keys=keys)
    frames = first.read()
    times = np.r_[0.0, np.cumsum(durations)[:-1]]
    first_person = frames.frame[frames.person_id == 0]
    assert first_person.tolist() == list(range(round(times[19] * 30) + 1))
    # The walker keeps pace with the frames of the film.
    walked = np.interp(first_person / 30.0, times, np.arange(COUNT))
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
        for frame, expected in zip(sought, plain[first:stop], strict=True):
            assert frame.time_s == expected.time_s
            np.testing.assert_array_equal(frame.image, expected.image)
    (lost,) = read_film(opened.files, 77, 78, after_s=1.2345)  # no frame has this time
    np.testing.assert_array_equal(lost.image, plain[77].image)


def test_a_folder_of_images_is_a_film_whose_frames_their_names_number(tmp_path: Path) -> None:
    for frame in range(5, 15):
        cv2.imwrite(str(tmp_path / f"img_{frame:04d}.png"), painted(0, frame))
    keys = write_keys(tmp_path.parent / "images.csv", [5, 14])
    (shot,) = shots_of(tmp_path, keys=keys)
    frames = shot.read()
    assert sorted(set(frames.frame.tolist())) == list(range(5, 15))
    (tmp_path / "img_0009.png").unlink()
    with pytest.raises(InputError, match="image before 10 is missing"):
        shots_of(tmp_path, keys=keys)
    cv2.imwrite(str(tmp_path / "img_0009.png"), painted(0, 9)[:400])
    with pytest.raises(InputError, match="frame 4 is 640 x 400, those before are 640 x 480"):
        shots_of(tmp_path, keys=keys)


@pytest.mark.parametrize("rate_hz", [None, 24.0])
def test_a_rate_that_is_stated_is_that_of_every_shot_and_else_the_films(
    film: Path, keys: Path, rate_hz: float | None
) -> None:
    shots = [shot.parameters for shot in shots_of(film, keys=keys, rate_hz=rate_hz)]
    assert [(shot.first_frame, shot.num_frames) for shot in shots] == [(0, 20), (20, 20)]
    assert [shot.video_rate_hz for shot in shots] == [pytest.approx(rate_hz or 30.0)] * 2


def test_a_shot_is_a_row_of_its_frames_people_and_how_their_keypoints_came_about() -> None:
    parameters = SimpleNamespace(id="walk.shot01", first_number=3, first_frame=5, num_frames=25)
    kinds = KeypointStatus
    status = np.array([[kinds.ANNOTATED, kinds.DETECTED], [kinds.TRACKED, kinds.INTERPOLATED], [kinds.ANNOTATED, 0]])
    frames = SimpleNamespace(person_id=np.array([4, 7, 4]), status=status)
    row = _row(SimpleNamespace(parameters=parameters), SimpleNamespace(frames=frames), [9, 30])  # type: ignore[arg-type]
    assert row == ("walk.shot01", "8-32", "2", "2%", "1%", "1%", "1%", "95%", "9 30")


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
        shots_of(film, keys=keys)


def test_key_frames_of_another_size_are_scaled_where_they_state_it_and_refused_elsewhere(
    film: Path, tmp_path: Path
) -> None:
    large = write_keys(tmp_path / "large.csv", range(1, 21), notes="# image_size: 1280x960\n", scale=(2.0, 2.0))
    (shot,) = shots_of(film, keys=large, frame_offset=-1)
    assert shot.notes == ("keypoints of images of 1280 x 960 scaled to 640 x 480",)
    frames = shot.read()
    of_first = frames.keypoints_px[frames.person_id == 0]
    np.testing.assert_allclose(of_first, [walker_px(frame) for frame in range(1, 21)], atol=0.01)
    assert "keypoints of images of 1280 x 960 scaled to 640 x 480" in shot.in_words()
    with pytest.raises(InputError, match=r"\d\d% of the keypoints .* lie outside the image: .* is 640 x 480"):
        shots_of(film, keys=write_keys(tmp_path / "large.csv", range(20), scale=(2.0, 2.0)))


@pytest.mark.parametrize("names", [("hall.png", "beach.png"), ("IMG_2034.png", "IMG_2077.png", "IMG_2161.png")])
def test_single_photographs_are_no_film(names: tuple[str, ...], keys: Path, tmp_path: Path) -> None:
    for frame, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), painted(0, frame))
    with pytest.raises(InputError, match="holds single photographs by their names, no film; number the images"):
        shots_of(tmp_path, keys=keys)


def test_shots_of_which_only_filled_in_joints_are_known_are_left_out(film: Path, keys: Path, tmp_path: Path) -> None:
    head, names, *rows = keys.read_text().splitlines()
    lines = [f"{row},{'annotated' if int(row.split(',')[0]) < 20 else 'tracked'}" for row in rows]
    filled = tmp_path / "filled.csv"
    filled.write_text("\n".join([head, f"{names},status", *lines]))
    assert [shot.parameters.id for shot in shots_of(film, keys=filled)] == ["walk.shot00"]


def test_keypoints_that_are_shares_of_the_image_take_its_size_from_the_film(film: Path, tmp_path: Path) -> None:
    shares = write_keys(tmp_path / "shares.csv", (0, 10, 19), scale=(1 / 640, 1 / 480))
    (shot,) = shots_of(film, detections=shares)
    np.testing.assert_allclose(shot.read().keypoints_px[0], walker_px(0), atol=0.01)


def test_films_of_a_folder_have_names_and_key_frames_of_their_own(film: Path, keys: Path, tmp_path: Path) -> None:
    films, annotations = tmp_path / "films", tmp_path / "keys"
    films.mkdir()
    annotations.mkdir()
    for name in ("one", "one-2"):
        (films / f"{name}.mp4").write_bytes(film.read_bytes())
        (annotations / f"{name}_keys.csv").write_text(keys.read_text() + ("20,2,nose,50,50\n" if name == "one" else ""))
    given = {shot.parameters.id: Path(shot.files[0].path).name for shot in shots_of(films, keys=annotations)}
    assert given == {
        f"walk.{name}.shot{number:02d}": f"{name}_keys.csv" for name in ("one", "one-2") for number in (0, 1)
    }
    for end in ("json", "xml"):
        arguments = ["annotate", films, "--keys", annotations, "--out", tmp_path / f"all.{end}"]
        assert run_command_line([str(word) for word in arguments]) == 2
    (annotations / "one_keys.csv").unlink()
    with pytest.raises(InputError, match=r"nothing in .* is named like the film one\.mp4"):
        shots_of(films, keys=annotations)
    (films / "one-2.avi").write_bytes(film.read_bytes())
    with pytest.raises(InputError, match=r"one-2\.avi and one-2\.mp4 would have one name"):
        shots_of(films, keys=annotations)


def test_a_film_is_not_written_over(film: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = film.read_bytes()
    out = ["--out", str(film.with_name("o.csv"))]
    assert run_command_line(["annotate", str(film), "--keys", str(keys), "--overlay", str(film), *out]) == 2
    assert "is the film itself" in capsys.readouterr().err
    assert film.read_bytes() == before


def test_a_table_of_who_is_who_overrules_a_film_too(film: Path, keys: Path, tmp_path: Path) -> None:
    table = tmp_path / "people.csv"
    table.write_text("sequence,first_frame,last_frame,person,is\nwalk.shot01,20,39,1,7\n")
    first, second = shots_of(film, keys=keys, people_file=table)
    assert set(first.resolve().frames.person_id.tolist()) == {0, 1}
    assert set(second.resolve().frames.person_id.tolist()) == {0, 7}
    table.write_text("sequence,first_frame,last_frame,person,is\nwalk,20,39,1,7\n")
    with pytest.raises(InputError, match=r"there is no such sequence; sequences: walk\.shot00, walk\.shot01"):
        shots_of(film, keys=keys, people_file=table)


def test_film_that_cannot_be_opened_is_refused(film: Path, keys: Path, tmp_path: Path) -> None:
    data = film.read_bytes()
    for name, content in (("empty", b""), ("cut", data[: len(data) // 2]), ("text", b"hello" * 100)):
        path = tmp_path / f"{name}.mp4"
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"film {name}.mp4 cannot be opened"):
            shots_of(path, keys=keys)
    with pytest.raises(InputError, match=r"no\.mp4 does not exist"):
        shots_of(tmp_path / "no.mp4", keys=keys)


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
    film: Path, keys: Path, store: Store
) -> None:
    shards = planned(videos=[{"id": "walk", "path": film, "keys": keys, "licence": "CC0"}])
    assert [(shard.partition, shard.name) for shard in shards] == [("walk.shot00", "film"), ("walk.shot01", "film")]
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
    shown, _ = topics.plan(StageInputs({"annotations": (manifest,)}, seed=1), topics.parameters())
    facts = TopicFacts.of(store.manifest(topics.run_shard(shown, store)))
    assert set(facts.captions) == {"walk.shot00-sheet.svg", "walk.shot00-clip.svg"}
    assert facts.notes[0].startswith("walk.shot00: frames 0 to 19, 2 people; keypoints: 15% annotated, 8")
    film_sha = hashlib.sha256(film.read_bytes()).hexdigest()
    assert film_sha in {file.sha256 for file in shards[0].files}


@pytest.mark.parametrize("is_uneven", [False, True])
def test_tracks_follow_a_joint_that_is_corrected_as_if_it_had_been_a_key_frame_of_the_study(
    film: Path, tmp_path: Path, is_uneven: bool
) -> None:
    path, keys = tmp_path / "walk.mp4", write_keys(tmp_path / "keys.csv", [0, 8, 19, 20, 39])
    durations = [(3 if is_uneven and at % 4 == 0 else 1) / 30.0 for at in range(COUNT)]
    path.write_bytes(with_durations(film.read_bytes(), durations))
    source = shots_of(path, keys=keys)[1]
    shot = CorrectedShot(source.parameters, source.files)
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
    first, second = shots_of(path, keys=saved)
    again = CorrectedShot(second.parameters, second.files).shot.frames
    np.testing.assert_allclose(again.keypoints_px, after.keypoints_px, atol=0.3)
    np.testing.assert_array_equal(again.status, after.status)
    np.testing.assert_allclose(first.read().keypoints_px, shots_of(path, keys=keys)[0].read().keypoints_px, atol=0.01)
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
    short = write_film(tmp_path / "short.mp4", (painted(0, frame) for frame in range(4)))
    arguments = ["annotate", short, "--keys", write_keys(tmp_path / "keys.csv", (0, 3)), "--overlay", overlay]
    assert run_command_line([*map(str, arguments), "--out", str(out)]) == 0
    assert open_film(overlay).num_frames == 4
    capsys.readouterr()
    assert run_command_line(["annotate", str(film), *map(str, ("--keys", keys, "--out", out, "--sheet", sheet))]) == 0
    first, second = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("walk.shot"))
    assert (first[:3], second[:3]) == (["walk.shot00", "0-19", "2"], ["walk.shot01", "20-39", "2"])
    for line in (first, second):
        shares = [int(word[:-1]) for word in line if word.endswith("%")]
        assert shares[:2] == [15, 0], "3 of 20 frames are annotated, and nothing is detected"
        assert abs(sum(shares) - 100) <= 2
    assert cv2.imread(str(sheet)).shape[1] % 320 == 0
    written = out
    for name in ("coco.json", "cvat.xml", "again.csv"):
        assert run_command_line(["annotate", str(film), "--keys", str(written), "--out", str(tmp_path / name)]) == 0
        written = tmp_path / name
    assert written.read_text() == out.read_text()
    assert run_command_line(["annotate", str(film), "--keys", str(out), "--out", str(tmp_path / "a.txt")]) == 2
    assert ".csv (ours), .json (COCO), .xml (CVAT)" in capsys.readouterr().err
    assert run_command_line(["annotate", str(film)]) == 2
    said = capsys.readouterr().err
    assert "one of keys, detections and detect is needed" in said
    assert "`pasdedeux fetch detector rtmo-m` brings one" in said


def test_a_film_with_key_frames_becomes_bvh_glb_with_its_camera_and_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    px = camera_of(0.3).project(walkers(FRAMES)).px / 3
    film = write_film(tmp_path / "walkers.mp4", (scene(1)[:360] for _ in range(FRAMES)))
    lines = ["# layout: op14", "frame,person,joint,x,y"]
    for frame, person, joint in product([*range(0, FRAMES, 4), FRAMES - 1], range(2), range(OP14.num_joints)):
        x, y = px[frame, person, joint]
        lines.append(f"{frame},{person},{OP14.joint_names[joint]},{x:.2f},{y:.2f}")
    keys = tmp_path / "keys.csv"
    keys.write_text("\n".join(lines))
    where = [*reference(build_store(tmp_path / "store")), "--out", str(tmp_path / "out")]
    assert run_command_line(["reconstruct", str(film), "--keys", str(keys), *where]) == 0
    printed = capsys.readouterr()
    assert f"walkers: frames 0 to {FRAMES - 1} of walkers.mp4, by the format 'annotation_csv'" in printed.err
    for person in (0, 1):
        text = (tmp_path / "out" / f"walkers_{person}.bvh").read_text()
        assert f"Frames: {FRAMES}" in text
        written = np.load(tmp_path / "out" / f"walkers_{person}.npz")
        foot_m = written["positions_m"][:, written["joint_names"].tolist().index("LeftFoot")]
        turned = (foot_m - written["camera_position_m"]) @ written["camera_from_world_rotmat"].T
        on_plane = written["camera_focal_px"] * turned[..., :2] / -turned[..., 2:] * [1, -1]
        foot_px = written["camera_principal_point_px"] + on_plane
        assert np.median(np.linalg.norm(foot_px - px[:, person, OP14.index("left_ankle")], axis=-1)) < 15
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
