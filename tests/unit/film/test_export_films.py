"""Export films: a browser plays them, and every frame is upright and has its colours."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flows.exports import overlay_video
from flows.exports.export_format import write_film
from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import PERSON_COLOURS, rgb
from pasdedeux.skeletons import BODY22
from tests.builders.browser import open_page

COUNT, HEIGHT, WIDTH = 25, 121, 163


def frame_of(number: int) -> np.ndarray:
    """Return an image that no turn, mirror or other frame has: a grey level by number, and three coloured corners."""
    image = np.full((HEIGHT, WIDTH, 3), 40 + 8 * number, dtype=np.uint8)
    image[:40, :40] = (220, 30, 30)
    image[:40, -41:] = (30, 220, 30)
    image[-41:, :40] = (30, 30, 220)
    return image


def read_all(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (found := capture.read())[0]:
        frames.append(found[1])
    assert round(capture.get(cv2.CAP_PROP_FPS), 2) == 24.0
    capture.release()
    return frames


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_film_is_read_back_frame_by_frame(suffix: str, tmp_path: Path) -> None:
    path = write_film(tmp_path / f"film{suffix}", map(frame_of, range(COUNT)), 24.0)
    frames = read_all(path)
    assert len(frames) == COUNT
    for number, frame in enumerate(frames):
        assert frame.shape == (HEIGHT - 1, WIDTH - 1, 3)
        given = frame_of(number)[:-1, :-1].astype(float)
        for rows in (slice(8, 32), slice(-32, -8)):
            for columns in (slice(8, 32), slice(-32, -8)):
                off = frame[rows, columns].mean(axis=(0, 1)) - given[rows, columns].mean(axis=(0, 1))
                assert np.abs(off).max() < 12, (number, off)
        assert abs(float(frame[50:70, 60:100].mean()) - (40 + 8 * number)) < 4, "neighbours differ by 8"


def test_a_browser_plays_an_exported_film(tmp_path: Path) -> None:
    film = write_film(tmp_path / "film.mp4", map(frame_of, range(COUNT)), 24.0)
    assert b"vp09" in film.read_bytes()
    page = tmp_path / "page.html"
    page.write_text(f'<video muted src="{film.name}"></video>')
    with open_page(page.as_uri(), tmp_path) as tab:
        seen = tab.run(
            "new Promise((done) => { const film = document.querySelector('video');"
            "film.onerror = () => done(film.error.message); film.onended = () =>"
            " done(`${film.videoWidth}x${film.videoHeight} ${film.duration.toFixed(1)}`);"
            "film.play().catch((error) => done(String(error))); })"
        )
    assert seen == f"{WIDTH - 1}x{HEIGHT - 1} {COUNT / 24:.1f}"


def test_people_have_the_colours_of_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    people, size = len(PERSON_COLOURS), (640, 480)
    positions_m = np.random.default_rng(0).normal(0.0, 0.3, (1, people, BODY22.num_joints, 3))
    given_px = 300.0 + 200.0 * positions_m[..., :2] * [1.0, -1.0]
    is_given = np.isin(np.arange(BODY22.num_joints), [0, 8]) & np.ones(
        (1, people, 1), bool
    )  # no bone of the annotation
    monkeypatch.setattr(overlay_video, "_annotation", lambda *_: (given_px, is_given, size, 30.0))
    monkeypatch.setattr(overlay_video, "_bodies", lambda *_: [None] * people)
    seen = SimpleNamespace(frames=[0], positions_m=positions_m, skeleton=BODY22, is_pair=False)
    export, cast = SimpleNamespace(store=None, footage=None), SimpleNamespace(labels=())
    (image,) = overlay_video._drawn(export, cast, seen)
    background = np.array(overlay_video._BACKGROUND)
    for colour in PERSON_COLOURS:
        drawn = background + overlay_video._OPAQUE * (np.array(rgb(colour)[::-1]) - background)
        assert (np.abs(image - drawn).max(axis=-1) <= 1.0).sum() > 100, colour


def test_a_film_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"films are \.mp4 or \.avi"):
        write_film(tmp_path / "film.txt", map(frame_of, range(2)), 24.0)
    assert list(tmp_path.iterdir()) == []
