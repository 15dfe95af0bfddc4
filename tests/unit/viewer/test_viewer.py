"""The viewer without a browser: what is drawn where, what references point to, and who is refused."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote, urlsplit

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from flows.exports.overlay_video import FilmImages
from flows.viewing.bodies import Bodies, capsules, marks, surface_gap_curve
from flows.viewing.curves import time_strip
from flows.viewing.editing import Editor
from flows.viewing.films import FilmReader, find_film
from flows.viewing.kinds import KINDS
from flows.viewing.listing import qualities
from flows.viewing.room import across
from flows.viewing.saving import LinkPane, encode_clip, encode_image, save_clip
from flows.viewing.scene import Flat, Grid, People
from flows.viewing.seen import LIMBS17, LIMBS22, SequenceFootage
from flows.viewing.shelf import Shelf, ViewedPartition, moment_reference, open_shelf
from flows.viewing.side import Dragged, PicturePanel, Pointer, SidePicture
from flows.viewing.viewer import Viewer
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.annotated_frames import KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from pasdedeux.plausibility.capsules import standing_m
from pasdedeux.skeletons import BODY22, PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import Manifest, Store, new_run
from tasks.files.curation import Choosing
from tasks.files.user_files import user_file_digest
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import FilmFrame, open_film, read_film
from tasks.ingest.film.run import find_videos
from tasks.stage import SourceFile
from tasks.stage.facts import SequenceFacts
from tests.builders.command_line import CommandLine
from tests.builders.ingest_runs import duet_store, planned, run
from tests.builders.moving_pairs import swaying_pair
from tests.builders.mp4_boxes import with_durations
from tests.builders.painted_film import painted, write_keys
from tests.builders.rendered_film import write_film
from tests.builders.storage_rows import put, random_columns
from tests.builders.toy_runs import wait_until


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Return a store with one duet of a second."""
    return duet_store(tmp_path_factory.mktemp("viewed") / "store")[0]


OpenViewer = Callable[..., Viewer]


@pytest.fixture(scope="module")
def viewer(store: Store) -> Iterator[Viewer]:
    shown = Viewer(open_shelf(store, None))
    yield shown
    shown.stop()


def test_a_rod_reaches_from_one_end_of_its_capsule_to_the_other() -> None:
    rng = np.random.default_rng(1)
    ends = rng.normal(size=(40, 2, 3))
    ends[0] = [[0, 0, 1], [0, 0, 0]]  # straight down its own axis
    ends[1, 1] = ends[1, 0]  # a bone without length
    ends[2] = np.nan
    found = capsules(ends, np.full(40, 0.1))
    turns = Rotation.from_quat(found.rods_wxyz[:, [1, 2, 3, 0]])
    half = turns.apply(np.outer(found.rods_scale[:, 2], [0.0, 0.0, 0.5]))
    there = np.stack([found.rods_m - half, found.rods_m + half], axis=1)
    kept = np.arange(40) != 2
    np.testing.assert_allclose(there[kept], ends[kept], atol=2e-6)
    assert (found.balls_scale.reshape(40, 2)[2] == 0.0).all(), "who is not there has no size"


def test_bodies_that_overlap_are_marked_between_their_bones_and_far_ones_nowhere() -> None:
    pair = swaying_pair(1, apart_m=0.3)[0]
    pair[1, :, 0] += 0.07  # limbs cross, none lies along another
    radii = Bodies(People(BODY22, pair[None])).radii_m
    _, through = marks(BODY22, pair, radii)
    assert len(through) > 3
    parents = np.maximum(BODY22.parents, 0)
    for person in pair:
        ends, bones = person[parents], person - person[parents]
        reach = ((through[:, None] - ends) * bones).sum(axis=-1) / np.maximum((bones**2).sum(axis=-1), 1e-12)
        nearest = ends + np.clip(reach, 0.0, 1.0)[..., None] * bones
        away = np.linalg.norm(through[:, None] - nearest, axis=-1)
        assert (away - radii.max(axis=0)).min(axis=1).max() < 0.015, (
            "the middle of two axes, of a thick and a thin limb"
        )
    pair[1, :, 2] += 5.0
    assert not len(marks(BODY22, pair, radii)[1])


def test_rows_in_any_order_become_frames_of_people_and_who_is_missing_is_not_drawn() -> None:
    grid = Grid.of(np.array([7, 5, 5]), np.array([3, 3, 1]))
    assert grid.fill(np.array([70.0, 53.0, 51.0])).tolist()[0] == [51.0, 53.0]
    assert np.isnan(grid.fill(np.array([70.0, 53.0, 51.0]))[1, 0])
    assert grid.first(np.array([70.0, 53.0, 51.0])).tolist() == [53.0, 70.0]


def test_a_reference_to_a_row_leads_to_its_moment_and_back(store: Store, viewer: Viewer) -> None:
    data = store.read(viewer.item.pieces[0][0], "poses", columns=["frame", "body22_m", "person"])
    row = int(np.flatnonzero((data["frame"] == 7) & (data["person"] == 1))[0])
    viewer.visit(f"poses:short/waltz#{row}")
    assert viewer.frame == 7
    np.testing.assert_array_equal(viewer.scene.people.positions_m[7, 1], data["body22_m"][row])
    link = viewer.moment.reference
    viewer.seek(0)
    viewer.visit(f"http://127.0.0.1:1/?at={link.replace('#', '%23')}")
    assert (viewer.frame, viewer.moment.reference) == (7, link)
    part, index, number = viewer.shelf.find(link)
    assert moment_reference(part, viewer.shelf.items(part)[index], number) == link
    viewer.visit("poses:short#999999")
    assert (viewer.frame, viewer.panel.message.value[:20]) == (7, "'poses:short#999999'")


def test_what_is_no_address_is_said(viewer: Viewer) -> None:
    viewer.visit("http://[")
    assert viewer.panel.message.value == "'http://[' is not the address of a moment"


def test_a_page_is_answered_while_the_viewer_is_busy_and_goes_to_its_moment_then(viewer: Viewer) -> None:
    viewer.seek(0)
    with viewer.lock, closing(http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=10.0)) as asked:
        asked.request("GET", f"{path_of(viewer)}?at=poses:short%23200000")
        assert asked.getresponse().status == 200
    wait_until(lambda: "200000" in viewer.panel.message.value, "the visit", limit_s=20.0)


def test_of_a_take_the_figures_of_the_person_who_is_worst_stand(store: Store) -> None:
    (take,) = (one for one in store.artifacts("ingest") if "poses" in one.tables)
    rows = random_columns("take_quality", 3) | {"take_id": ["waltz"] * 3, "verdict": ["warn", "fail", "pass"]}
    judged = put(store, "checks", take.partition, {"take_quality": rows}, {})
    shelf = Shelf(store, [take.ref], [judged.ref])
    found = qualities(shelf, shelf.parts[0])["waltz",]
    assert found["verdict"] == "fail"


def test_the_image_of_2d_poses_has_the_size_of_its_own_sequence(tmp_path: Path) -> None:
    places = {"sequence_id": ["small", "small", "large", "large"], "frame": [0] * 4, "person_id": [0, 1, 0, 1]}
    columns = random_columns("annotations", 4) | places | {"partner_id": [1, 0, 1, 0]}
    columns |= {"image_width_px": [640, 640, 1920, 1920], "image_height_px": [480, 480, 1080, 1080]}
    columns["pair17_px"] = np.random.default_rng(0).uniform(0.0, 400.0, (4, 17, 2))
    store = Store(tmp_path / "store")
    ref = put(store, "ingest", "images", {"annotations": columns}, {}).ref
    for name, size in {"small": (640, 480), "large": (1920, 1080)}.items():
        assert [flat.size_px for flat in SequenceFootage(store, ref, name).flats(0, name)] == [size]


WRIST = PAIR17.index("left_wrist")


def begin(editor: Editor, frame: int) -> Callable[[Dragged], object]:
    """Begin to change what is shown in a frame; return what a joint is dragged with."""
    editor._is_on.value = True
    editor._begin()
    editor.viewer.seek(frame)
    drag = editor.viewer.side.on_drag
    assert drag is not None
    return drag


def annotated(store: Store, name: str, places: dict[str, list[object]], points_px: np.ndarray) -> Manifest:
    """Return an artifact of 2D poses in images of 640 by 480 pixels, of one partition."""
    columns = random_columns("annotations", len(points_px)) | {"is_key": [True] * len(points_px)} | places
    columns |= {"image_width_px": [640] * len(points_px), "image_height_px": [480] * len(points_px)}
    facts = SequenceFacts(rate_hz=30.0, sequence_ids=tuple(dict.fromkeys(map(str, places["sequence_id"]))))
    return put(
        store, "ingest", name, {"annotations": columns | {"pair17_px": points_px}}, facts.model_dump(mode="json")
    )


def test_2d_poses_are_saved_as_they_are_but_for_who_was_changed_in_the_frame_of_the_change(
    tmp_path: Path, open_viewer: OpenViewer
) -> None:
    rng = np.random.default_rng(4)
    places = {"sequence_id": ["walk"] * 6, "person_id": [9, 4] * 3, "partner_id": [4, 9] * 3}
    places |= {"frame": np.repeat(np.arange(3), 2), "time_s": np.repeat(np.arange(3) / 30.0, 2)}
    points, confidence = rng.uniform(50.0, 400.0, (6, 17, 2)), rng.uniform(0.2, 1.0, (6, 17))
    points[0, 3], confidence[0, 3] = np.nan, 0.0
    store = Store(tmp_path / "store")
    walk = annotated(store, "walk", places | {"pair17_confidence": confidence}, points)
    editor = Editor(open_viewer(Shelf(store, [walk.ref])), tmp_path / "out")
    drag = begin(editor, 1)
    drag(Dragged(1, WRIST, np.array([123.0, 45.0]), is_last=True))
    saved = read_annotation_csv(editor.save().read_bytes())
    points[2, WRIST] = 123.0, 45.0  # the second person is who has the larger number
    order = [1, 0, 3, 2, 5, 4]
    assert (saved.frame.tolist(), saved.person_id.tolist()) == ([0, 0, 1, 1, 2, 2], [4, 9] * 3)
    np.testing.assert_allclose(saved.keypoints_px, points[order], atol=5.1e-3)  # the file has 0.01 px
    np.testing.assert_allclose(saved.confidence, confidence[order], atol=5.1e-4)
    assert (saved.image_size_px, saved.rate_hz) == ({"walk": (640, 480)}, 30.0)


def test_a_reconstruction_is_located_by_who_was_seen_whoever_else_was_there(tmp_path: Path) -> None:
    camera = look_at_camera(
        np.array([0.2, 1.0, -0.3]), distance_m=5.0, yaw_rad=0.8, pitch_rad=0.3, focal_px=700.0, image_size_px=(640, 480)
    )
    rng = np.random.default_rng(6)
    body = rng.normal([0.2, 1.0, -0.3], 0.6, (4, 2, BODY22.num_joints, 3))
    px = np.full((4, 2, 17, 2), np.nan)
    px[:, :, LIMBS17] = camera.project(body[:, :, LIMBS22]).px
    store = Store(tmp_path / "store")
    # A is in no 2D pose, B is, and a third person, whom the reconstruction lacks.
    places = {"sequence_id": ["walk"] * 8, "frame": [0, 0, 1, 1, 2, 2, 3, 3], "person_id": [1, 7] * 4}
    points = np.stack([px[:, 1], rng.uniform(0.0, 400.0, (4, 17, 2))], axis=1).reshape(8, 17, 2)
    focal = {"partner_id": [7, 1] * 4, "focal_px": [700.0] * 8}
    seen = SequenceFootage(store, annotated(store, "walk", places | focal, points).ref, "walk")
    grid = Grid.of(np.repeat(np.arange(4), 2), np.array([0, 1] * 4))
    found = seen.locate_camera(body, grid, camera.camera_from_world_rotmat, 1.0)
    assert found is not None
    np.testing.assert_allclose(found.position_m, camera.position_m, atol=1e-4)
    one = np.full((1, 17, 2), np.nan)
    one[0, LIMBS17[0]] = 100.0
    alone = {"sequence_id": ["one"], "frame": [0], "person_id": [1], "partner_id": [0], "focal_px": [700.0]}
    seen = SequenceFootage(store, annotated(store, "one", alone, one).ref, "one")
    assert seen.locate_camera(body, grid, camera.camera_from_world_rotmat, 1.0) is None, "a point alone places nothing"


def test_a_single_image_has_the_film_of_its_own_artifact(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    refs = []
    for name in ("one", "other"):
        places = {"sequence_id": [name] * 2, "frame": [0, 0], "person_id": [0, 1], "partner_id": [1, 0]}
        refs.append(annotated(store, name, places, np.full((2, 17, 2), 50.0)).ref)
    shelf = Shelf(store, refs)
    films = {ref: SimpleNamespace(image=lambda number, ref=ref: ref, trouble="") for ref in refs}
    shelf.film = films.__getitem__  # type: ignore[assignment]
    part = ViewedPartition("annotations", "images", tuple(refs))
    (item,) = shelf.items(part)
    scene = KINDS["annotations"].scene(shelf, part, item)
    shown = [flat.image() for frame in (0, 1) for flat in scene.images(frame) if flat.image is not None]
    assert shown == refs


def test_frames_are_stepped_and_stay_within_the_item(viewer: Viewer) -> None:
    viewer.seek(0)
    viewer.step(-1)
    assert viewer.frame == 0
    viewer.step(viewer.scene.num_frames)
    assert viewer.frame == viewer.scene.num_frames - 1
    viewer.step(-1)
    assert viewer.frame == viewer.scene.num_frames - 2


def test_keys_step_by_one_frame_or_item_forth_and_back(
    store: Store, open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys: dict[str, Callable[..., None]] = {}
    monkeypatch.setattr("flows.viewing.panel.Panel.bind", lambda _, label, key, action: keys.update({key: action}))
    shown = open_viewer(open_shelf(store, None))
    steps: list[Any] = []
    monkeypatch.setattr(shown, "step", steps.append)
    monkeypatch.setattr(shown, "step_item", lambda by: steps.append(("item", by)))
    for key in ("arrowleft", "arrowright", "arrowup", "arrowdown"):
        keys[key](None)
    assert steps == [-1, 1, ("item", -1), ("item", 1)]


def turned_pair(angle_rad: float, away_m: float) -> People:
    """Return two T-poses side by side on a line that is turned about the vertical, (2, 2, 22, 3)."""
    one = 1.7 * standing_m(BODY22)
    pair = np.stack([one, one + np.array([away_m, 0.0, 0.0])])
    turn = Rotation.from_rotvec([0.0, angle_rad, 0.0]).as_matrix()
    return People(BODY22, np.stack([pair @ turn.T, (pair + np.array([0.0, 0.0, 9.0])) @ turn.T]))


@pytest.mark.parametrize("angle_rad", [0.0, 0.5, 2.0, -2.5])
def test_the_first_view_is_across_the_line_between_two_people(angle_rad: float) -> None:
    people = turned_pair(angle_rad, 2.5)
    line = people.positions_m[0, 1, 0] - people.positions_m[0, 0, 0]
    direction = across(people)
    assert abs(line[[0, 2]] @ direction) < 1e-6
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    np.testing.assert_array_equal(across(People(BODY22, people.positions_m[:, :1])), [0.0, 1.0])


def test_the_gap_between_two_bodies_is_that_of_their_surfaces_and_negative_within_each_other() -> None:
    wide, near = surface_gap_curve(turned_pair(0.3, 2.5)), surface_gap_curve(turned_pair(0.3, 0.1))
    assert wide is not None
    assert near is not None
    assert wide.shape == (2,)
    assert 0.3 < wide[0] < 2.5
    assert near[0] < 0.0
    assert surface_gap_curve(People(BODY22, turned_pair(0.0, 1.0).positions_m[:, :1])) is None
    strip = time_strip(np.ones((2, 2), bool), None, np.array([0.5, -0.05]))
    assert strip is not None
    assert [tuple(strip[0, at]) for at in (0, -1)] == [(250, 250, 250), (220, 20, 60)]
    assert time_strip(np.ones((2, 2), bool), None, None) is None


def test_the_message_is_there_while_there_is_one_and_items_stand_side_by_side(viewer: Viewer) -> None:
    viewer.panel.tell("something")
    assert viewer.panel.message.visible
    viewer.shown.beside.value = "4"
    viewer.show_item(0)
    assert not viewer.panel.message.visible
    shown = [one for one, _, _ in viewer.room._more]
    assert len(shown) == min(4, len(viewer.listing.order)) - 1
    viewer.shown.beside.value = "1"
    viewer.show_item(0)
    assert viewer.room._more == []


class Broken:
    """An event of which nothing can be read, and a function that fails."""

    def __call__(self, *_: object, **__: object) -> None:
        raise IndexError("broken")

    def __getattr__(self, name: str) -> None:
        raise IndexError("broken")


def callbacks_of(viewer: Viewer) -> list[Callable[[Any], object]]:
    """Return everything that viser calls for this viewer, of widgets, keys, handles in the room, and visitors."""
    gui, scene = viewer.server.gui, viewer.server.scene
    found = [one for handle in gui._gui_input_handle_from_uuid.values() for one in handle._impl.update_cb]
    found += [one for command in gui._command_handle_from_uuid.values() for one in command._impl.trigger_cb]
    found += [
        one for handle in scene._handle_from_transform_controls_name.values() for one in handle._impl_aux.update_cb
    ]
    return [*found, *viewer.server._client_connect_cb]


def test_no_callback_lets_an_exception_out_and_each_shows_it(store: Store, tmp_path: Path) -> None:
    viewer = Viewer(open_shelf(store, None))
    try:
        editor = Editor(viewer, tmp_path)
        callbacks = callbacks_of(viewer)
        assert len(callbacks) > 40
        for thing in (viewer, editor, viewer.choices, viewer.room):
            for name in dir(type(thing)):
                if not name.startswith("__") and callable(getattr(type(thing), name)):
                    object.__setattr__(thing, name, Broken())
        for callback in callbacks:
            viewer.panel.message.value = ""
            callback(Broken())
            assert viewer.panel.message.value == "IndexError: broken", callback
    finally:
        vars(viewer).pop("stop", None)
        viewer.stop()


def test_what_fails_while_playing_stops_it_is_shown_and_can_be_played_again(viewer: Viewer) -> None:
    viewer.seek(0)
    plain = viewer.room.show_frame
    viewer.room.show_frame = Broken()  # type: ignore[method-assign, assignment]
    try:
        viewer.play(True)
        wait_until(lambda: not viewer.is_playing, "the stop", limit_s=20.0)
    finally:
        viewer.room.show_frame = plain  # type: ignore[method-assign]
    assert viewer.panel.message.value == "IndexError: broken"
    viewer.seek(0)
    viewer.play(True)
    wait_until(lambda: viewer.frame > 0, "the next frame", limit_s=20.0)
    viewer.play(False)


def test_what_fails_while_a_frame_is_described_or_pointed_at_is_shown_and_the_next_one_is(viewer: Viewer) -> None:
    whole = viewer.scene
    viewer.scene = replace(whole, say=Broken())
    viewer.look()
    wait_until(lambda: viewer.panel.message.value == "IndexError: broken", "the message", limit_s=20.0)
    viewer.scene = whole
    viewer.seek(3)
    wait_until(lambda: viewer.shown.facts.value.startswith("frame 3 of"), "the next frame", limit_s=20.0)
    viewer.panel.tell("")
    plain, viewer.side._held = viewer.side.flats, None
    viewer.side.on_drag, viewer.side.flats = Broken(), [Flat(PAIR17, np.zeros((2, 17)), (640, 460), "of no axes")]
    viewer._pointers.put(Pointer("down", 0.5, 0.5))
    wait_until(lambda: bool(viewer.panel.message.value), "the message", limit_s=20.0)
    assert viewer._threads[-1].is_alive()
    viewer.side.on_drag, viewer.side.flats = None, plain


def test_an_item_that_cannot_be_read_leaves_what_is_shown(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = viewer.part, viewer.index, viewer.scene
    monkeypatch.setitem(KINDS, viewer.part.table, replace(KINDS[viewer.part.table], scene=Broken()))  # type: ignore[arg-type]
    viewer.visit("poses:short/waltz#0")
    assert viewer.panel.message.value == "IndexError: broken"
    assert (viewer.part, viewer.index, viewer.scene) == shown


def test_what_was_said_of_one_item_does_not_stand_beside_the_next(viewer: Viewer) -> None:
    viewer.show_part(viewer.part)
    viewer.panel.tell("no frame of this item fails or has a warning")
    viewer.show_part(viewer.part)
    assert viewer.panel.message.value == ""


def test_pictures_are_of_the_frame_of_their_scene_while_another_is_put_in_place(viewer: Viewer) -> None:
    asked: list[int] = []
    viewer.seek(5)
    with viewer.lock:
        whole = viewer.scene
        viewer.scene = replace(whole, images=lambda frame: asked.append(frame) or [])
        other = threading.Thread(target=viewer.flats)
        other.start()
        other.join(timeout=0.2)
        viewer.frame = 0
    other.join(timeout=20.0)
    assert set(asked) == {0}
    viewer.scene = whole


def test_film_that_is_read_too_late_is_not_shown_behind_what_came_meanwhile(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[object] = []
    monkeypatch.setattr(viewer.room, "show_film", shown.append)
    whole, was_read = viewer.scene, threading.Event()

    def read(_: int) -> np.ndarray:
        viewer.scene = whole
        was_read.set()
        return np.zeros((4, 4, 3), dtype=np.uint8)

    viewer.scene = replace(whole, film=read, camera=SimpleNamespace())
    viewer.describe_frame()
    assert was_read.is_set()
    assert shown == []


def test_clips_are_chosen_of_reconstructions_alone(viewer: Viewer) -> None:
    with pytest.raises(InputError, match="clips are chosen of motions, not of poses"):
        viewer.choices.mark_clip("start")
    assert viewer.curation.clip is None


def test_a_clip_has_the_frames_of_the_video_also_behind_a_gap(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[object] = []
    monkeypatch.setattr("flows.viewing.curating.thing_of", lambda *told: chosen.append(told[-1]) or ("video/fit", "0"))
    numbers = np.arange(viewer.scene.num_frames) + 3
    numbers[4:] += 20
    with viewer.lock:
        whole, viewer.scene = viewer.scene, replace(viewer.scene, numbers=numbers)
        viewer.curation.begin((2, 5))
        viewer.curation.thing(viewer.moment)
        assert [viewer.scene.frame_at(number) for number in (3, 6, 7, 27, 28)] == [0, 3, 4, 4, 5]
        viewer.scene = whole
        viewer.curation.begin()
    assert chosen == [(5, 28)]


def path_of(viewer: Viewer) -> str:
    """Return the path of its page, which begins with the token."""
    return urlsplit(viewer.url).path


def test_other_hosts_and_pages_are_refused_before_the_handshake(viewer: Viewer) -> None:
    port = viewer.server.get_port()

    def status(path: str = path_of(viewer), **headers: str) -> int:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20.0)) as asked:
            asked.request("GET", path, headers=headers)
            answer = asked.getresponse()
            policy = answer.getheader("Content-Security-Policy", "")
            body = answer.read()
        assert (b"<title>pasdedeux</title>" in body) is (answer.status == 200)
        assert ("default-src 'self'" in policy) is (answer.status == 200)
        return answer.status

    assert status() == 200
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20.0)) as asked:
        asked.request("GET", f"{path_of(viewer)[:-1]}?at=poses:study")
        answer = asked.getresponse()
        assert (answer.status, answer.getheader("Location")) == (308, f"{path_of(viewer)}?at=poses:study")
    assert status(Host=f"localhost:{port}") == 200
    assert status(Host="elsewhere.example") == 403
    assert status(Origin="http://elsewhere.example") == 403
    for path in ("/", "/index.html", f"{path_of(viewer)[:-2]}/", f"/x{path_of(viewer)[1:]}", "/%20/", "/é/"):
        assert status(quote(path)) == 403, "another user of the machine does not know the token"
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{port}{quote(path)}", origin=f"http://127.0.0.1:{port}")  # type: ignore[arg-type]
        assert refused.value.response.status_code == 403
    address = f"ws://127.0.0.1:{port}{path_of(viewer)}"
    for origin in ("http://elsewhere.example", f"http://localhost:{port}", "null", None):
        with pytest.raises(InvalidStatus) as refused, connect(address, origin=origin):  # type: ignore[arg-type]
            pass
        assert refused.value.response.status_code == 403
    with connect(address, origin=f"http://127.0.0.1:{port}", subprotocols=["viser-v1.1.1"]) as page:  # type: ignore[arg-type, list-item]
        assert page.recv(timeout=20.0)
    own = next(one for one in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET))[4]
    if not own[0].startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(own[:2], timeout=5.0)


def test_what_cannot_be_shown_is_refused_in_one_sentence(
    store: Store, tmp_path: Path, viewer: Viewer, invoke: CommandLine
) -> None:
    empty, text = tmp_path / "empty", tmp_path / "walk.bvh"
    text.write_text("this is no motion\n")
    used = viewer.server.get_port()
    for words, said in (
        (["takes:short"], "contains no people"),
        (["nowhere"], "is no file here, and no study, run or reference"),
        (["poses:short#99999"], "there is no row 99999"),
        ([text], "none of the known formats"),
        (["--port", used], f"port {used} is in use"),
        ([new_run(store, "short").run_id], "is no finished run"),
        (["--curation", text], "walk.bvh, line 1: a choice is"),
    ):
        assert said in invoke.at(store).refusal("view", *words)
    assert "holds no study yet" in invoke.at(empty).refusal("view")
    assert not empty.exists(), "looking makes nothing"


def test_of_a_reference_only_its_own_rows_are_offered(store: Store) -> None:
    with pytest.raises(InputError, match="is not part of what is shown here"):
        Shelf(store, [], tables=("poses",)).find("poses:short#0")
    assert [part.table for part in open_shelf(store, "poses:short/waltz").parts] == ["poses"]


def test_pictures_and_clips_are_read_back_by_opencv() -> None:
    rng = np.random.default_rng(2)
    images = [np.full((48, 64, 3), rng.integers(256, size=3), dtype=np.uint8) for _ in range(3)]
    read = cv2.imdecode(np.frombuffer(encode_image(images[0], ".png"), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), images[0])
    found, clip = cv2.imdecodeanimation(np.frombuffer(encode_clip(images, 10.0), np.uint8))
    assert found
    assert [frame.shape[:2] for frame in clip.frames] == [(48, 64)] * 3
    assert list(clip.durations) == [100] * 3
    away = [
        np.abs(frame[..., 2::-1].astype(float) - own).mean() for frame, own in zip(clip.frames, images, strict=True)
    ]
    assert max(away) < 8.0, "the same colours but for compression"


@pytest.mark.parametrize("size_px", [(640, 480), (100, 900), (1920, 1080)])
def test_a_pixel_is_found_again_where_its_panel_shows_it(size_px: tuple[int, int]) -> None:
    panel = PicturePanel.of(Flat(PAIR17, np.zeros((2, 17, 2)), size_px, "a"), (640, 480))
    points = np.random.default_rng(3).uniform(0.0, size_px, (20, 2))
    np.testing.assert_allclose([panel.point(panel.place(one)) for one in points], points, atol=1e-9)
    np.testing.assert_array_equal(panel.point(np.array([-50.0, 9999.0])), [0.0, size_px[1]])


def dragged(viewer: Viewer, points_px: np.ndarray, *pointers: Pointer) -> list[Dragged]:
    heard: list[Dragged] = []
    with viewer.server.gui.add_folder("picture"):
        picture = SidePicture(viewer.server.gui)
    picture.chosen = 1, 3
    picture.flats = [Flat(PAIR17, points_px, (640, 460), "a")]
    picture.draw(picture.flats)
    picture.point(pointers[0])
    assert not heard, "nothing can be dragged yet"
    picture.on_drag = heard.append
    for pointer in pointers:
        picture.point(pointer)
    return heard


def test_the_nearest_joint_follows_the_pointer_until_it_is_let_go(viewer: Viewer) -> None:
    points = np.full((2, 17, 2), np.nan)
    points[0, 4], points[1, 9] = (100.0, 100.0), (120.0, 100.0)
    moves = [Pointer("down", 117 / 640, 120 / 480), Pointer("move", 300 / 640, 220 / 480)]
    moves += [Pointer("up", 320 / 640, 220 / 480), Pointer("move", 0.9, 0.9)]
    heard = dragged(viewer, points, *moves)
    assert [(one.person, one.joint, one.is_last) for one in heard] == [(1, 9, False), (1, 9, False), (1, 9, True)]
    np.testing.assert_allclose(heard[-1].point_px, [320.0, 200.0])


def test_the_nearest_poses_stand_beside_where_they_are_known_and_asked_for(viewer: Viewer) -> None:
    near = Flat(PAIR17, np.zeros((2, 17, 2)), (640, 460), "near")
    asked, shown = viewer.shown.nearest, viewer.scene
    try:
        for known, is_asked in product((None, lambda frame: [near]), (False, True)):
            viewer.scene, asked.value = replace(shown, nearest=known), is_asked
            assert ("near" in [flat.title for flat in viewer.flats()]) is bool(known and is_asked)
    finally:
        viewer.scene, asked.value = shown, False


def test_a_press_on_a_picture_of_what_was_shown_before_moves_nothing(viewer: Viewer) -> None:
    heard: list[Dragged] = []
    three = Flat(PAIR17, np.full((3, 17, 2), 100.0), (640, 460), "of before")
    with viewer.lock:
        viewer.side.on_drag, viewer.side.flats = heard.append, [three]
        viewer.side.draw([three])
        viewer.show_item(viewer.index)
        viewer.side.point(Pointer("down", 100 / 640, 120 / 480))
        viewer.side.on_drag = None
    assert not heard


def test_a_click_far_from_every_joint_places_the_one_that_is_chosen(viewer: Viewer) -> None:
    heard = dragged(viewer, np.full((2, 17, 2), np.nan), Pointer("down", 0.5, 0.5), Pointer("up", 0.5, 0.5))
    assert [(one.person, one.joint) for one in heard] == [(1, 3), (1, 3)]
    np.testing.assert_allclose(heard[-1].point_px, [320.0, 220.0])


def test_the_pointer_is_heard_from_the_page_alone(viewer: Viewer) -> None:
    def status(path: str, **headers: str) -> int:
        with closing(http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20.0)) as asked:
            asked.request("GET", path_of(viewer) + path, headers=headers)
            return asked.getresponse().status

    heard: list[Pointer] = []
    viewer.side.point, plain = heard.append, viewer.side.point  # type: ignore[method-assign]
    try:
        own = {"X-Pointer": "1"}
        assert status("pointer/down/0.25/0.50000") == 404, "a page elsewhere cannot send this header"
        assert status("pointer/down/0.25/0.5", Origin="http://elsewhere.example", **own) == 403
        assert status("pointer/press/0.25/0.5", **own) == 404
        assert status("pointer/down/0.25/-0.5", **own) == 204
        wait_until(lambda: bool(heard), "the pointer", limit_s=20.0)
    finally:
        viewer.side.point = plain  # type: ignore[method-assign]
    assert heard == [Pointer("down", 0.25, -0.5)]


def grey_film(path: Path, count: int) -> Path:
    """Write a film whose frames are grey, each by its number."""
    return write_film(path, [np.full((48, 64, 3), 6 * number, dtype=np.uint8) for number in range(count)])


def reader(path: Path, **told: object) -> FilmReader:
    return FilmReader(lambda: (SourceFile(path=str(path), sha256=""),), **told)  # type: ignore[arg-type]


def grey_of(film: FilmReader, number: int) -> float:
    image = film.image(number)
    assert image is not None, number
    return float(image.mean())


@pytest.fixture
def few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a reader of film keep few images."""
    monkeypatch.setattr("flows.viewing.films._NUM_KEPT", 8)
    monkeypatch.setattr("flows.viewing.films._NUM_BEFORE", 4)


OF_FILM = {"num_given": 1, "num_networks": 0, "first_number": 0, "first_frame": 0, "is_constant_rate": True}


def test_an_image_of_a_film_is_that_of_its_frame_in_any_order(tmp_path: Path, few_are_kept: None) -> None:
    film = reader(grey_film(tmp_path / "grey.avi", 40))
    for number in (0, 1, 38, 36, 3, 39, 20, 21):
        assert grey_of(film, number) == pytest.approx(6 * number, abs=2.5)
    assert film.image(40) is None
    assert film.image(4) is not None, "after its end it is read again"


def test_a_shot_is_sought_where_it_begins_and_images_that_were_seen_where_they_are(
    tmp_path: Path, few_are_kept: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tuple[int, int, float | None]] = []

    def read(files: tuple[SourceFile, ...], first: int, after_s: float | None, sought: int) -> Iterator[FilmFrame]:
        found.append((first, sought, after_s))
        return read_film(files, first, after_s=after_s, sought=sought)

    monkeypatch.setattr("flows.viewing.films.read_film", read)
    path = grey_film(tmp_path / "grey.mp4", 40)
    times_s = open_film(path).times_s
    film = reader(path, first_frame=10, after_s=times_s[9])
    for number in (20, 35, 12):
        assert grey_of(film, number) == pytest.approx(6 * number, abs=3.0)
    assert found == [(16, 10, times_s[9]), (31, 21, times_s[20]), (10, 10, times_s[9])]


def test_of_a_film_of_a_varying_rate_the_image_is_that_of_the_overlay(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(8), grey_film(tmp_path / "grey.mp4", 40)
    durations = rng.choice([0.25, 0.5, 1.0, 3.0], 40) / 30.0
    path.write_bytes(with_durations(path.read_bytes(), durations.tolist()))
    footage, film = FilmImages(path, 30.0), reader(path, rate_hz=30.0)
    num_frames = int(30.0 * durations[:-1].sum())
    for number in (num_frames - 3, *range(num_frames), *rng.permutation(num_frames).tolist()):
        assert grey_of(film, number) == pytest.approx(footage(number).mean(), abs=2.5)
    assert film.image(num_frames + 10) is None


def test_a_film_that_has_gone_or_changed_is_not_shown_and_said_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = grey_film(tmp_path / "grey.avi", 5)
    files = (("keys.csv", "0" * 64), (path.name, user_file_digest(path)))
    manifest = SimpleNamespace(parameters=OF_FILM, files=files)
    ingest = {"videos": [{"id": "grey", "path": str(path)}]}
    asked: list[Path] = []
    monkeypatch.setattr("flows.viewing.films.user_file_digest", lambda one: asked.append(one) or user_file_digest(one))
    found = find_film(manifest, ingest)  # type: ignore[arg-type]
    assert found is not None
    assert not asked, "whoever opens an item does not wait for all of its film"
    assert found.image(4) is not None
    assert (asked, found.trouble) == ([path], "")
    manifest.files = (files[0], (path.name, "1" * 64))
    for sections in (ingest, {}):
        film = find_film(manifest, sections)  # type: ignore[arg-type]
        assert film is not None
        assert film.image(0) is None
        assert film.trouble == "the film grey.avi of these 2D poses is missing, or has changed since it was read"


def test_tracks_of_film_follow_a_joint_that_is_dragged_and_are_saved_as_key_frames(
    tmp_path: Path, open_viewer: OpenViewer
) -> None:
    film = write_film(tmp_path / "walk.mp4", (painted(0, frame) for frame in range(20)))
    keys = write_keys(tmp_path / "keys.csv", [0, 8, 19])
    source = {"id": "walk", "path": str(film), "keys": str(keys)}
    store = Store(tmp_path / "store")
    (manifest,) = run(store, planned(videos=[source])).values()
    shown = open_viewer(Shelf(store, [manifest.ref], sections={"ingest": {"videos": [source]}}))
    editor = Editor(shown, tmp_path / "out")
    drag = begin(editor, 0)
    assert editor._next.visible
    editor.next_to_correct()
    assert shown.frame in shown.shelf.shot(manifest.ref).next_frames(20)
    shown.seek(13)
    before = [shown.scene.images(at)[0].points_px.copy() for at in range(20)]
    for share in (0.5, 1.0):
        drag(Dragged(1, WRIST, before[13][1, WRIST] + share * np.array([16.0, 6.0]), is_last=share == 1.0))
    assert shown.frame == 13
    after = [shown.scene.images(at)[0].points_px for at in range(20)]
    moved = np.linalg.norm(np.array(after) - before, axis=-1)
    assert moved[13, 1, WRIST] == pytest.approx(np.hypot(16.0, 6.0), abs=0.01)
    assert moved[[12, 14], 1, WRIST].min() > 3.0
    moved[:, 1, WRIST] = 0.0
    assert moved.max() < 1e-3
    with pytest.raises(InputError, match="chest is no keypoint of the layout 'coco17'"):
        drag(Dragged(1, PAIR17.index("chest"), before[13][1, WRIST], is_last=True))
    (saved,) = find_videos(FilmOptions(id="walk", path=film, keys=editor.save()))
    frames = saved.read()
    row = np.flatnonzero((frames.frame == 13) & (frames.person_id == 1))[0]
    joint = KEYPOINT_LAYOUTS["coco17"].keypoint_names.index("left_wrist")
    assert frames.status is not None
    assert frames.status[row, joint] == KeypointStatus.ANNOTATED
    np.testing.assert_allclose(frames.keypoints_px[row, joint], after[13][1, WRIST], atol=0.01)


def test_a_video_beside_keypoints_is_their_film_where_it_has_their_size(tmp_path: Path) -> None:
    keys = write_keys(tmp_path / "dance.csv", [0, 1])
    grey_film(tmp_path / "dance.avi", 5)
    ingest = {"annotations": [{"id": "dance", "path": str(keys)}]}
    told = {"id": "dance", "video_size_px": [64, 48]}
    manifest = SimpleNamespace(parameters=told, files=())
    found = find_film(manifest, ingest)  # type: ignore[arg-type]
    assert isinstance(found, FilmReader)
    assert found.image(4) is not None
    told["video_size_px"] = [640, 480]
    assert find_film(manifest, ingest) is None  # type: ignore[arg-type]
    keys.unlink()
    assert find_film(manifest, ingest) is None, "who looks later may have moved it"  # type: ignore[arg-type]


def test_a_film_of_images_of_which_one_has_changed_is_not_shown(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.png" for number in range(3)]
    for path in paths:
        cv2.imwrite(str(path), np.full((8, 8, 3), 90, dtype=np.uint8))
    files = tuple((path.name, user_file_digest(path)) for path in paths)
    ingest = {"videos": [{"id": "images", "path": str(tmp_path)}]}
    for last, is_shown in ((files[2], True), ((paths[2].name, "1" * 64), False)):
        manifest = SimpleNamespace(parameters=OF_FILM | {"num_given": 0}, files=(*files[:2], last))
        film = find_film(manifest, ingest)  # type: ignore[arg-type]
        assert film is not None
        assert (film.image(2) is not None) is is_shown


def tree(store: Store) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in sorted(store.root.rglob("*"))}


def test_looking_and_choosing_write_nothing_into_the_store(
    store: Store, tmp_path: Path, open_viewer: OpenViewer
) -> None:
    before = tree(store)
    shown = open_viewer(open_shelf(Store(store.root), "short"), choosing=Choosing(tmp_path / "curation.txt"))
    Editor(shown, tmp_path / "restarts")
    shown.step(3)
    shown.choices.decide("reject")
    shown.describe_frame()
    assert tree(store) == before
    assert "poses waltz" in (tmp_path / "curation.txt").read_text()


@dataclass
class Browser:
    """A browser that renders images of different grey, and keeps files; `meanwhile` is done while it renders."""

    meanwhile: Callable[[], None] = lambda: None
    num_renders: int = 0
    downloads: dict[str, bytes] = field(default_factory=dict)
    camera: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(image_width=64, image_height=48))

    def get_render(self, height: int, width: int, timeout: float) -> np.ndarray:
        """Return an image."""
        self.meanwhile()
        self.num_renders += 1
        return np.full((height, width, 3), 20 * self.num_renders, dtype=np.uint8)

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        """Keep a file."""
        self.downloads[name] = content


@pytest.mark.parametrize(("rate_hz", "step", "frame_ms"), [(30.0, 3, 100), (12.0, 1, 83), (None, 1, 100)])
def test_a_clip_has_the_frames_of_its_seconds_at_its_rate(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, rate_hz: float | None, step: int, frame_ms: int
) -> None:
    monkeypatch.setattr(viewer, "scene", replace(viewer.scene, rate_hz=rate_hz))
    viewer.seek(5)
    browser = Browser()
    save_clip(viewer, browser)
    (content,) = browser.downloads.values()
    found, clip = cv2.imdecodeanimation(np.frombuffer(content, np.uint8))
    assert found
    assert len(clip.frames) == len(range(5, viewer.scene.num_frames, step))
    assert set(clip.durations.tolist()) == {frame_ms}


def test_one_button_saves_a_picture_and_the_other_a_clip(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    pressed: dict[str, Callable[[SimpleNamespace], None]] = {}
    monkeypatch.setattr(viewer.panel, "button", lambda label, action, is_alone: pressed.update({label: action}))
    LinkPane.build(viewer.panel, viewer)
    viewer.seek(viewer.scene.num_frames - 2)
    browser = Browser()
    for label in ("Save picture", "Save clip"):
        pressed[label](SimpleNamespace(client=browser))
    assert [name.rpartition(".")[2] for name in browser.downloads] == ["png", "webp"]


def test_nobody_waits_for_a_clip_and_who_goes_on_ends_it_with_a_sentence(viewer: Viewer) -> None:
    viewer.seek(0)

    def step_elsewhere() -> None:
        other = threading.Thread(target=viewer.step, args=(4,))
        other.start()
        other.join(timeout=20.0)
        assert not other.is_alive(), "it waits for the clip"

    browser = Browser(step_elsewhere)
    viewer.panel.safely(lambda _: save_clip(viewer, browser), is_alone=False)(None)
    assert viewer.panel.message.value == "the clip was not saved, because another item was shown meanwhile"
    assert (viewer.frame, browser.downloads) == (4, {})
