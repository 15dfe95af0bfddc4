"""The viewer on the small study, in a real browser where there is one: look, play, choose, change, restart."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flows.viewing.editing import Editor
from flows.viewing.scene import Flat
from flows.viewing.shelf import open_shelf
from flows.viewing.side_picture import DRAG_LABEL, PicturePanel, picture_size
from flows.viewing.table_views import TABLE_VIEWS
from flows.viewing.viewer import Viewer
from pasdedeux.arrays import Array
from pasdedeux.formats.pair_file import read_pair_json
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22, PAIR17
from storage_schema import Store
from tasks.files.curation import Choosing, read_choices
from tests.builders.browser import Tab, open_page
from tests.builders.real_study import BuiltStudy
from tests.builders.toy_runs import wait_until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def editor(small: BuiltStudy, tmp_path_factory: pytest.TempPathFactory, prefect_home: Path) -> Iterator[Editor]:
    """Return the editor of a viewer on a copy of the small study."""
    folder = tmp_path_factory.mktemp("viewing")
    os.environ["PREFECT_HOME"] = str(prefect_home)  # a restart is a process of its own
    viewer = Viewer(open_shelf(Store(small.copy_store(folder)), "small"), choosing=Choosing(folder / "curation.txt"))
    yield Editor(viewer, folder / "restarts", num_workers=0)
    viewer.stop()
    del os.environ["PREFECT_HOME"]


def part_of(viewer: Viewer, table: str) -> None:
    viewer.show_part(next(part for part in viewer.shelf.parts if part.table == table))


def test_every_table_with_people_is_shown_and_described(editor: Editor) -> None:
    viewer = editor.viewer
    assert {part.table for part in viewer.shelf.parts} == set(TABLE_VIEWS)
    for table in TABLE_VIEWS:
        part_of(viewer, table)
        assert np.isfinite(viewer.scene.people.positions_m).any(), table
        for frame in {0, viewer.scene.num_frames - 1}:
            viewer.seek(frame)
            viewer.describe_frame()
            assert viewer.shown.facts.value.startswith(f"frame {frame} of "), table
            viewer.visit(viewer.moment.reference)
            assert (viewer.part.table, viewer.frame) == (table, frame), "a link leads back"


def test_a_slider_moves_through_the_variants_that_were_built(editor: Editor) -> None:
    viewer = editor.viewer
    part_of(viewer, "variants")
    assert [slider.label for slider in viewer.scales.sliders if slider.visible] == ["person A"]
    for value, scale in ((1.25, "1.25"), (0.9, "0.95"), (0.0, "0.75")):
        viewer.scales.move(0, value)
        assert viewer.item.names[1] == f"A-uniform-{scale}"
        assert viewer.scales.sliders[0].value == float(scale)


def test_the_camera_of_a_reconstruction_sees_it_where_its_people_were_seen(editor: Editor) -> None:
    viewer = editor.viewer
    part_of(viewer, "motions")
    scene, names = viewer.scene, ("left_wrist", "right_ankle", "left_knee", "right_elbow")
    assert scene.camera is not None
    away = []
    for frame in range(scene.num_frames):
        limbs = scene.people.frame(frame)[:, BODY22.indices(names)]
        away.append(scene.camera.project(limbs).px - scene.images(frame)[0].points_px[:, PAIR17.indices(names)])
    height = float(np.ptp(scene.images(0)[0].points_px[..., 1]))
    assert np.nanmedian(np.linalg.norm(away, axis=-1)) < 0.05 * height
    assert "error (cm)" in viewer.curves.chosen.options, "the truth is known"
    assert scene.nearest is not None
    nearest = scene.nearest(1)
    assert len(nearest) == 3 * scene.people.positions_m.shape[1]
    assert nearest[0].title.startswith("A: waltz frame ")


def test_a_clip_of_a_reconstruction_is_marked_rejected_and_forgotten(editor: Editor) -> None:
    viewer = editor.viewer
    part_of(viewer, "motions")
    name, first = "/".join(viewer.item.names), viewer.scene.number_of(0)
    for frame, edge in ((3, "start"), (6, "end")):
        viewer.seek(frame)
        viewer.choices.mark_clip(edge)  # type: ignore[arg-type]
    viewer.choices.decide("reject")
    ((frames, choice),) = viewer.curation.choosing.clips("motions", name).items()
    assert (choice.decision, frames) == ("reject", (first + 3, first + 6))
    viewer.show_item(viewer.index)
    viewer.seek(5)
    viewer.describe_frame()
    assert "frames 3 to 6 rejected" in viewer.shown.facts.value
    assert viewer.curation.choosing.about("motions", name) is None
    viewer.choices.decide("undo")
    assert not viewer.curation.choosing.clips("motions", name)


def test_a_dragged_joint_keeps_bones_and_the_seed_is_read_back(editor: Editor) -> None:
    viewer = editor.viewer
    part_of(viewer, "draws")
    editor._is_on.value = True
    editor.show_hand()
    before = editor.pose
    target = before[0, PAIR17.index("left_wrist")] + np.array([0.05, 0.1, 0.05])
    editor.drag(target)
    after = editor.pose
    np.testing.assert_allclose(bone_lengths(PAIR17, after), bone_lengths(PAIR17, before), atol=1e-9)
    np.testing.assert_array_equal(after[1], before[1])
    assert np.linalg.norm(after[0, PAIR17.index("left_wrist")] - target) < 0.01
    saved = read_pair_json(editor.save().read_bytes())
    np.testing.assert_allclose(saved.pair_m, after, atol=1e-12)
    assert saved.made_from.endswith("joints moved by hand")
    assert saved.takes
    assert saved.sources
    editor.drag(np.array([9.0, 9.0, 9.0]))
    np.testing.assert_allclose(bone_lengths(PAIR17, editor.pose), bone_lengths(PAIR17, before), atol=1e-9)


def test_a_corrected_2d_joint_is_lifted_again(editor: Editor) -> None:
    viewer = editor.viewer
    part_of(viewer, "annotations")
    editor._is_on.value = True
    editor._begin()
    viewer.seek(2)
    was = editor.image_px()
    np.testing.assert_allclose(was, viewer.scene.images(2)[0].points_px, atol=1e-3)
    joint = PAIR17.index("left_wrist")
    editor.drag(editor.pose[0, joint] + np.array([0.3, 0.0, 0.0]))
    now = editor.image_px()
    assert np.abs(now - was)[0, joint, 0] > 10
    editor.lift()
    assert viewer.scene.behind is not None
    moved = np.linalg.norm(viewer.scene.people.positions_m - viewer.scene.behind.positions_m, axis=-1)
    assert moved.max() > 0.01
    editor.lift()
    assert viewer.scene.flat is not None, "back to the 2D poses"
    editor._is_on.value = False
    editor._begin()


def wait_for(what: str, is_so: Callable[[], object]) -> None:
    wait_until(lambda: bool(is_so()), what, limit_s=240.0)


def screenshot(tab: Tab, name: str, folder: Path) -> None:
    kept = Path(os.environ.get("PASDEDEUX_SCREENSHOTS", folder))
    kept.mkdir(parents=True, exist_ok=True)
    assert tab.screenshot(kept / f"{name}.png").stat().st_size > 10_000


FACTS = "[...document.querySelectorAll('textarea')].some((one) => one.value.startsWith('frame 0 of'))"
PICTURE = (
    "[...document.querySelectorAll('img')].find((one) => one.parentElement.parentElement.textContent === "
    f"'{DRAG_LABEL}')"
)


def drag_joint(tab: Tab, flat: Flat, joint: int, *, away_px: float) -> None:
    """Drag a joint of the first person in the side picture to the right, by pixels of its image."""
    tab.run(f"{PICTURE}.scrollIntoView({{block: 'center'}})")
    x, y, width = tab.run(f"(() => {{ const b = {PICTURE}.getBoundingClientRect(); return [b.x, b.y, b.width]; }})()")
    panel = PicturePanel.of(flat, picture_size([flat]))
    steps = [[0.0, 0.0], [0.5 * away_px, 3.0], [away_px, 0.0]]
    tab.mouse(*(np.array([x, y]) + width / 640 * panel.place(flat.points_px[0, joint] + step) for step in steps))


def drag_hand(tab: Tab, viewer: Viewer, editor: Editor) -> None:
    """Drag the handle at a joint along its x axis, which a camera in front of it sees from the side."""
    (client,) = viewer.server.get_clients().values()
    before, hand = editor.pose, np.array(editor._hand.position)

    # On the page: a browser that draws slowly draws fewer pixels, and says that its camera has those.
    box = tab.run(
        "(() => { const b = document.querySelector('canvas').getBoundingClientRect(); "
        "return [b.x, b.y, b.width, b.height]; })()"
    )
    corner, size = np.array(box[:2]), np.array(box[2:])

    def look() -> None:
        client.camera.position, client.camera.look_at = hand + np.array([0.0, 0.3, 2.0]), hand

    def seen(point: Array) -> Array:
        turn = Rotation.from_quat(np.asarray(client.camera.wxyz)[[1, 2, 3, 0]])
        in_camera = turn.inv().apply(point - client.camera.position)
        focal = size[1] / 2 / np.tan(client.camera.fov / 2)
        return np.asarray(corner + size / 2 + focal * in_camera[:2] / in_camera[2])

    def pull() -> None:
        tab.mouse(*(seen(hand + np.array([across, 0.0, 0.0])) for across in (0.2, 0.25, 0.3)))

    tries = cycle([look, pull])  # who misses the handle has turned the camera

    def is_dragged() -> bool:
        if viewer.pose is None:
            next(tries)()
        return viewer.pose is not None

    wait_for("the drag", is_dragged)
    wait_for("its end", lambda: np.abs(editor.pose - before)[0, PAIR17.index("left_wrist"), 0] > 0.02)
    np.testing.assert_allclose(bone_lengths(PAIR17, editor.pose), bone_lengths(PAIR17, before), atol=1e-9)


def test_in_a_browser_people_look_play_step_filter_choose_and_restart(editor: Editor, tmp_path: Path) -> None:
    viewer = editor.viewer
    part_of(viewer, "variants")
    with open_page(viewer.url, tmp_path) as tab:
        wait_for("the page", lambda: viewer.server.get_clients() and tab.run("!!document.querySelector('canvas')"))
        wait_for("the panel", lambda: tab.run(FACTS))
        tab.press("ArrowRight")
        wait_for("a step", lambda: viewer.frame == 1)
        tab.press(" ")
        wait_for("playing", lambda: viewer.is_playing and viewer.frame > 3)
        tab.press(" ")
        wait_for("the stop", lambda: not viewer.is_playing)
        tab.press("End")
        wait_for("the end", lambda: viewer.frame == viewer.scene.num_frames - 1)
        screenshot(tab, "variants-wide", tmp_path)
        first = viewer.item.names
        tab.press("x")
        wait_for("a rejection", lambda: read_choices(viewer.curation.choosing.path))
        assert read_choices(viewer.curation.choosing.path)["variants " + "/".join(first)].decision == "reject"
        tab.press("ArrowDown")
        wait_for("the next item", lambda: viewer.item.names != first)
        tab.press("k")
        wait_for("an acceptance", lambda: len(read_choices(viewer.curation.choosing.path)) == 2)
        viewer.listing.only.value = "rejected"
        viewer.list_anew()
        assert [viewer.shelf.items(viewer.part)[at].names for at in viewer.listing.order] == [first]
        viewer.listing.only.value = "all"
        with open_page(f"{viewer.url}?at={viewer.moment.reference.replace('#', '%23')}", tmp_path, width=400) as narrow:
            wait_for("a second browser", lambda: len(viewer.server.get_clients()) == 2)
            wait_for("its people", lambda: narrow.run("!!document.querySelector('canvas')"))
            screenshot(narrow, "variants-narrow", tmp_path)
            assert narrow.errors == []
        part_of(viewer, "annotations")
        tab.click("Change and restart")
        tab.click("change this pair")
        wait_for("the 2D poses", lambda: tab.run(f"!!({PICTURE})"))
        joint, before = PAIR17.index("left_wrist"), viewer.scene.images(viewer.frame)[0]
        drag_joint(tab, before, joint, away_px=60.0)
        wait_for("the drag", lambda: viewer.image_px is not None)
        wait_for("its end", lambda: abs(viewer.image_px - before.points_px)[0, joint, 0] > 57.0)
        screenshot(tab, "annotations-corrected", tmp_path)
        part_of(viewer, "draws")
        wait_for("the handle", lambda: editor._hand.visible)
        drag_hand(tab, viewer, editor)
        tab.click("Restart chains from here")
        wait_for("the restart", lambda: editor.process is not None)
        assert tab.errors == []
        hosts = {url.split("/")[2] for url in tab.requests if url.startswith(("http", "ws"))}
        assert hosts == {viewer.url.split("/")[2]}, "nothing is loaded from elsewhere"
    assert editor.process is not None
    wait_until(lambda: editor.process is None or editor.process.poll() is not None, "chains", limit_s=300.0)
    wait_for("their draws", lambda: any(part.name.startswith("restart") for part in viewer.shelf.parts))
    assert editor.process.returncode == 0, "it went on without a browser"
    wait_for("its last word", lambda: str(editor._progress.value).startswith("done: "))
