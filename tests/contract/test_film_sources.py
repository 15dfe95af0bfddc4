"""Film as a source: what is read of it, what is refused, key frames, detectors, studies and commands."""

from __future__ import annotations

import csv
import hashlib
import threading
from collections.abc import Iterator
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.film.detectors import DETECTORS, load_detector
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import Store
from tasks.ingest.annotations import find_videos
from tasks.ingest.films import open_film, read_film
from tasks.ingest.parameters import FilmOptions
from tests.builders import tiny_networks
from tests.builders.ingest_runs import planned, run
from tests.builders.mp4_boxes import rotated, with_durations
from tests.builders.rendered_film import write_film
from tests.builders.source_samples import person_px

NAMES = KEYPOINT_LAYOUTS["coco17"].keypoint_names
COUNT = 40


def scene(seed: int) -> np.ndarray:
    """Return a wall that a person can be painted on."""
    cells = np.random.default_rng(seed).uniform(40, 120, (15, 20, 3)).astype(np.float32)
    return cv2.resize(cells, (640, 480), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def walker_px(frame: int, person: int = 0) -> np.ndarray:
    """Return coco17 keypoints, whole pixels, of a person who walks to the right."""
    return np.asarray(np.round(person_px("coco17")) + np.array([200.0 * person + 2.0 * frame, 40.0]))


@cache
def patch(person: int, joint: int) -> np.ndarray:
    cells = np.random.default_rng(100 * person + joint).uniform(0, 255, (5, 5, 1)).astype(np.float32)
    return np.repeat(cv2.resize(cells, (25, 25), interpolation=cv2.INTER_CUBIC).clip(0, 255)[..., None], 3, axis=2)


def painted(seed: int, frame: int) -> np.ndarray:
    """Return an image with two walkers: a patch of their own at every joint."""
    image = scene(seed)
    for person in range(2):
        for joint, (x, y) in enumerate(walker_px(frame, person).astype(int).tolist()):
            image[y - 12 : y + 13, x - 12 : x + 13] = patch(person, joint)
    return image


def write_keys(path: Path, frames: list[int], *, notes: str = "") -> Path:
    lines = [f"# layout: coco17\n{notes}frame,person,joint,x,y"]
    for frame in frames:
        for person in range(2):
            for name, (x, y) in zip(NAMES, walker_px(frame, person), strict=True):
                lines.append(f"{frame},{person},{name},{x:.3f},{y:.3f}")
    path.write_text("\n".join(lines) + "\n")
    return path


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
    film_sha = hashlib.sha256(film.read_bytes()).hexdigest()
    assert film_sha in {file.sha256 for file in shards[0].files}


def test_the_command_writes_annotations_a_sheet_and_an_overlay(
    film: Path, keys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sheet, overlay = tmp_path / "out.csv", tmp_path / "next.png", tmp_path / "seen.mp4"
    arguments = ["annotate", film, "--keys", keys, "--out", out, "--sheet", sheet, "--overlay", overlay]
    assert run_command_line([str(one) for one in arguments]) == 0
    assert "walk.shot01" in capsys.readouterr().out
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
    assert "one of keys, detections and detect is needed" in capsys.readouterr().err


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
        ([tiny_networks.yolox()], "0 networks of keypoints"),
        ([tiny_networks.rtmo(), tiny_networks.rtmo()], "2 networks of keypoints"),
    ],
)
def test_files_that_are_no_detector_are_refused(files: list[bytes], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_detector(files)


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "net.onnx").write_bytes(tiny_networks.rtmo(size=480))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/net.onnx"
    server.shutdown()
    server.server_close()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        """Say nothing."""


def test_a_detector_at_an_address_is_fetched_once_and_only_with_its_digest(
    film: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    digest = hashlib.sha256((tmp_path / "net.onnx").read_bytes()).hexdigest()
    with pytest.raises(InputError, match="an address needs the digest"):
        found(film, detect=[address])
    with pytest.raises(InputError, match="another file, of the digest"):
        found(film, detect=[f"{address}#sha256={'0' * 64}"])
    first, _ = found(film, detect=[f"{address}#sha256={digest}"], detect_every=2)
    assert digest in {file.sha256 for file in first.files}
    (tmp_path / "net.onnx").unlink()
    assert found(film, detect=[f"{address}#sha256={digest}"])[0].parameters.num_networks == 1
    with pytest.raises(InputError, match="cannot be fetched"):
        found(film, detect=[f"{address}#sha256={'1' * 64}"])
    with pytest.raises(InputError, match="does not exist; give the ONNX file"):
        found(film, detect=["none.onnx"])


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
