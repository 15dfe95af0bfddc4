"""What the viewer makes of rows: who is shown and behind, in which axes, and the figures of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.viewing.curating import Curation, Moment
from flows.viewing.footage import LIMBS22, size_of
from flows.viewing.scene import Scene
from flows.viewing.shelf import Shelf
from flows.viewing.table_views import TABLE_VIEWS
from flows.viewing.viewer import Viewer
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import centre_and_face
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from storage_schema import Manifest, Store
from tasks.files.curation import Choosing
from tests.builders.known_truth import FRAMES, RATE_HZ, TURNS, lifted_row, pairs_of, put_lifted, put_truth
from tests.builders.storage_rows import put, random_columns
from tests.builders.walkers import random_poses


def scene_of(shelf: Shelf, table: str, item: int = 0) -> Scene:
    part = next(part for part in shelf.parts if part.table == table)
    return TABLE_VIEWS[table].scene(shelf, part, shelf.items(part)[item])


def test_a_lifted_pair_stands_before_the_capture_as_its_camera_saw_it_with_its_image(store: Store) -> None:
    _, videos, poses = put_truth(store)
    rows = [lifted_row(poses, name, at, "fitted", 0.3) for name, at in (("seen", 1), ("hidden", 3), ("seen", 2))]
    rows[2]["sequence_id"] = "of nobody"
    expected_m, residual_m = [0.21, 0.12, 0.3], [0.03, 0.02, 0.04]
    for at, row in enumerate(rows):
        row |= {"expected_error_m": expected_m[at], "residual_m": residual_m[at], "num_joints_seen": 20 + at}
    lifted = put_lifted(store, "all", rows)
    shelf = Shelf(store, [lifted.ref], [video.ref for video in videos])
    scene = scene_of(shelf, "lifted_pairs")
    assert (scene.num_frames, scene.behind_name, scene.has_floor) == (3, "capture", False)
    np.testing.assert_allclose(scene.people.positions_m, [row["pair17_m"] for row in rows], atol=1e-6)
    true = poses["hidden"][4] @ TURNS["film hidden"].T
    np.testing.assert_allclose(scene.behind.frame(1), true - true.reshape(-1, 3).mean(axis=0), atol=1e-6)
    assert np.isnan(scene.behind.frame(2)).all(), "nobody knows who it was"
    np.testing.assert_allclose(scene.curves["expected_error_m"], expected_m)
    np.testing.assert_allclose(scene.curves["residual_m"], residual_m)
    assert scene.say(1) == ["film hidden frame 3, persons 0 and 1", "21 of 28 joints seen"]
    (flat,) = scene.images(1)
    assert (flat.title, flat.size_px, flat.skeleton) == ("film hidden frame 3", (640, 480), PAIR17)
    np.testing.assert_allclose(flat.points_px, np.arange(6 * 34.0, 8 * 34.0).reshape(2, 17, 2))
    assert scene.images(2) == []


def test_draws_have_the_figures_of_their_chain_beside_other_chains_of_their_seed(store: Store) -> None:
    chains = [("ic", 0, 0, 3), ("ic", 0, 1, 2), ("ic", 1, 0, 4), ("cartesian", 0, 0, 3)]
    count = sum(size for *_, size in chains)
    columns = random_columns("draws", count) | {
        name: [chain[at] for chain in chains for _ in range(chain[-1])]
        for at, name in enumerate(("density", "seed_index", "chain"))
    }
    pairs_m = np.concatenate([pairs_of(number)[:3] for number in range(count)])[:count]
    columns |= {"pair17_m": pairs_m, "num_accepted": list(range(count)), "log_density": np.arange(count) - 50.0}
    columns |= {"log_prior": np.arange(count) - 20.0, "log_likelihood": np.full(count, -30.0)}
    columns |= {"sequence_id": ["film seen", *[None] * (count - 1)], "sequence_frame": [4, *[None] * (count - 1)]}
    columns["dissimilarity_m"] = np.array([0.0123, *[np.nan] * (count - 1)])
    draws = put(store, "chains", "draws", {"draws": columns}, {"kind": "draws", "density": "ic"}, density="ic")
    shelf = Shelf(store, [draws.ref])
    labels = [item.label for item in shelf.items(shelf.parts[0])]
    scene = scene_of(shelf, "draws", labels.index("ic seed 0 chain 0"))
    np.testing.assert_allclose(scene.people.positions_m, pairs_m[:3], atol=1e-6)
    assert list(scene.curves) == ["log_density", "log_prior", "log_likelihood"], "the first is compared with others"
    np.testing.assert_array_equal(scene.curves["log_density"], [-50.0, -49.0, -48.0])
    np.testing.assert_array_equal(scene.others, [[-47.0, -46.0, np.nan]])
    matches = "matches film seen frame 4, d_I 1.23 cm"
    assert scene.say(0) == ["steps accepted since the last draw: 0", matches]
    assert scene.say(2) == ["steps accepted since the last draw: 2"]
    assert scene.images(2) == [], "it matches nothing"
    (alone,) = scene.images(0)
    assert alone.title == "this draw in its view"


def put_reconstruction(
    store: Store,
    found_m: np.ndarray,
    pitch_deg: float,
    name: str = "film hidden",
    inputs: tuple[Manifest, ...] = (),
    op14_m: np.ndarray | None = None,
) -> Manifest:
    """Commit what was reconstructed of the held-out take (frame, 2, 22, 3), the last frames first."""
    frames, persons = np.repeat(np.arange(FRAMES - 1), 2)[::-1], np.tile([0, 1], FRAMES - 1)[::-1]
    op14_m = np.zeros((FRAMES - 1, 2, 14, 3)) if op14_m is None else op14_m
    columns = random_columns("motions", len(frames)) | {
        "sequence_id": [name] * len(frames),
        "method": ["windows"] * len(frames),
        "person_id": persons,
        "frame": frames,
        "time_s": frames / RATE_HZ,
        "body22_m": found_m[frames, persons],
        "op14_m": op14_m[frames, persons],
        "score_m": 0.1 * persons + 0.01 * frames,
        "match_take_id": [f"take {person}" for person in persons],
        "match_frame": (10 * frames).tolist(),
    }
    facts = {"kind": "motions", "sequence_ids": [name], "sequence_takes": ["hidden"], "pitch_deg": pitch_deg}
    return put(store, "reconstruction", name, {"motions": columns}, facts, inputs)


def test_a_reconstruction_stands_upright_and_its_error_is_of_limbs_about_the_root(store: Store) -> None:
    """Bodies are a tenth too large, and three metres away: a tenth of the distance of limbs from the root is wrong."""
    _, videos, poses = put_truth(store, "body22_m")
    true = poses["hidden"][1:] @ TURNS["film hidden"].T
    roots = true[:, :, [BODY22.root]]
    motions = put_reconstruction(store, roots + 1.1 * (true - roots) + [0.0, 0.0, 3.0], 15.0)
    scene = scene_of(Shelf(store, [motions.ref], [videos[1].ref]), "motions")
    upright = DatabaseCamera(math.radians(15.0)).camera_from_upright_rotmat
    wanted = (roots + 1.1 * (true - roots) + [0.0, 0.0, 3.0]) @ upright
    np.testing.assert_allclose(scene.people.positions_m, wanted, atol=1e-5)
    error = 0.1 * np.linalg.norm((true - roots)[:, :, LIMBS22], axis=-1).mean(axis=(1, 2))
    np.testing.assert_allclose(scene.curves["error_m"], error, atol=1e-5)
    np.testing.assert_allclose(scene.curves["match_distance_m"], 0.05 + 0.01 * np.arange(FRAMES - 1), atol=1e-6)
    assert (scene.rate_hz, scene.behind_name) == (pytest.approx(RATE_HZ), "capture")
    behind, shown = scene.behind.positions_m, scene.people.positions_m
    assert behind[..., 1].min() == pytest.approx(shown[..., 1].min(), abs=1e-5)
    middles = [motion[0, :, BODY22.root].mean(axis=0) for motion in (behind, shown)]
    np.testing.assert_allclose(middles[0][[0, 2]], middles[1][[0, 2]], atol=1e-5)
    shape = [motion - motion[:1, :1, :1] for motion in (behind, true @ upright)]
    np.testing.assert_allclose(*shape, atol=1e-5)
    assert scene.say(3)[0] == "match take 0 frame 30" or scene.say(3)[0] == "match take 1 frame 30"
    assert [scene.number_of(frame) for frame in range(3)] == [0, 1, 2]
    (flat,) = scene.images(2)
    assert flat.title == "film hidden frame 2"


def test_the_camera_of_a_reconstruction_is_known_where_its_video_is(store: Store) -> None:
    _, videos, poses = put_truth(store, "body22_m")
    motions = put_reconstruction(store, poses["hidden"][1:] @ TURNS["film hidden"].T, 0.0)
    without = scene_of(Shelf(store, [motions.ref]), "motions")
    assert (without.camera, without.behind, list(without.curves)) == (None, None, ["match_distance_m"])
    assert scene_of(Shelf(store, [motions.ref], [videos[1].ref]), "motions").camera is not None


def test_a_clip_is_chosen_and_forgotten_in_any_of_its_frames(store: Store, tmp_path: Path) -> None:
    """The first frame of the reconstruction is frame 2 of its sequence: clips are kept by those of the sequence."""
    shelf = Shelf(store, [put_reconstruction(store, pairs_of(0, 22)[1:], 0.0, "film").ref])
    part = shelf.parts[0]
    (item,) = shelf.items(part)
    scene = replace(scene_of(shelf, "motions"), numbers=np.arange(FRAMES - 1) + 2)
    choosing = Choosing(tmp_path / "curation.txt")
    curation = Curation(shelf, choosing)

    def at(frame: int) -> Moment:
        return Moment(part, item, scene, frame)

    curation.mark("end", at(6))
    assert curation.clip == (0, 6)
    curation.mark("start", at(3))
    assert curation.clip == (3, 6)
    assert curation.lines(at(0))[0].startswith("clip of frames 3 to 6: ")
    name = "/".join(item.names)
    for frame, is_in in ((2, False), (3, True), (6, True), (7, False)):
        curation.begin((3, 6))
        said = curation.decide("reject", at(0), "blurred")
        ((frames, choice),) = choosing.clips("motions", name).items()
        assert (frames, choice.decision, choice.reason) == ((5, 8), "reject", "blurred")
        assert said.startswith(f"motions {choice.name}: rejected")
        curation.begin()
        assert curation.lines(at(0))[1:] == [f"frames 3 to 6 {choice.words}"]
        curation.decide("undo", at(frame), "")
        assert (not choosing.clips("motions", name)) is is_in
    curation.mark("start", at(8))
    assert curation.clip == (8, FRAMES - 2)
    curation.mark("end", at(2))
    assert curation.clip == (2, 2)


@pytest.mark.parametrize("most", [300_000, 90])
def test_nearest_poses_stand_beside_a_motion(store: Store, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """A and B are poses of the database, turned and moved: nothing but these is at no distance."""
    monkeypatch.setattr("flows.viewing.table_views._MAX_PROJECTIONS", most)
    poses = centre_and_face(random_poses(np.random.default_rng(4), 5, spread=0.8)).poses_m
    rows = random_columns("projections", 5) | {"op14_m": poses, "take_id": list("vwxyz"), "frame": 10 * np.arange(5)}
    facts = {"kind": "projections", "rate_hz": RATE_HZ, "pitches_deg": [15.0], "num_poses": 5}
    database = put(store, "projections", "database", {"projections": rows}, facts)
    camera, places = DatabaseCamera(math.radians(15.0)), {"A": (2, 7), "B": (4, 20)}
    turned = [poses[row] @ yaw_rotmat(2.0 * np.pi * yaw / 30).T for row, yaw in places.values()]
    seen = np.tile(np.array(turned) @ camera.camera_from_upright_rotmat.T + [3.0, 1.0, 2.0], (FRAMES - 1, 1, 1, 1))
    motions = put_reconstruction(store, pairs_of(0, 22)[1:], 15.0, "film", (database,), seen)
    scene = scene_of(Shelf(store, [motions.ref]), "motions")
    flats = scene.nearest(4)
    assert [flat.title.partition(":")[0] for flat in flats] == ["A"] * 3 + ["B"] * 3
    for person, flat in enumerate(flats[::3]):
        row, _ = places["AB"[person]]
        assert flat.title == f"{'AB'[person]}: {'vwxyz'[row]} frame {10 * row}, 0.0 cm"
        assert (flat.skeleton, len(flat.points_px)) == (OP14, person + 1)
        assert np.isnan(flat.points_px[:person]).all(), "in the colour of this person"
        image = flat.points_px[person] - flat.points_px[person].mean(axis=0)
        wanted = 400.0 * (seen[0, person, :, :2] - seen[0, person, :, :2].mean(axis=0)) * [1.0, -1.0]
        np.testing.assert_allclose(image, wanted, atol=0.01)
    takes = {flat.title[3] for flat in flats}
    assert takes <= set("vwxyz" if most > 150 else "vxz"), "every second pose where there are too many"
    bare = put_reconstruction(store, pairs_of(0, 22)[1:], 15.0, "bare")
    alone = scene_of(Shelf(store, [bare.ref]), "motions")
    assert alone.nearest(4) == []


def test_2d_poses_stand_as_they_were_captured(store: Store, open_viewer: Callable[..., Viewer]) -> None:
    _, videos, poses = put_truth(store, "body22_m")
    viewer = open_viewer(Shelf(store, [videos[0].ref]))
    np.testing.assert_allclose(viewer.scene.people.positions_m, poses["seen"][1:], atol=1e-6)
    assert (viewer.scene.people.skeleton, viewer.scene.camera is None) == (BODY22, False)
    viewer.wants_flat = True
    viewer.show_item(0)
    assert viewer.scene.people is viewer.scene.flat
    assert (viewer.scene.people.skeleton, viewer.scene.camera) == (PAIR17, None)


@pytest.mark.parametrize(
    ("size", "points", "wanted"),
    [
        ((640.0, 360.0), [[[5000.0, 1.0]]], (640, 360)),
        ((640.0, np.nan), [[[np.nan, np.nan]]], (640, 480)),
        ((np.nan, 360.0), [[[10.0, 20.0], [np.nan, np.nan]], [[110.0, 45.0], [70.0, 220.0]]], (190, 300)),
        ((np.nan, np.nan), [[[-10.0, -30.0]], [[110.0, 220.0]]], (200, 330)),
    ],
)
def test_an_image_of_unknown_size_holds_all_that_was_seen_with_a_margin(
    size: tuple[float, float], points: list[list[list[float]]], wanted: tuple[int, int]
) -> None:
    assert size_of(*size, np.array(points)) == wanted
