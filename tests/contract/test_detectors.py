"""Detectors of 2D poses: what each kind of network gives, which files are refused, fetching, and runs over film."""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flows.console.annotate import film_source
from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.film.detectors import DETECTORS, load_detector
from pasdedeux.skeletons import PAIR17
from storage_schema import Store
from tasks.ingest.film.detector_files import KNOWN_DETECTORS, fetched_detectors
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import find_videos
from tests.builders import tiny_networks
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.painted_film import NAMES, painted, scene
from tests.builders.rendered_film import render, salsa_bodies, write_film


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    return write_film(path, (painted(0, frame) for frame in range(4)))


def shots_of(film: Path, **options: Any) -> Any:
    return find_videos(FilmOptions(id="walk", path=film, **options))


def bright(x: int, y: int) -> np.ndarray:
    image = np.full((240, 320, 3), 30, dtype=np.uint8)
    cv2.circle(image, (x, y), 2, (255, 255, 255), -1)
    image[y, x] = 255
    return cv2.GaussianBlur(image, (5, 5), 0)


def test_every_kind_of_network_has_a_name_and_outputs_of_its_own() -> None:
    assert len({kind.name for kind in DETECTORS}) == len(DETECTORS) == len({kind.outputs for kind in DETECTORS})


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
        (shot,) = shots_of(path, rate_hz=30.0, detect=[str(network)], detect_every=every)
        frames = shot.read()
        assert set(frames.frame.tolist()) == set(range(13))
        joints = [joint for joint in NAMES if joint in PAIR17.joint_names]
        true = rendered.px[frames.frame][:, :, [PAIR17.index(joint) for joint in joints]]
        detected = frames.keypoints_px[:, None, [NAMES.index(joint) for joint in joints]]
        error = np.nanmedian(np.linalg.norm(detected - true, axis=-1), axis=-1)
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
        shots_of(film, detect=[stated])
    assert asked == []
    for _ in range(2):
        assert run_command_line(["fetch", "detector", stated]) == 0
    assert asked == ["https://example.org/net.onnx"]
    (shot,) = shots_of(film, detect=[stated], detect_every=2)
    assert stated.rpartition("=")[2] in {file.sha256 for file in shot.files}
    assert run_command_line(["fetch", "detector", f"https://example.org/net.onnx#sha256={'0' * 64}"]) == 1
    said = capsys.readouterr().err
    assert (
        said == "error: https://example.org/net.onnx: the digest of the downloaded file differs from the stated one\n"
    )
    with pytest.raises(InputError, match="does not exist; give the ONNX file"):
        shots_of(film, detect=["none.onnx"])


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
        shots_of(film, detect=["rtmo-m"])
    assert run_command_line(["fetch", "detector", "rtmo-m"]) == 0
    said = "".join(capsys.readouterr())
    assert "89 MB, licence Apache-2.0, from https://huggingface.co/" in said
    assert "add --yes to start" in said
    assert fetched_detectors() == ()
    assert run_command_line(["fetch", "detector", "rtmo-m", "--yes"]) == 0
    assert fetched_detectors() == ("rtmo-m",)
    assert film_source(film, (), None, None, None).detect == ("rtmo-m",)
    (shot,) = shots_of(film, detect=["rtmo-m"], detect_every=2)
    assert address.sha256 in {file.sha256 for file in shot.files}


REFUSED = """
http://example.org/net.onnx HTTP://example.org/net.onnx ftp://example.org/net.onnx file:///etc/passwd
https://localhost/net.onnx https://node7/net.onnx https://printer.local/net.onnx https://127.0.0.1/net.onnx
https://10.0.0.1/net.onnx https://8.8.8.8/net.onnx https://2130706433/net.onnx https://0x7f.0.0.1/net.onnx
https://[::1]/net.onnx https://example.org:8443/net.onnx https://user:word@example.org/net.onnx
https://example.org@127.0.0.1/net.onnx https://
"""


@pytest.mark.parametrize("url", REFUSED.split())
def test_addresses_other_than_https_to_a_public_name_are_refused_before_a_word_is_sent(
    url: str, film: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.create_connection", lambda *_, **__: pytest.fail("something was sent"))
    with pytest.raises(InputError, match=r"only https to a host with a public name|an address is https://HOST"):
        shots_of(film, detect=[f"{url}#sha256={'0' * 64}"])
    assert run_command_line(["fetch", "detector", f"{url}#sha256={'0' * 64}"]) == 2


def test_a_detector_is_run_over_the_film_and_its_gaps_are_tracked(tmp_path: Path) -> None:
    network = tmp_path / "net.onnx"
    network.write_bytes(tiny_networks.rtmo(size=320))

    def image(frame: int) -> np.ndarray:
        wall = cv2.resize(scene(3), (320, 240)) // 2
        wall[110 + frame // 2 : 114 + frame // 2, 100 + frame : 104 + frame] = 255
        return wall

    film = write_film(tmp_path / "spot.mp4", (image(frame) for frame in range(24)))
    (shot,) = shots_of(film, detect=[str(network)], detect_every=3)
    frames = shot.read()
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
    assert [shard.partition for shard in shards] == ["sea.shot00", "sea.shot01"]
    manifest = run(Store(tmp_path / "store"), shards[:1])["sea.shot00", "film"]
    assert not manifest.tables
    assert "sea.shot00 skipped: " in judged(manifest).reason
    assert "nobody was detected" in judged(manifest).reason
