"""Variants in the viewer: their figures and verdicts, what they are compared with, sliders, and where cameras look."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flows.viewing.bodies import GAP
from flows.viewing.shelf import Shelf
from flows.viewing.viewer import Viewer
from pasdedeux.cameras.virtual_video import look_at_camera
from storage_schema import Manifest, Store
from tests.builders.drawn_stores import BATCH, Drawn, aside, motion, put_take
from tests.builders.storage_rows import put, random_columns

NUM_FRAMES, RATE_HZ = 6, 30.0
SCALES = {"A-uniform-0.80": (0.8, 1.0), "A-uniform-1.20": (1.2, 1.0), "B-uniform-0.85": (1.0, 0.85), "none": (1.0, 1.0)}
"""Variants by their names, and the scales of A and B."""
LEVELS = {
    "A-uniform-0.80": ["pass", "fail", "warn", "pass", "fail", "pass"],
    "A-uniform-1.20": ["pass", "warn", "pass", "pass", "pass", "warn"],
    "B-uniform-0.85": ["pass"] * 6,
    "none": ["pass"] * 6,
}


def put_variants(store: Store, take: Manifest) -> Manifest:
    each, count = 2 * NUM_FRAMES, len(SCALES)
    frame = np.tile(np.repeat(np.arange(NUM_FRAMES), 2), count)
    rows = random_columns("variants", count * each) | {
        "take_id": [take.name] * count * each,
        "variant_id": np.repeat(list(SCALES), each).tolist(),
        "frame": frame,
        "time_s": frame / RATE_HZ,
        "person": np.tile([0, 1], count * NUM_FRAMES),
        "body22_m": np.concatenate([motion(0, NUM_FRAMES) + aside(at) for at in range(count)]).reshape(-1, 22, 3),
    }
    frames = random_columns("variant_frames", count * NUM_FRAMES) | {
        "take_id": [take.name] * count * NUM_FRAMES,
        "variant_id": np.repeat(list(SCALES), NUM_FRAMES).tolist(),
        "frame": np.tile(np.arange(NUM_FRAMES), count),
        "contact_drift_m": 0.01 * np.arange(count * NUM_FRAMES),
        "verdict": [word for name in SCALES for word in LEVELS[name]],
    }
    quality = random_columns("variant_quality", count) | {
        "take_id": [take.name] * count,
        "variant_id": list(SCALES),
        "bone_scale": [np.repeat(scales, 22) for scales in SCALES.values()],
        "verdict": ["fail", "warn", "pass", "pass"],
        "reason": ["feet slide", "", "", ""],
    }
    facts = {"kind": "variants", "takes": [take.name], "take_id": take.name, "variants": list(SCALES)}
    facts |= {"told": BATCH | {"contacts": []}, "num_frames": NUM_FRAMES, "num_persons": 2, "rate_hz": RATE_HZ}
    tables = {"variants": rows, "variant_frames": frames, "variant_quality": quality}
    return put(store, "augmentation", take.name, tables, facts, (take,))


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Shelf:
    store = Store(tmp_path_factory.mktemp("variants") / "store")
    take = put_take(store, 0, Drawn("waltz", NUM_FRAMES, False, ()))
    return Shelf(store, [put_variants(store, take).ref])


@pytest.fixture
def viewer(shelf: Shelf, open_viewer: Callable[..., Viewer]) -> Viewer:
    return open_viewer(shelf)


def show(viewer: Viewer, name: str) -> None:
    (index,) = (at for at, item in enumerate(viewer.shelf.items(viewer.part)) if item.names[1] == name)
    viewer.show_item(index)


@pytest.mark.parametrize(("at", "name"), list(enumerate(SCALES)))
def test_a_variant_has_its_own_figures_and_verdicts_before_its_source(viewer: Viewer, at: int, name: str) -> None:
    show(viewer, name)
    scene, store = viewer.scene, viewer.shelf.store
    np.testing.assert_allclose(scene.people.positions_m, motion(0, NUM_FRAMES) + aside(at), atol=1e-6)
    assert (scene.behind_name, scene.rate_hz) == ("source", pytest.approx(RATE_HZ))
    np.testing.assert_allclose(scene.behind.positions_m, motion(0, NUM_FRAMES), atol=1e-6)
    assert scene.levels is not None
    assert [("pass", "warn", "fail")[level] for level in scene.levels] == LEVELS[name]
    table = store.read(viewer.item.pieces[0][0], "variant_frames")
    rows = slice(NUM_FRAMES * at, NUM_FRAMES * (at + 1))
    names = ["contact_drift_m", "bone_error_m", "laplacian_error_m", "stance_excursion_m", "floor_penetration_m"]
    names += ["penetration_m", "self_penetration_m", "spine_bend_rad", "jerk_ratio"]
    assert list(scene.curves) == [*names, GAP], "the first is shown unless another one is chosen"
    for column in names:
        np.testing.assert_array_equal(scene.curves[column], np.asarray(table[column], dtype=np.float64)[rows])


def test_failing_frames_come_by_turns_and_warnings_where_none_fails(viewer: Viewer) -> None:
    for name, frames in (("A-uniform-0.80", [1, 4, 1]), ("A-uniform-1.20", [1, 5, 1])):
        show(viewer, name)
        viewer.play(True)
        for frame in frames:
            viewer.next_failing()
            assert (viewer.frame, viewer.is_playing, viewer.panel.message.value) == (frame, False, "")
    show(viewer, "none")
    for levels in (viewer.scene.levels, None):
        viewer.panel.tell("")
        viewer.scene = replace(viewer.scene, levels=levels)
        viewer.next_failing()
        assert (viewer.frame, viewer.panel.message.value) == (0, "no frame of this item fails or has a warning")


def test_words_about_a_frame_name_its_verdict_its_figures_and_why_the_variant_fails(viewer: Viewer) -> None:
    show(viewer, "A-uniform-0.80")
    viewer.seek(4)
    viewer.describe_frame()
    lines = viewer.shown.facts.value.split("\n")
    assert lines[0] == "frame 4 of 6, 0.13 s, fail"
    assert "feet slide" in lines
    assert any(line.endswith(" penetrations") for line in lines)
    viewer.playing.marks.value = False
    viewer.describe_frame()
    assert not any(line.endswith(" penetrations") for line in viewer.shown.facts.value.split("\n"))


def test_playing_begins_anew_at_the_end_and_the_button_says_what_it_does(viewer: Viewer) -> None:
    show(viewer, "none")
    viewer.playing.speed.value = min(viewer.playing.speed.options, key=float)
    assert viewer.shown.play.label == "Play (space)"
    viewer.seek(NUM_FRAMES - 1)
    with viewer.lock:
        viewer.play()
        assert (viewer.is_playing, viewer.frame, viewer.playing.first) == (True, 0, 0)
        assert viewer.shown.play.label == "Stop (space)"
        viewer.play()
        assert (viewer.is_playing, viewer.shown.play.label) == (False, "Play (space)")
        viewer.seek(3)
        viewer.play(True)
        viewer.play(True)
        assert (viewer.is_playing, viewer.frame) == (True, 3)
        viewer.play(False)
        assert not viewer.is_playing


def test_sliders_have_the_scales_that_were_built_and_show_the_nearest_variant(viewer: Viewer) -> None:
    show(viewer, "none")
    viewer.seek(2)
    first, second = viewer.scales.sliders
    assert [(slider.label, slider.min, slider.max, slider.value) for slider in (first, second)] == [
        ("person A", pytest.approx(0.8), pytest.approx(1.2), 1.0),
        ("person B", pytest.approx(0.85), 1.0, 1.0),
    ]
    for axis, value, name in ((0, 1.09, "none"), (0, 1.11, "A-uniform-1.20"), (0, 0.5, "A-uniform-0.80")):
        viewer.scales.move(axis, value)
        assert viewer.item.names[1] == name
    assert viewer.frame == 2, "the moment stays"
    assert first.value == pytest.approx(0.8)
    viewer.scales.move(1, 0.85)
    assert viewer.item.names[1] == "B-uniform-0.85", "the slider that was moved counts more"
    viewer.scales.offer({}, 0)
    assert (viewer.scales._folder.visible, first.visible, second.visible) == (False, False, False)


def place_of(viewer: Viewer, name: str) -> list[float]:
    handle = viewer.server.scene.get_handle_by_name(name)
    return [float(value) for value in handle.position]


def test_what_a_variant_is_compared_with_stands_over_it_beside_it_or_not_at_all(viewer: Viewer) -> None:
    show(viewer, "none")
    viewer.shown.compare.value = "hidden"
    viewer.show_item(viewer.index)
    assert viewer.room._grey is None
    for where in ("overlay", "beside"):
        viewer.shown.compare.value = where
        viewer.show_item(viewer.index)
        (node,) = [name for name in viewer.room._groups if name.startswith(f"/{where}/")]
        x, _, z = place_of(viewer, node)
        flat = viewer.scene.people.positions_m.reshape(-1, 3)
        apart = max(np.ptp(flat[:, 0]), np.ptp(flat[:, 2])) + 0.5 if where == "beside" else 0.0
        assert np.hypot(x, z) == pytest.approx(apart, abs=1e-5)
        right = np.array([viewer.room._across[1], -viewer.room._across[0]])
        np.testing.assert_allclose([x, z], apart * right, atol=1e-5)
        for skin in viewer.room._grey.skins:
            assert (skin.opacity is None) is (where == "beside")
    viewer.seek(3)
    pelvis = [skin.bones[0].position for skin in viewer.room._grey.skins]  # type: ignore[union-attr]
    np.testing.assert_allclose(pelvis, motion(0, NUM_FRAMES)[3, :, 0], atol=1e-5)


def test_items_side_by_side_stand_to_either_side_by_turns_with_their_names_above(viewer: Viewer) -> None:
    show(viewer, viewer.shelf.items(viewer.part)[viewer.listing.order[0]].names[1])
    viewer.shown.beside.value = "4"
    viewer.show_item(viewer.index)
    right = np.array([viewer.room._across[1], 0.0, -viewer.room._across[0]])
    for number, away in ((1, 1.8), (2, -1.8), (3, 3.6)):
        (node,) = [name for name in viewer.room._groups if name.startswith(f"/more{number}/")]
        np.testing.assert_allclose(place_of(viewer, node), away * right, atol=1e-5)
        over = viewer.room._middle + away * right + [0.0, 1.1, 0.0]
        np.testing.assert_allclose(place_of(viewer, f"/names/{number}"), over, atol=1e-5)
        label = viewer.server.scene.get_handle_by_name(f"/names/{number}")
        assert label.text == viewer.listing.label(viewer.listing.order[number])
    viewer.shown.beside.value = "2"
    viewer.show_item(viewer.index)
    shown = [viewer.server.scene.get_handle_by_name(f"/names/{number}").visible for number in (1, 2, 3)]
    assert shown == [True, False, False]


class Client(SimpleNamespace):
    """A browser that keeps what its camera is told."""

    def atomic(self) -> Any:
        """Return a block."""
        return nullcontext()


def client(width: int = 800, height: int = 600) -> Client:
    return Client(camera=SimpleNamespace(image_width=width, image_height=height))


def test_browsers_look_at_the_people_from_where_they_are_told(viewer: Viewer) -> None:
    (x, z), middle = viewer.room._across, viewer.room._middle
    axes = np.array([[z, 0.0, -x], [0.0, 1.0, 0.0], [x, 0.0, z]])  # across, up, away
    browser = client()
    for name, position in {"side": (0, 0.4, 3.4), "front": (3.4, 0.4, 0), "top": (0, 3.4, 0.02)}.items():
        viewer.room.view(browser, name)
        np.testing.assert_allclose(browser.camera.position, middle + position @ axes, atol=1e-9)
        np.testing.assert_array_equal(browser.camera.look_at, middle)


def test_film_stands_behind_the_people_where_the_camera_saw_them_and_browsers_look_through_it(viewer: Viewer) -> None:
    """Every corner of the screen is where the camera sees that corner of its image, farther than everybody."""
    show(viewer, "none")
    camera = look_at_camera(
        np.array([0.2, 1.0, -0.3]), distance_m=5.0, yaw_rad=0.8, pitch_rad=0.3, focal_px=700.0, image_size_px=(640, 480)
    )
    camera = replace(camera, principal_point_px=np.array([300.0, 250.0]))
    image = np.full((48, 64, 3), 90, dtype=np.uint8)
    viewer.room.look_through(browser := client())
    assert not hasattr(browser.camera, "fov"), "nobody knows the camera"
    viewer.room.show_film(image)
    assert viewer.server.scene.get_handle_by_name("/film") is None
    scene = replace(viewer.scene, camera=camera)
    viewer.room.show(scene, "hidden")
    assert viewer.server.scene.get_handle_by_name("/camera").visible
    viewer.room.show_film(image)
    screen = viewer.server.scene.get_handle_by_name("/film")
    assert screen.visible
    turn = Rotation.from_quat(screen.wxyz[[1, 2, 3, 0]])
    half = 0.5 * np.array([screen.render_width, screen.render_height])
    corners = screen.position + turn.apply([[sx * half[0], sy * half[1], 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    seen = camera.project(corners)
    np.testing.assert_allclose(np.sort(seen.px[:, 0]), [0.0, 0.0, 640.0, 640.0], atol=0.01)
    np.testing.assert_allclose(np.sort(seen.px[:, 1]), [0.0, 0.0, 480.0, 480.0], atol=0.01)
    depths = camera.camera_from_world(scene.people.positions_m.reshape(-1, 3))[:, 2]
    farthest = depths[np.argmax(np.abs(depths))]
    screen_depths = camera.camera_from_world(corners)[:, 2]
    np.testing.assert_allclose(screen_depths, farthest + np.sign(farthest), atol=1e-4)
    viewer.room.look_through(browser)
    assert browser.camera.fov == pytest.approx(2 * np.arctan(240 / 700.0))
    np.testing.assert_allclose(browser.camera.position, camera.position_m, atol=1e-9)
    view = Rotation.from_quat(np.asarray(browser.camera.wxyz)[[1, 2, 3, 0]])
    np.testing.assert_allclose(
        view.apply([0.0, 0.0, 1.0]), camera.camera_from_world_rotmat.T @ [0.0, 0.0, -1.0], atol=1e-9
    )
    viewer.room.show_film(image + 9)
    np.testing.assert_array_equal(screen.image[0, 0], [99, 99, 99])
    viewer.room.show_film(None)
    assert not screen.visible
    viewer.room.show_film(image)
    assert screen.visible
    viewer.room.show(viewer.scene, "hidden")
    assert (screen.visible, viewer.server.scene.get_handle_by_name("/camera").visible) == (False, False)


def choose(widget: Any, value: Any) -> None:
    """Give a widget a value as a browser does."""
    widget.value = value
    for heard in list(widget._impl.update_cb):
        heard(SimpleNamespace(client=client(), target=widget))


def test_every_widget_of_the_panel_does_what_it_says(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    show(viewer, "none")
    viewer.play(True)
    pane = viewer.shown
    choose(pane.timeline, 4)
    assert (viewer.frame, viewer.is_playing) == (4, False)
    choose(pane.timeline, 1)
    assert viewer.frame == 1
    last = pane.item.options[-1]
    choose(pane.item, last)
    assert viewer.index == viewer.listing.order[len(pane.item.options) - 1]
    viewer.seek(3)
    choose(pane.compare, "hidden")
    assert (viewer.room._grey, viewer.frame) == (None, 3), "the moment stays"
    choose(pane.beside, "2")
    assert (len(viewer.room._more), viewer.frame) == (1, 3)
    choose(pane.part, pane.part.options[0])
    assert (viewer.index, viewer.frame) == (0, 0)
    choose(viewer.listing.only, "fail")
    assert [viewer.shelf.items(viewer.part)[at].names[1] for at in viewer.listing.order] == ["A-uniform-0.80"]
    assert viewer.item.names[1] == "A-uniform-0.80"
    choose(viewer.listing.only, "accepted")
    assert viewer.panel.message.value == "no item matches the filter"
    choose(viewer.listing.only, "all")
    assert (len(viewer.listing.order), viewer.panel.message.value) == (4, "")
    looked: list[str] = []
    monkeypatch.setattr(viewer, "look", lambda: looked.append("look"))
    monkeypatch.setattr(viewer, "show_frame", lambda: looked.append("frame"))
    monkeypatch.setattr(viewer, "play", lambda is_playing=None: looked.append(f"play {is_playing}"))
    for widget, value, wanted in (
        (pane.nearest, True, ["look"]),
        (pane.film, False, ["look"]),
        (viewer.playing.marks, False, ["frame"]),
        (viewer.playing.speed, viewer.playing.speed.options[0], ["play False"]),
        (viewer.curves.chosen, viewer.curves.chosen.options[-1], ["look"]),
    ):
        looked.clear()
        choose(widget, value)
        assert looked == wanted
    for heard in pane.view._impl.update_cb:
        heard(SimpleNamespace(client=(browser := client()), target=SimpleNamespace(value="top")))
    np.testing.assert_allclose(browser.camera.position[1], viewer.room._middle[1] + 3.4)
