"""What the viewer draws, where, and when: each has a known answer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flows.viewing import table_views
from flows.viewing.bodies import Bodies, capsules, marks, surface_gap_curve
from flows.viewing.curves import plot_curves, time_strip
from flows.viewing.room import _ball, _grid, _pale, _surface, across
from flows.viewing.scene import Grid, People
from flows.viewing.shelf import Shelf
from flows.viewing.side_picture import PAPER
from flows.viewing.viewer import Viewer
from pasdedeux.evaluation.pictures import PERSON_COLOURS, rgb
from pasdedeux.plausibility.capsules import standing_m
from pasdedeux.skeletons import BODY22, OP14
from storage_schema import Store
from tests.builders.moving_pairs import swaying_pair
from tests.builders.stored_datasets import put_clips


@pytest.fixture
def viewer(store: Store, open_viewer: Callable[..., Viewer]) -> Viewer:
    return open_viewer(Shelf(store, [put_clips(store, "waltz", 1, 8)[0].ref]))


def test_every_curve_has_a_colour_of_its_own_and_lies_at_its_height() -> None:
    curves = [np.full(5, level) for level in (0.0, 1.0, 2.0, 3.0)]
    curves[-1][3] = np.nan
    image = plot_curves(curves, 0)
    inks = PAPER - np.array([rgb(colour) for colour in PERSON_COLOURS])
    drawn = PAPER - image[[148, 106, 64, 22], 320].astype(float)  # thin lines are paler than their ink
    alike = (drawn @ inks.T) / np.linalg.norm(inks, axis=1) / np.linalg.norm(drawn, axis=1)[:, None]
    colours = alike.argmax(axis=1).tolist()
    assert len(set(colours)) == 4
    assert colours[-1] == 1, "the last of them is who is shown"
    assert (image[[127, 85, 43, 22], [320, 320, 320, 400]] == PAPER).all(), "nothing where nothing is known"


def test_colours_are_given_darker_for_the_lights_but_for_black_and_white() -> None:
    black, grey, white = _pale(np.array([0, 100, 255]))
    assert (black, white) == (0, 255)
    assert 50 < grey < 80


def test_the_figure_is_that_of_the_frame_and_there_is_none_without_curves(viewer: Viewer) -> None:
    rising = np.linspace(0.0, 1.0, 8)
    for curves, is_shown in (({"still": np.ones(8)}, False), ({}, False), ({"acceptance": rising}, True)):
        viewer.curves.show(replace(viewer.scene, curves=curves))
        assert viewer.curves._plot.visible is is_shown
    for frame in (0, 1, 6):
        viewer.curves.draw(frame)
        is_cursor = (viewer.curves._plot.image[:22] == rgb(PERSON_COLOURS[0])).all(axis=(0, 2))
        assert np.flatnonzero(is_cursor).mean() == pytest.approx(frame * 639 / 7, abs=1.0)


@pytest.mark.parametrize(
    ("size", "middle", "height", "down_deg"), [((1600, 900), -0.1, 0.33, 13.0), ((450, 900), 0.0, 0.175, 23.0)]
)
def test_people_are_in_the_part_of_the_page_that_the_panel_leaves(
    viewer: Viewer, size: tuple[int, int], middle: float, height: float, down_deg: float
) -> None:
    """On a wide page the panel is on the right; of a narrow one it takes the lower half."""
    camera = SimpleNamespace(image_width=size[0], image_height=size[1])
    viewer.room._aim(SimpleNamespace(camera=camera, atomic=nullcontext))
    ahead = (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position)
    flat = ahead[[0, 2]] / np.linalg.norm(ahead[[0, 2]])
    assert -flat @ across(viewer.scene.people) > 0.995
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    bodies = viewer.scene.people.positions_m[0].reshape(-1, 3) - camera.position
    y = bodies @ np.cross(right, ahead) / (bodies @ ahead) / np.tan(camera.fov / 2)
    x = bodies @ right / (bodies @ ahead) / np.tan(camera.fov / 2) * size[1] / size[0]
    assert max(np.abs(x).max(), np.abs(y - (size[0] < size[1]) / 2).max()) < (1.0 if size[0] > size[1] else 0.5)
    assert (x.max() + x.min()) / 2 == pytest.approx(middle, abs=0.05)
    tall_m = np.ptp(viewer.scene.people.positions_m[0, ..., 1])
    assert np.ptp(y) / 2 == pytest.approx(height * tall_m / 1.7, rel=0.1)
    assert np.rad2deg(np.arcsin(-ahead[1])) == pytest.approx(down_deg, abs=4.0)


def test_who_is_shown_stands_at_the_place_that_the_data_say(viewer: Viewer) -> None:
    (name,) = (name for name in viewer.room._groups if name.startswith("/people"))
    np.testing.assert_array_equal(viewer.server.scene.get_handle_by_name(name).position, np.zeros(3))


def test_the_nearest_poses_of_a_person_are_sought_by_the_image_about_the_hips(monkeypatch: pytest.MonkeyPatch) -> None:
    poses, asked = np.random.default_rng(5).normal(size=(4, 2, 14, 3)), list[np.ndarray]()
    best = SimpleNamespace(row=[7, 2, 5], yaw_index=[4, 0, 1], distance_m=[0.123, 0.2, np.nan])
    index = SimpleNamespace(search=lambda image, num_neighbours: asked.append(image) or best)
    database = SimpleNamespace(project=lambda first, last: np.zeros((1, 6, 14, 2)))
    takes, frames = np.array([f"take {row}" for row in range(9)]), np.arange(9) * 10
    monkeypatch.setattr(table_views, "_database", lambda *_: (database, index, takes, frames))
    flats = table_views._nearest_poses(None, None, poses, 3)  # type: ignore[arg-type]
    titles = ["take 7 frame 70, 12.3 cm", "take 2 frame 20, 20.0 cm"]
    assert [flat.title for flat in flats] == [f"{name}: {title}" for name in "AB" for title in titles]
    hips = OP14.indices(["left_hip", "right_hip"])
    np.testing.assert_allclose(asked, (poses[3] - poses[3][:, hips].mean(axis=1, keepdims=True))[..., :2])


def test_the_floor_is_a_square_of_lines_a_metre_apart_each_drawn_once() -> None:
    lines = _grid(4.0)
    assert {tuple(line.ravel().tolist()) for line in lines} == {
        (x, 0.0, z, x, 0.0, z + 1.0) for x in range(-2, 3) for z in range(-2, 2)
    } | {(x, 0.0, z, x + 1.0, 0.0, z) for x in range(-2, 2) for z in range(-2, 3)}
    assert lines.shape == (40, 2, 3)


@pytest.mark.parametrize("sides", [8, 16])
def test_rods_and_balls_are_round_and_closed_and_their_triangles_look_outward(sides: int) -> None:
    ball, rod = _ball(sides), _surface(np.ones(2), np.array([-0.5, 0.5]), sides)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 1.0)
    assert (ball.vertices[:, 2].min(), ball.vertices[:, 2].max()) == pytest.approx((-1.0, 1.0))
    assert len(ball.vertices) == sides * (sides // 2 + 1)
    np.testing.assert_allclose(np.linalg.norm(rod.vertices[:, :2], axis=1), 1.0)
    assert set(rod.vertices[:, 2].tolist()) == {-0.5, 0.5}
    for mesh, outward in ((ball, [1.0, 1.0, 1.0]), (rod, [1.0, 1.0, 0.0])):
        a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
        normal, middle = np.cross(b - a, c - a), (a + b + c) / 3.0 * outward
        is_real = np.linalg.norm(normal, axis=1) > 1e-9
        assert (np.einsum("ij,ij->i", normal, middle)[is_real] > 0.0).all()
        assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.vertices)))
    corners = ball.vertices[ball.faces]
    assert 0.7 < np.linalg.det(corners).sum() / 6.0 / (4.0 / 3.0 * np.pi) < 1.0
    a, b, c = rod.vertices[rod.faces].swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area == pytest.approx(2 * sides * np.sin(np.pi / sides))


def test_a_rod_reaches_from_one_end_of_its_capsule_to_the_other() -> None:
    rng = np.random.default_rng(1)
    ends = rng.normal(size=(40, 2, 3))
    ends[0] = [[0, 0, 1], [0, 0, 0]]  # straight down its own axis
    ends[1, 1] = ends[1, 0]  # a bone without length
    ends[2] = np.nan
    shapes = capsules(ends, np.full(40, 0.1))
    turns = Rotation.from_quat(shapes.rods_wxyz[:, [1, 2, 3, 0]])
    half = turns.apply(np.outer(shapes.rods_scale[:, 2], [0.0, 0.0, 0.5]))
    there = np.stack([shapes.rods_m - half, shapes.rods_m + half], axis=1)
    kept = np.arange(40) != 2
    np.testing.assert_allclose(there[kept], ends[kept], atol=2e-6)
    assert (shapes.balls_scale.reshape(40, 2)[2] == 0.0).all(), "who is not there has no size"


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


def turned_pair(angle_rad: float, away_m: float) -> People:
    """Return two T-poses side by side on a line that is turned about the vertical, (2, 2, 22, 3)."""
    person = 1.7 * standing_m(BODY22)
    pair = np.stack([person, person + np.array([away_m, 0.0, 0.0])])
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
    assert wide.shape == (2,)
    assert 0.3 < wide[0] < 2.5
    assert near[0] < 0.0
    assert surface_gap_curve(People(BODY22, turned_pair(0.0, 1.0).positions_m[:, :1])) is None
    strip = time_strip(np.ones((2, 2), bool), None, np.array([0.5, -0.05]))
    assert [tuple(strip[0, at]) for at in (0, -1)] == [(250, 250, 250), (220, 20, 60)]
    assert time_strip(np.ones((2, 2), bool), None, None) is None
