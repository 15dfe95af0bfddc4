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
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from flows.viewing.editing import Editor
from flows.viewing.listing import qualities
from flows.viewing.saving import LinkPane, encode_clip, encode_image, save_clip
from flows.viewing.scene import Flat
from flows.viewing.shelf import Shelf, moment_reference, open_shelf
from flows.viewing.side_picture import Dragged, PicturePanel, Pointer, SidePicture
from flows.viewing.table_views import TABLE_VIEWS
from flows.viewing.viewer import Viewer
from pasdedeux.errors import InputError
from pasdedeux.skeletons import PAIR17
from storage_schema import Store, new_run
from tasks.files.curation import Choosing
from tests.builders.command_line import CommandLine
from tests.builders.ingest_runs import duet_store
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
    with viewer.lock:
        assert asked(viewer, f"{path_of(viewer)}?at=poses:short%23200000").status == 200
    wait_until(lambda: "200000" in viewer.panel.message.value, "the visit", limit_s=20.0)


def test_of_a_take_the_figures_of_the_person_who_is_worst_stand(store: Store) -> None:
    (take,) = (manifest for manifest in store.artifacts("ingest") if "poses" in manifest.tables)
    rows = random_columns("take_quality", 3) | {"take_id": ["waltz"] * 3, "verdict": ["warn", "fail", "pass"]}
    judged = put(store, "checks", take.partition, {"take_quality": rows}, {})
    shelf = Shelf(store, [take.ref], [judged.ref])
    figures = qualities(shelf, shelf.parts[0])["waltz",]
    assert figures["verdict"] == "fail"


def test_frames_are_stepped_and_stay_within_the_item(viewer: Viewer) -> None:
    viewer.seek(0)
    last = viewer.scene.num_frames - 1
    for step, frame in ((-1, 0), (last + 1, last), (-1, last - 1)):
        viewer.step(step)
        assert viewer.frame == frame


def test_keys_step_frames_and_items(store: Store, open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    keys: dict[str, Callable[..., None]] = {}
    monkeypatch.setattr("flows.viewing.panel.Panel.bind", lambda _, label, key, action: keys.update({key: action}))
    shown = open_viewer(open_shelf(store, None))
    steps: list[Any] = []
    monkeypatch.setattr(shown, "step", steps.append)
    monkeypatch.setattr(shown, "step_item", lambda by: steps.append(("item", by)))
    for key in ("arrowleft", "arrowright", "arrowup", "arrowdown"):
        keys[key](None)
    assert steps == [-1, 1, ("item", -1), ("item", 1)]


def test_a_message_is_there_until_another_item_is_shown(viewer: Viewer) -> None:
    for show in (lambda: viewer.show_item(0), lambda: viewer.show_part(viewer.part)):
        viewer.panel.tell("no frame of this item fails or has a warning")
        assert viewer.panel.message.visible
        show()
        assert (viewer.panel.message.value, viewer.panel.message.visible) == ("", False)


class Broken:
    """An event of which nothing can be read, and a function that fails."""

    def __call__(self, *_: object, **__: object) -> None:
        raise IndexError("broken")

    def __getattr__(self, name: str) -> None:
        raise IndexError("broken")


def callbacks_of(viewer: Viewer) -> list[Callable[[Any], object]]:
    """Return everything that viser calls for this viewer, of widgets, keys, handles in the room, and visitors."""
    gui, scene = viewer.server.gui, viewer.server.scene
    callbacks = [callback for handle in gui._gui_input_handle_from_uuid.values() for callback in handle._impl.update_cb]
    callbacks += [
        callback for command in gui._command_handle_from_uuid.values() for callback in command._impl.trigger_cb
    ]
    callbacks += [
        callback
        for handle in scene._handle_from_transform_controls_name.values()
        for callback in handle._impl_aux.update_cb
    ]
    return [*callbacks, *viewer.server._client_connect_cb]


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


def test_a_failure_stops_playing_and_is_shown(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer.seek(0)
    with monkeypatch.context() as patch:
        patch.setattr(viewer.room, "show_frame", Broken())
        viewer.play(True)
        wait_until(lambda: not viewer.is_playing, "the stop", limit_s=20.0)
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
    monkeypatch.setitem(TABLE_VIEWS, viewer.part.table, replace(TABLE_VIEWS[viewer.part.table], scene=Broken()))  # type: ignore[arg-type]
    viewer.visit("poses:short/waltz#0")
    assert viewer.panel.message.value == "IndexError: broken"
    assert (viewer.part, viewer.index, viewer.scene) == shown


def test_pictures_are_of_the_frame_of_their_scene_while_another_is_put_in_place(viewer: Viewer) -> None:
    asked: list[int] = []
    viewer.seek(5)
    with viewer.lock:
        whole = viewer.scene
        viewer.scene = replace(whole, images=lambda frame: asked.append(frame) or [])
        thread = threading.Thread(target=viewer.flats)
        thread.start()
        thread.join(timeout=0.2)
        viewer.frame = 0
    thread.join(timeout=20.0)
    assert set(asked) == {0}
    viewer.scene = whole


def test_film_that_is_read_too_late_is_not_shown(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
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


def asked(viewer: Viewer, path: str, **headers: str) -> http.client.HTTPResponse:
    """Return the answer of its server, which has the page only if it is 200."""
    with closing(http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20.0)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        assert (b"<title>pasdedeux</title>" in answer.read()) is (answer.status == 200)
        return answer


def test_other_hosts_and_pages_are_refused_before_the_handshake(viewer: Viewer) -> None:
    port = viewer.server.get_port()

    def status(path: str = path_of(viewer), **headers: str) -> int:
        answer = asked(viewer, path, **headers)
        policy = answer.getheader("Content-Security-Policy", "")
        assert ("default-src 'self'" in policy) is (answer.status == 200)
        return answer.status

    assert status() == 200
    answer = asked(viewer, f"{path_of(viewer)[:-1]}?at=poses:study")
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
    address_here = next(info for info in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET))[4]
    if not address_here[0].startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(address_here[:2], timeout=5.0)


def test_refusals_are_one_sentence(store: Store, tmp_path: Path, viewer: Viewer, invoke: CommandLine) -> None:
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
    is_read, clip = cv2.imdecodeanimation(np.frombuffer(encode_clip(images, 10.0), np.uint8))
    assert is_read
    assert [frame.shape[:2] for frame in clip.frames] == [(48, 64)] * 3
    assert list(clip.durations) == [100] * 3
    away = [
        np.abs(frame[..., 2::-1].astype(float) - image).mean() for frame, image in zip(clip.frames, images, strict=True)
    ]
    assert max(away) < 8.0, "the same colours but for compression"


@pytest.mark.parametrize("size_px", [(640, 480), (100, 900), (1920, 1080)])
def test_a_pixel_is_found_again_where_its_panel_shows_it(size_px: tuple[int, int]) -> None:
    panel = PicturePanel.of(Flat(PAIR17, np.zeros((2, 17, 2)), size_px, "a"), (640, 480))
    points = np.random.default_rng(3).uniform(0.0, size_px, (20, 2))
    np.testing.assert_allclose([panel.point(panel.place(point)) for point in points], points, atol=1e-9)
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
    assert [(drag.person, drag.joint, drag.is_last) for drag in heard] == [(1, 9, False), (1, 9, False), (1, 9, True)]
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
    assert [(drag.person, drag.joint) for drag in heard] == [(1, 3), (1, 3)]
    np.testing.assert_allclose(heard[-1].point_px, [320.0, 220.0])


def test_the_pointer_is_heard_from_the_page_alone(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Pointer] = []
    monkeypatch.setattr(viewer.side, "point", heard.append)
    ours = {"X-Pointer": "1"}
    for path, headers, wanted in (
        ("pointer/down/0.25/0.50000", {}, 404),  # a page elsewhere cannot send the header
        ("pointer/down/0.25/0.5", {"Origin": "http://elsewhere.example", **ours}, 403),
        ("pointer/press/0.25/0.5", ours, 404),
        ("pointer/down/0.25/-0.5", ours, 204),
    ):
        assert asked(viewer, path_of(viewer) + path, **headers).status == wanted
    wait_until(lambda: bool(heard), "the pointer", limit_s=20.0)
    assert heard == [Pointer("down", 0.25, -0.5)]


def tree(store: Store) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in sorted(store.root.rglob("*"))}


def test_looking_writes_nothing_into_the_store(store: Store, tmp_path: Path, open_viewer: OpenViewer) -> None:
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
    is_read, clip = cv2.imdecodeanimation(np.frombuffer(content, np.uint8))
    assert is_read
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
        thread = threading.Thread(target=viewer.step, args=(4,))
        thread.start()
        thread.join(timeout=20.0)
        assert not thread.is_alive(), "it waits for the clip"

    browser = Browser(step_elsewhere)
    viewer.panel.safely(lambda _: save_clip(viewer, browser), is_alone=False)(None)
    assert viewer.panel.message.value == "the clip was not saved, because another item was shown meanwhile"
    assert (viewer.frame, browser.downloads) == (4, {})
