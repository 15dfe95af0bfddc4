"""Check pinhole cameras and virtual video."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import annotate_pixels, frame_take, look_at_camera, sample_views
from pasdedeux.errors import InputError


def _camera(yaw: float = 0.7, pitch: float = 0.3) -> PinholeCamera:
    return look_at_camera(np.array([0.2, 1.0, -0.4]), distance_m=4.0, yaw_rad=yaw, pitch_rad=pitch, focal_px=1200.0)


def test_projection_agrees_with_opencv() -> None:
    points = np.random.default_rng(0).normal(loc=(0.2, 1.0, -0.4), size=(50, 3))
    camera = _camera()
    # OpenCV's camera axes are x right, y down, z away from the camera.
    rotmat = np.diag([1.0, -1.0, -1.0]) @ camera.camera_from_world_rotmat
    matrix = np.array([[1200.0, 0, camera.principal_point_px[0]], [0, 1200.0, camera.principal_point_px[1]], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(rotmat)[0], -rotmat @ camera.position_m, matrix, np.zeros(4))
    np.testing.assert_allclose(camera.project(points).px, expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("roll", [0.0, 0.5, np.pi / 2])
def test_the_pitch_of_a_camera_is_told_however_it_is_rolled(roll: float) -> None:
    turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    rolled = PinholeCamera(1200.0, np.zeros(2), turn @ _camera(pitch=0.3).camera_from_world_rotmat, np.zeros(3))
    assert rolled.pitch_rad == pytest.approx(0.3)


@pytest.mark.parametrize(("yaw", "x_sign"), [(0.0, 1.0), (np.pi, -1.0)])
def test_a_raised_hand_on_plus_x_is_seen_right_from_the_front_and_left_from_behind(yaw: float, x_sign: float) -> None:
    camera = look_at_camera(np.zeros(3), distance_m=3.0, yaw_rad=yaw, pitch_rad=0.0, focal_px=1000.0)
    hand, centre = camera.project(np.array([[0.5, 0.8, 0.0], [0.0, 0.0, 0.0]])).px
    np.testing.assert_allclose(centre, camera.principal_point_px)
    assert np.sign(hand[0] - centre[0]) == x_sign
    assert hand[1] < centre[1]


def test_at_yaw_zero_the_camera_stands_on_plus_z_and_yaw_turns_it_towards_plus_x() -> None:
    look = partial(look_at_camera, np.zeros(3), distance_m=2.0, focal_px=1.0)
    np.testing.assert_allclose(look(yaw_rad=0.0, pitch_rad=0.0).position_m, [0, 0, 2])
    np.testing.assert_allclose(look(yaw_rad=np.pi / 2, pitch_rad=0.0).position_m, [2, 0, 0], atol=1e-12)
    assert look(yaw_rad=1.0, pitch_rad=0.5).position_m[1] > 0


def test_points_behind_the_camera_have_no_pixels() -> None:
    camera = look_at_camera(np.zeros(3), distance_m=2.0, yaw_rad=0.0, pitch_rad=0.0, focal_px=1000.0)
    seen = camera.project(np.array([0.0, 0.0, 3.0]))
    assert np.isnan(seen.px).all()
    assert seen.depth_m == pytest.approx(-1.0)


def test_a_mirroring_camera_is_refused() -> None:
    with pytest.raises(InputError, match="not a proper rotation"):
        PinholeCamera(1000.0, np.zeros(2), np.diag([-1.0, 1.0, 1.0]), np.zeros(3))


def test_framing_gives_a_person_the_wanted_height_and_keeps_every_joint_inside() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(20, 2, 17, 3)) * [1.5, 0.4, 1.5] + [0, 1, 0]
    view = frame_take(points, points[..., 0, :], distance_m=4.0, yaw_rad=0.4, pitch_rad=0.1)
    seen = view.camera.project(points)
    assert view.camera.is_inside(seen.px).all()
    assert seen.depth_m.min() >= 1.0 - 1e-9
    level = frame_take(points, points[..., 0, :], distance_m=9.0, yaw_rad=0.4, pitch_rad=0.0)
    target = points[..., 0, :].reshape(-1, 3).mean(axis=0)
    ends = level.camera.project(target + np.array([[0, 0.85, 0], [0, -0.85, 0]])).px
    assert ends[1, 1] - ends[0, 1] == pytest.approx(600.0)


def test_views_stay_in_their_intervals_and_cover_all_yaws() -> None:
    yaws, pitches = sample_views(np.random.default_rng(3), 4000, pitch_deviation_rad=1.0)
    assert pitches.min() >= np.deg2rad(-15.0) - 1e-12
    assert pitches.max() <= np.deg2rad(60.0) + 1e-12
    counts, _ = np.histogram(yaws, bins=8, range=(-np.pi, np.pi))
    # 500 expected in each bin, standard deviation 21: six of them is a chance below 1e-7.
    assert np.abs(counts - 500).max() < 126


def test_annotation_noise_and_occlusion_have_the_stated_size() -> None:
    exact = np.zeros((500, 17, 2))
    marked = annotate_pixels(np.random.default_rng(4), exact, noise_px=3.0, occlusion=0.2)
    is_seen = marked.confidence > 0
    assert np.array_equal(is_seen, np.isfinite(marked.px).all(axis=-1))
    assert 1 - is_seen.mean() == pytest.approx(0.2, abs=0.025)
    assert np.nanstd(marked.px) == pytest.approx(3.0, rel=0.05)
    clean = annotate_pixels(np.random.default_rng(4), exact)
    assert np.array_equal(clean.px, exact)


def test_a_camera_is_located_by_the_points_that_it_sees() -> None:
    camera = replace(_camera(), image_size_px=(640, 480))
    points = np.random.default_rng(5).normal([0.2, 1.0, -0.3], 0.6, (60, 3))
    px = camera.project(points).px
    px[:7] = np.nan
    known = ("focal_px", "principal_point_px", "camera_from_world_rotmat", "image_size_px")
    locate = partial(PinholeCamera.locate, **{name: getattr(camera, name) for name in known})
    found = locate(points, px)
    np.testing.assert_allclose(found.position_m, camera.position_m, atol=1e-9)
    assert found.image_size_px == (640, 480)
    for count in (0, 1):
        with pytest.raises(InputError, match=f"two points or more that it sees apart; {count} are known"):
            locate(points[: 7 + count], px[: 7 + count])
