"""Check the local frame of a pair, and projections under views given in it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.cameras.frames import (
    angle_between_directions,
    angles_of_direction,
    local_frame,
    pair_frame,
    project_pair,
    true_direction,
)
from pasdedeux.cameras.orthographic import metres_from_pixels, view_rotmat
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import direction_of_angles


def random_pairs(seed: int, count: int = 20) -> np.ndarray:
    """Return random pairs with upright torsos, about a metre apart."""
    rng = np.random.default_rng(seed)
    pairs = rng.normal(scale=0.3, size=(count, 2, 17, 3))
    pairs[:, :, PAIR17.index("neck")] = pairs[:, :, 0] + [0, 0.5, 0] + rng.normal(scale=0.1, size=(count, 2, 3))
    pairs[:, 1] += [0.9, 0.0, 0.3]
    return pairs


def random_rotation(seed: int) -> np.ndarray:
    return rotmat_from_unitquat(normalise(np.random.default_rng(seed).normal(size=4)))


def test_the_local_frame_solves_the_published_system() -> None:
    pairs = random_pairs(0)
    frame = pair_frame(pairs)
    i, j, k = np.moveaxis(frame.axes, -1, 0)
    roots = pairs[:, :, 0]
    backbones = normalise(pairs[:, :, PAIR17.index("neck")] - roots)
    np.testing.assert_allclose(i, normalise(roots[:, 1] - roots[:, 0]))
    np.testing.assert_allclose(j, normalise(backbones.sum(axis=1)))
    np.testing.assert_allclose(k, np.cross(i, j))
    directions = normalise(np.random.default_rng(1).normal(size=(20, 3)))
    abc = frame.coordinates(directions)
    np.testing.assert_allclose(frame.direction(abc), directions, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(abc, axis=-1), 1.0)


@pytest.mark.parametrize(
    ("roots", "backbones"),
    [
        ([[0, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 1, 0]]),
        ([[0, 0, 0], [0, 1, 1e-4]], [[0, 1, 0], [0, 1, 0]]),
        ([[0, 0, 0], [0, 0, 0]], [[0, 1, 0], [0, 1, 0]]),
        ([[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [0, -1, 0]]),
        ([[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]]),
        ([[0, 0, 0], [0, -1, 0]], [[0.1, 1, 0], [-0.1, 1, 0]]),
    ],
)
def test_degenerate_pairs_have_a_finite_invertible_frame(
    roots: list[list[float]], backbones: list[list[float]]
) -> None:
    frame = local_frame(np.array(roots, dtype=float), np.array(backbones, dtype=float))
    assert np.linalg.svd(frame.axes)[1].min() > 0.1
    assert np.linalg.det(frame.axes) > 0


@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_views_and_projections_do_not_change_when_the_pair_and_the_camera_move_together(seed: int, turn: int) -> None:
    pairs, rotmat = random_pairs(seed, 3), random_rotation(turn)
    shift = np.array([0.3, -2.0, 1.0])
    camera = normalise(np.random.default_rng(seed).normal(size=3))
    moved = pairs @ rotmat.T + shift
    abc = pair_frame(pairs).coordinates(np.broadcast_to(camera, (3, 3)))
    np.testing.assert_allclose(pair_frame(moved).coordinates(np.broadcast_to(rotmat @ camera, (3, 3))), abc, atol=1e-8)
    np.testing.assert_allclose(project_pair(moved, abc), project_pair(pairs, abc), atol=1e-8)


def test_a_far_pinhole_sees_what_the_projection_under_the_true_view_shows() -> None:
    pairs = random_pairs(3, 6)
    middle = pairs[:, :, 0].mean(axis=1)
    for pair, centre in zip(pairs, middle, strict=True):
        camera = look_at_camera(centre, distance_m=5000.0, yaw_rad=2.1, pitch_rad=0.2, focal_px=5e6)
        seen = metres_from_pixels(camera.project(pair).px, 1e-3, camera.principal_point_px)
        shown = project_pair(pair, true_direction(pair, camera))
        # They differ by a turn in the image only: compare as complex numbers.
        a, b = seen.reshape(-1, 2) @ [1, 1j], shown.reshape(-1, 2) @ [1, 1j]
        turn = np.vdot(b, a)
        np.testing.assert_allclose(a, b * turn / abs(turn), atol=2e-3)


def test_the_backbones_point_up_in_the_image_and_nothing_is_mirrored() -> None:
    pair = np.zeros((2, 17, 3))
    pair[:, PAIR17.index("neck")] = [0, 0.5, 0]
    pair[1] += [1.0, 0, 0]
    pair[0, PAIR17.index("left_wrist")] = [0, 0.1, 0.4]
    front = project_pair(pair, np.array([0.0, 0.0, 1.0]))
    assert front[1, 0, 0] > front[0, 0, 0]
    assert front[0, PAIR17.index("neck"), 1] > front[0, 0, 1]
    side = project_pair(pair, np.array([1.0, 0.0, 0.0]))
    assert side[0, PAIR17.index("left_wrist"), 0] == pytest.approx(-0.4)
    assert project_pair(pair, np.ones((5, 1, 3))).shape == (5, 1, 2, 17, 2)


def test_swapping_the_people_swaps_their_views_and_keeps_the_picture() -> None:
    pairs = random_pairs(4)
    abc = normalise(np.random.default_rng(4).normal(size=(20, 3)))
    swapped = project_pair(pairs[:, ::-1], abc * [-1.0, 1.0, -1.0])
    np.testing.assert_allclose(swapped[:, ::-1], project_pair(pairs, abc), atol=1e-12)


def test_angles_and_directions_invert_each_other() -> None:
    abc = normalise(np.random.default_rng(5).normal(size=(200, 3)))
    np.testing.assert_allclose(direction_of_angles(*angles_of_direction(abc)), abc, atol=1e-12)
    assert angles_of_direction(np.array([-1.0, 0.0, -1e-9]))[0] < -3
    assert angles_of_direction(np.array([0.0, 1.0, 0.0])) == (0.0, 0.0)
    assert angle_between_directions(np.array([1.0, 0, 0]), np.array([0, 2.0, 0])) == pytest.approx(np.pi / 2)


def test_view_axes_are_a_proper_rotation_also_when_up_is_along_the_view() -> None:
    directions = np.array([[0, 1, 0], [0, -1, 0], [1, 2, 3], [0, 0, 1]], dtype=float)
    rotmat = view_rotmat(directions, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(rotmat @ np.swapaxes(rotmat, -1, -2), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotmat), 1.0)
