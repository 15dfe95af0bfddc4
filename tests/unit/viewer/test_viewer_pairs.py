"""Pairs in the viewer: what a draw looks like, joints that are moved, what is saved, lifted again and restarted."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flows.viewing.bodies import GAP
from flows.viewing.editing import Editor
from flows.viewing.shelf import Shelf
from flows.viewing.side_picture import Dragged
from flows.viewing.viewer import Viewer
from pasdedeux.errors import InputError
from pasdedeux.formats.pair_file import read_pair_json
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.skeletons import PAIR17
from storage_schema import Manifest, Store
from tasks.lifting import lift_again
from tasks.rows.annotated_pairs import read_seen_pairs
from tests.builders.drawn_pairs import put_draws, put_seeds
from tests.builders.sampling_store import pairs_of, put_annotations, put_take
from tests.builders.toy_runs import wait_until

WRIST = PAIR17.index("left_wrist")
NUM_DRAWS, MATCHED = 5, 7
"""Draws of the chain; the first of them is this frame of the take, which was annotated."""


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, dict[str, Manifest]]:
    """Return a store with a take, its annotations and their views, seeds, and draws near the annotated pairs."""
    store = Store(tmp_path_factory.mktemp("pairs") / "store")
    take = put_take(store, "one")
    annotations, views = put_annotations(store, "one")
    pairs_m = pairs_of("one")
    seeds = put_seeds(store, pairs_m[:3])
    chosen = pairs_m[MATCHED : MATCHED + NUM_DRAWS]
    draws = put_draws(store, "draws", chosen, (seeds, annotations, views), pairs_m[0], matched=f"one/view{MATCHED:05d}")
    named = {"poses": take, "annotations": annotations, "views": views, "seeds": seeds, "draws": draws}
    return store, named


@pytest.fixture
def editor(artifacts: tuple[Store, dict[str, Manifest]], open_viewer: Callable[..., Viewer], tmp_path: Path) -> Editor:
    store, named = artifacts
    refs = [named[name].ref for name in ("annotations", "views", "seeds", "draws")]
    return Editor(open_viewer(Shelf(store, refs)), tmp_path / "out", num_workers=3)


def begin(editor: Editor, table: str, row: int = 0) -> Viewer:
    """Show a row of the first item of a table, and begin to change it."""
    viewer = editor.viewer
    part = next(part for part in viewer.shelf.parts if part.table == table)
    viewer.show_part(part, 0, row)
    editor._is_on.value = True
    editor._begin()
    return viewer


def test_a_moved_joint_keeps_bones_and_lineage(artifacts: tuple[Store, dict[str, Manifest]], editor: Editor) -> None:
    _, named = artifacts
    begin(editor, "draws", 2)
    key, before = named["draws"].ref.key, editor.pose
    plain = read_pair_json(editor.save().read_bytes())
    np.testing.assert_allclose(plain.pair_m, before, atol=1e-6)
    assert (plain.made_from, plain.takes) == (f"draws@{key}#2", ("one",))
    np.testing.assert_array_equal(editor._hand.position, before[0, WRIST].astype(np.float32))
    editor._person.value = "B"
    editor.show_hand()
    target = before[1, WRIST] + np.array([0.03, 0.04, 0.02])
    editor.drag(target)
    after = editor.pose
    assert np.linalg.norm(after[1, WRIST] - target) < 0.01
    np.testing.assert_allclose(bone_lengths(PAIR17, after), bone_lengths(PAIR17, before), atol=1e-9)
    np.testing.assert_array_equal(after[0], before[0])
    path = editor.save()
    assert path.parent == editor.out
    assert path.name.startswith(f"draws-{key[:12]}-2-")
    moved = read_pair_json(path.read_bytes())
    np.testing.assert_allclose(moved.pair_m, after, atol=1e-9)
    assert moved.made_from == f"draws@{key}#2, joints moved by hand"
    assert len(list(editor.out.iterdir())) == 2, "what was saved before stays"


def test_nothing_moves_unless_it_is_asked_for_and_a_take_cannot_be_changed(
    artifacts: tuple[Store, dict[str, Manifest]], editor: Editor, open_viewer: Callable[..., Viewer]
) -> None:
    viewer = begin(editor, "draws")
    buttons = (editor._folder, editor._restart, editor._lift, editor._next)
    assert [button.visible for button in buttons] == [True, True, False, False]
    assert editor._save.label == "Save as seed"
    editor._is_on.value = False
    editor._begin()
    editor.drag(np.zeros(3))
    assert viewer.pose is None
    begin(editor, "seeds")
    assert (editor._folder.visible, editor._hand.visible, editor._restart.visible) == (True, True, False)
    begin(editor, "annotations")
    assert (editor._restart.visible, editor._lift.visible, editor._save.label) == (False, True, "Save the 2D poses")
    store, named = artifacts
    assert not Editor(open_viewer(Shelf(store, [named["poses"].ref])), editor.out)._folder.visible


def test_angles_out_of_range_are_named_up_to_a_few(editor: Editor, monkeypatch: pytest.MonkeyPatch) -> None:
    begin(editor, "draws")
    for bad in ([], [(0, 1)], [(person, angle) for person in (0, 1) for angle in range(4)]):
        invalid = np.zeros((2, len(ANGLES)), dtype=bool)
        for place in bad:
            invalid[place] = True
        monkeypatch.setattr(JointLimits, "invalid_angles", lambda _, pair, found=invalid: found)
        editor.show_limits()
        names = [f"{'AB'[person]} {ANGLES[angle].joint} {ANGLES[angle].angle}" for person, angle in bad]
        more = " and 2 more" if len(bad) == 8 else ""
        wanted = f"{', '.join(names[:6])}{more} out of range" if bad else "all angles in range"
        assert (editor._limits.value, editor._limits.visible) == (wanted, True)


def test_a_draw_has_its_annotation_beside_it(artifacts: tuple[Store, dict[str, Manifest]], editor: Editor) -> None:
    """The draw is the annotated pair itself: nothing but its own image is at no distance."""
    store, named = artifacts
    viewer = begin(editor, "draws")
    assert GAP not in viewer.scene.curves, "draws follow each other in no time"
    drawn, matched, *near = viewer.scene.images(0)
    assert (drawn.title, matched.title) == ("this draw in its view", f"matched: one/view{MATCHED:05d}")
    assert [flat.title.split(", ")[0] for flat in near[:1]] == [f"one/view{MATCHED:05d}"]
    distances = [float(flat.title.split(", ")[1].removesuffix(" cm")) for flat in near]
    assert len(distances) == 3
    assert distances == sorted(distances)
    assert distances[0] < 0.05 < distances[1]
    seen, _ = read_seen_pairs(store, named["annotations"].ref, named["views"].ref, num_hypotheses=1)
    (image_m,) = [pair.image_m for place, pair in seen.items() if place.sequence_id == f"one/view{MATCHED:05d}"]
    for flat in (matched, near[0]):
        across = flat.points_px - flat.points_px[0, 0]
        np.testing.assert_allclose(across, 400.0 * (image_m - image_m[0, 0]) * [1.0, -1.0], atol=1e-6)
        assert np.nanmin(flat.points_px) == pytest.approx(40.0)
    assert viewer.scene.images(1) == [], "it matches nothing"


@pytest.mark.parametrize("moved_px", [0.0, 12.0])
def test_2d_poses_are_lifted_again_as_they_are_now_beside_the_pair_of_before(
    artifacts: tuple[Store, dict[str, Manifest]], editor: Editor, moved_px: float
) -> None:
    store, named = artifacts
    viewer = begin(editor, "annotations", 2)
    points = editor.image_px()
    assert (viewer.scene.is_flat, GAP in viewer.scene.curves) == (True, False), "an image has no bodies"
    if moved_px:
        points[1, WRIST] += [moved_px, -moved_px]
        drag = viewer.side.on_drag
        drag(Dragged(1, WRIST, points[1, WRIST], is_last=True))
    place = viewer.item.read(store, "annotations", ["sequence_id", "frame"])
    moment = str(place["sequence_id"][2]), int(place["frame"][2])
    refs = named["annotations"].ref, named["views"].ref
    before, after = lift_again(store, *refs, [named["draws"].ref, named["seeds"].ref], moment, points)
    editor.lift()
    scene = viewer.scene
    assert (scene.num_frames, scene.behind_name, viewer.frame) == (1, "before", 0)
    np.testing.assert_allclose(scene.behind.frame(0), before, atol=1e-6)
    np.testing.assert_allclose(scene.people.frame(0), after, atol=1e-5)
    away_cm = 100.0 * np.linalg.norm(after - before, axis=-1).mean()
    assert bool(away_cm > 0.1) is bool(moved_px)
    said = f"lifted again: joints moved by {away_cm:.1f} cm on average; grey is the pair of before"
    assert viewer.panel.message.value == said
    assert viewer.moment.row == 2, "a link leads to what was lifted"
    np.testing.assert_allclose(scene.images(0)[0].points_px, points, atol=1e-3)
    assert editor._lift.label == "Back to the 2D poses"
    editor.lift()
    assert viewer.scene.people is viewer.scene.flat
    assert editor._lift.label == "Lift again"


def test_2d_poses_without_views_are_not_lifted(
    artifacts: tuple[Store, dict[str, Manifest]], open_viewer: Callable[..., Viewer], tmp_path: Path
) -> None:
    store, named = artifacts
    editor = Editor(open_viewer(Shelf(store, [named["annotations"].ref, named["draws"].ref])), tmp_path)
    begin(editor, "annotations")
    with pytest.raises(InputError, match="the study has no views of these annotations, so they cannot be lifted"):
        editor.lift()


@pytest.mark.parametrize(("code", "word"), [(0, "done"), (3, "failed")])
def test_a_restart_is_followed_and_its_draws_are_offered_in_a_part_of_their_own(
    tmp_path: Path, open_viewer: Callable[..., Viewer], monkeypatch: pytest.MonkeyPatch, code: int, word: str
) -> None:
    store, pairs_m = Store(tmp_path / "store"), pairs_of("one")
    draws = put_draws(store, "draws", pairs_m[:3], (put_seeds(store, pairs_m[:1]),), pairs_m[0])
    program, said, go = tmp_path / "python", tmp_path / "said", tmp_path / "go"
    waiting = f"while [ ! -e {go} ]; do sleep 0.02; done"
    program.write_text(f'#!/bin/sh\necho "$@" > {said}\necho 1 of 2\n{waiting}\necho 2 of 2\necho\nexit {code}\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    viewer = open_viewer(Shelf(store, [draws.ref]))
    editor = Editor(viewer, tmp_path / "out", num_workers=3)
    try:
        begin(editor, "draws", 1)
        editor.restart()
        wait_until(lambda: editor._progress.value == "1 of 2", "the first line", limit_s=20.0)
        with pytest.raises(InputError, match="a restart is already running"):
            editor.restart()
        (seed,) = editor.out.iterdir()
        words = f"restart draws@{draws.ref.content_digest[:16]}#1 --edited {seed} --store {store} --workers 3"
        assert said.read_text().split() == ["-m", "flows.console", *words.split()]
        for number, name in enumerate((seed.name, "another.json")):
            file = put_seeds(store, pairs_m[:1], f"of {name}", files=((name, f"{number}" * 64),))
            for part in ("first", "second"):
                put_draws(store, f"{part} of {name}", pairs_m[:3], (file,), pairs_m[0])
        go.touch()
        wait_until(lambda: str(editor._progress.value).startswith(word), "the end", limit_s=20.0)
        wait_until(lambda: len(viewer.shelf.parts) == 3, "the draws", limit_s=20.0)
    finally:
        go.touch()
    assert editor._progress.value == f"{word}: 2 of 2"
    names = [part.name for part in viewer.shelf.parts if part.name.startswith("restart")]
    assert sorted(names) == [f"restart {seed.stem} {part} of {seed.name}" for part in ("first", "second")]
    assert [len(part.refs) for part in viewer.shelf.parts] == [1, 1, 1]
    assert set(names) <= {label.partition(": ")[2] or label for label in viewer.shown.part.options}
