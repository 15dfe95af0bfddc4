"""Motion files of rigs that no layout knows: drawn as sticks between the file's own joints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from flows.console.app import run_command_line
from flows.viewing.bodies import Bodies, marks
from flows.viewing.own_joints import open_own_joints
from flows.viewing.scene import Scene
from flows.viewing.shelf import Shelf
from flows.viewing.table_views import TABLE_VIEWS
from flows.viewing.viewer import Viewer
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh_joints
from tasks.files.curation import Choosing
from tests.builders.bvh_rigs import body_nodes, bvh_of, world_of_file
from tests.builders.source_samples import bvh_text

REFUSED = InputError("its joints fit none of the known layouts")


def crane(joints: Sequence[str], at_x: float) -> str:
    """Return a root with a chain of joints, each 50 cm over the one before, in a BVH file's words."""
    chain = "".join(f"JOINT {name} {{ OFFSET 0 50 0 CHANNELS 3 Zrotation Xrotation Yrotation\n" for name in joints[1:])
    ends = "End Site { OFFSET 0 50 0 }\n" + "}\n" * len(joints)
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    return f"ROOT {joints[0]} {{ OFFSET {at_x} 0 0 {channels}\n{chain}{ends}"


def write_bvh(path: Path, *rigs: Sequence[str], num_frames: int = 4) -> str:
    """Write a file of one or more such rigs 1 m apart, that rise by 10 cm a frame."""
    rows = []
    for frame in range(num_frames):
        row = [f"{100.0 * at} {10.0 * frame} 0 {' '.join(['0'] * (3 * len(rig)))}" for at, rig in enumerate(rigs)]
        rows.append(" ".join(row))
    hierarchy = "".join(crane(rig, 0.0) for rig in rigs)
    text = f"HIERARCHY\n{hierarchy}MOTION\nFrames: {num_frames}\nFrame Time: 0.04\n" + "\n".join(rows) + "\n"
    path.write_text(text, encoding="utf-8")
    return str(path)


@contextmanager
def opened(*files: str, units_m: Sequence[float] = (0.01,)) -> Iterator[tuple[Viewer, Scene]]:
    with open_own_joints(files, units_m, REFUSED) as shelf:
        shown = Viewer(shelf, choosing=Choosing(Path(files[0]).with_name("curation.txt")))
        try:
            yield shown, TABLE_VIEWS["poses"].scene(shelf, shelf.parts[0], shelf.items(shelf.parts[0])[0])
        finally:
            shown.stop()


def test_two_people_of_unknown_rigs_in_one_file_are_drawn_by_its_joints(tmp_path: Path) -> None:
    file = write_bvh(tmp_path / "cranes.bvh", ["base", "boom", "hook"], ["foot", "mast"])
    with opened(file) as (viewer, scene):
        positions = scene.people.positions_m
        assert (positions.shape[:2], scene.rate_hz) == ((4, 2), 25.0)
        names = scene.people.skeleton.joint_names
        first = positions[2, 0, [names.index(name) for name in ("base", "boom", "hook")]]
        np.testing.assert_allclose(first, [[0, 0.2, 0], [0, 0.7, 0], [0, 1.2, 0]], atol=1e-6)
        second = positions[2, 1, [names.index(name + "'") for name in ("foot", "mast")]]
        np.testing.assert_allclose(second, [[1, 0.2, 0], [1, 0.7, 0]], atol=1e-6)
        drawn = Bodies(scene.people)
        assert not drawn.skins
        lengths = drawn.at(2).rods_scale[:, 2]
        assert sorted(lengths[lengths > 0].round(3).tolist()) == [0.5] * 5, "joints of others are not drawn"
        assert [len(places) for places in marks(scene.people.skeleton, positions[2], drawn.radii_m)] == [0, 0]
        viewer.step(1)
        viewer.describe_frame()
        assert "own joints" in str(viewer.shown.facts.value)


def test_files_of_other_rigs_and_lengths_are_shown_together_as_long_as_both_last(tmp_path: Path) -> None:
    files = [
        write_bvh(tmp_path / "a.bvh", ["base", "boom", "hook"], num_frames=6),
        write_bvh(tmp_path / "b.bvh", ["base", "boom"]),
    ]
    with opened(*files) as (_, scene):
        assert scene.people.positions_m.shape[:2] == (4, 2)
        assert np.isfinite(scene.people.positions_m).all()
    with opened(files[0], units_m=()) as (_, scene):
        tall_m = np.ptp(scene.people.positions_m[0, 0, :, 1])
        assert tall_m == pytest.approx(1.5, rel=0.3), "no unit is known: about as tall as an adult"


def test_joints_of_a_bvh_file_lie_where_its_numbers_say() -> None:
    rng = np.random.default_rng(3)
    nodes = body_nodes(above=["scene", "offset"], kinds=[3, 6, 0], rng=rng)
    text = bvh_of(nodes, rng.uniform(-90.0, 90.0, size=(3, sum(len(node.channels) for node in nodes))))
    _, ((skeleton, positions),) = read_bvh_joints(text)
    for name, expected in world_of_file(text).items():
        np.testing.assert_allclose(positions[:, skeleton.index(name)], expected, atol=1e-9, err_msg=name)


def test_bones_that_stretch_are_drawn_as_long_as_they_are(tmp_path: Path) -> None:
    text = Path(write_bvh(tmp_path / "a.bvh", ["base", "boom"], num_frames=2)).read_text(encoding="utf-8")
    head, _ = text.split("Frame Time: 0.04\n")
    head = head.replace("CHANNELS 3", "CHANNELS 6 Xposition Yposition Zposition", 1)
    frames = [f"0 0 0 0 0 0 0 {tall} 0 0 0 0" for tall in (50, 80)]
    (tmp_path / "a.bvh").write_text("\n".join([f"{head}Frame Time: 0.04", *frames, ""]), encoding="utf-8")
    with opened(str(tmp_path / "a.bvh")) as (_, scene):
        np.testing.assert_allclose(scene.people.positions_m[:, 0, 1, 1], [0.5, 0.8], atol=1e-6)
        assert REFUSED.args[0] in "".join(scene.facts)


def test_a_take_that_is_refused_for_another_reason_stays_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text("HIERARCHY\nROOT a {\n")
    (tmp_path / "b.bvh").write_text(bvh_text(), encoding="utf-8")
    for name in ("a.bvh", "b.bvh"):
        with pytest.raises(InputError) as error, open_own_joints([str(tmp_path / name)], (), REFUSED):
            pass
        assert error.value is REFUSED, name


def test_view_of_an_unknown_rig_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def begin(shelf: Shelf, **options: object) -> None:
        shown.extend(part.table for part in shelf.parts)
        raise InputError("seen enough")

    monkeypatch.setattr("flows.console.view.Viewer", begin)
    monkeypatch.chdir(tmp_path)
    assert run_command_line(["view", write_bvh(tmp_path / "crane.bvh", ["base", "boom", "hook"])]) == 2
    assert shown == ["poses"]


def test_joints_of_two_rigs_keep_names_of_their_own_whatever_marks_they_have(tmp_path: Path) -> None:
    file = write_bvh(tmp_path / "cranes.bvh", ["base", "base'"], ["base", "mast"])
    with opened(file) as (_, scene):
        assert scene.people.skeleton.joint_names[:2] == ("base", "base'")
        assert len(set(scene.people.skeleton.joint_names)) == scene.people.skeleton.num_joints


def test_a_rig_of_one_joint_is_shown_where_it_is(tmp_path: Path) -> None:
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    path, frames = tmp_path / "lamp.bvh", "Frames: 2\nFrame Time: 0.04\n0 100 0 0 0 0\n0 150 0 0 0 0\n"
    path.write_text(f"HIERARCHY\nROOT lamp {{ OFFSET 0 0 0 {channels} }}\nMOTION\n{frames}", encoding="utf-8")
    with opened(str(path)) as (_, scene):
        moved_m = np.diff(scene.people.positions_m[:, 0, 0], axis=0)  # nothing tells which way is up
        np.testing.assert_allclose(np.linalg.norm(moved_m, axis=1), [0.5], atol=1e-6)
