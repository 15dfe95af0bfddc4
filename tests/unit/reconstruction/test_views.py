"""A take that several cameras saw: clocks, people and cameras are found, and poses fitted to all; calibrations."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np
import pytest

from flows.console.app import run_command_line
from flows.console.cameras import camera_names
from flows.exports.reconstructions import CameraData, _between_frames, write_reconstruction
from pasdedeux.errors import InputError
from pasdedeux.fitting.terms import Normal
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.poses2d.calibration import choose_cameras, read_calibration
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.sequence import Reconstruction, SearchedDatabase
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.reconstruction.views.calibration import View, calibrate, meet
from pasdedeux.reconstruction.views.clocks import Rising, match_cameras
from pasdedeux.reconstruction.views.fit import RayTerm
from pasdedeux.reconstruction.views.seen import camera_facts, upright_m
from pasdedeux.reconstruction.views.together import SeenTogether, _check_sizes, reconstruct_views
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.verdict import Level
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import FoundFilm, find_videos
from tasks.ingest.poses2d.resolution import FoundAnnotations
from tests.builders.cameras_of_a_take import SIZE_PX, FilmedCamera, calibrated, database_of_duets, duet_m, errors_m, see
from tests.builders.pages import Page
from tests.builders.rendered_film import write_film
from tests.builders.walkers_on_video import build_store, camera_of, reference, write_walkers


@pytest.fixture(scope="module")
def truth_m() -> np.ndarray:
    return duet_m("waltz")


@pytest.fixture(scope="module")
def database() -> SearchedDatabase:
    return database_of_duets("push_hands", "hug", "judo")


@pytest.fixture(scope="module")
def seen(truth_m: np.ndarray) -> list[FilmedCamera]:
    return see(truth_m, (20.0, 100.0))


@pytest.fixture(scope="module")
def together(seen: list[FilmedCamera], database: SearchedDatabase) -> SeenTogether:
    return reconstruct_views([one.tracks for one in seen], database)


def test_two_unknown_cameras_tell_poses_and_places(
    together: SeenTogether, seen: list[FilmedCamera], truth_m: np.ndarray
) -> None:
    pose_m, place_m = errors_m(together.people.methods[-1].people, truth_m, seen[0])
    assert pose_m < 0.03
    assert place_m < 0.04
    # The clock is right to half a frame, the people are who they are, and the camera is where it is.
    assert abs(together.views[1].offset_s - seen[1].ahead_s) < 0.5 / 30.0
    first, second = (one.camera for one in seen)
    turned = second.camera_from_world_rotmat @ first.camera_from_world_rotmat.T
    assert np.arccos(np.clip((np.trace(together.views[1].rotmat @ turned.T) - 1.0) / 2.0, -1.0, 1.0)) < 0.06
    assert together.off_m < 0.02


def test_each_camera_is_told_in_the_frame_of_the_motions(together: SeenTogether, seen: list[FilmedCamera]) -> None:
    placed_m, cameras = upright_m(together.people), together.cameras
    assert [one.name for one in cameras] == ["1", "2"]
    for one, true in zip(cameras, seen, strict=True):
        assert one.off_px(placed_m) < 8.0
        assert one.camera.focal_px == pytest.approx(true.camera.focal_px, rel=0.15)
        assert abs(one.first_time_s + true.ahead_s) < 0.5 / 30.0
    assert np.rad2deg(cameras[1].angle_rad) == pytest.approx(80.0, abs=4.0)
    apart_m = np.linalg.norm(np.subtract(*(one.camera.position_m for one in cameras)))
    assert apart_m == pytest.approx(2.0 * 4.5 * np.sin(np.deg2rad(40.0)), rel=0.1)
    said = [one.in_words(placed_m) for one in cameras]
    assert re.match(r"camera 1: \d\.\d m from the people, lens \d+ px \(\d+ degrees\); joints are \d\.\d px", said[0])
    assert re.search(r"its clock [+-]\d\.\d\d s, \d\d degrees from the first camera; joints", said[1])
    facts = camera_facts(cameras, placed_m)
    assert {name: len(values) for name, values in facts.items()} == dict.fromkeys(facts, 2)
    np.testing.assert_allclose(facts["cameras_position_m"][0], together.people.camera_facts["camera_position_m"])
    assert camera_facts(cameras[:1], placed_m) == {}


def test_bones_keep_their_lengths_before_several_cameras(together: SeenTogether) -> None:
    lengths = bone_lengths(OP14, together.people.methods[0].people[0].positions_m)
    legs = [joint for leg in OP14.legs for joint in leg[1:]]
    assert np.ptp(lengths[:, legs], axis=0).max() < 1e-6


def test_what_is_expected_of_several_cameras_holds(
    together: SeenTogether, seen: list[FilmedCamera], truth_m: np.ndarray
) -> None:
    pose_m, _ = errors_m(together.people.methods[-1].people, truth_m, seen[0])
    expected = [one.expected_error_m for one in together.judged.people.values()]
    assert 0.5 * pose_m < np.mean(expected) < 2.0 * pose_m
    assert {one.verdict.level for one in together.judged.people.values()} == {Level.PASS}
    for apart in (replace(together, off_m=0.12), replace(together, bones_vary=0.12)):
        assert {verdict.level for verdict in apart.judged.verdicts.values()} == {Level.WARN}


def test_cameras_of_two_takes_are_refused(seen: list[FilmedCamera], database: SearchedDatabase) -> None:
    other = see(duet_m("judo"), (20.0, 100.0))[1]
    with pytest.raises(
        InputError, match=r"cameras front and side: they do not show the same people|front, side do not"
    ):
        reconstruct_views([seen[0].tracks, other.tracks], database, names=["front", "side"])


def test_cameras_that_see_other_joints_are_refused(truth_m: np.ndarray) -> None:
    px = truth_m[::40, ..., :2] * 300.0
    is_upper = np.zeros(px.shape[:-1])
    is_upper[..., :8] = 1.0
    lens = Lens(800.0, (480.0, 270.0))
    views = [View(lens, np.eye(3), np.zeros(3), 0.0, px, 0.0 * px, one) for one in (is_upper, 1.0 - is_upper)]
    with pytest.raises(InputError, match="no two cameras see the same 5 joints of a person at one time"):
        calibrate(views, np.array([1.7, 1.7]), 30.0)


def test_calibrated_cameras_give_true_sizes(
    seen: list[FilmedCamera], database: SearchedDatabase, truth_m: np.ndarray
) -> None:
    """The file has three cameras in another order, millimetres, images of twice the size and lenses that distort."""
    text = "".join(
        calibrated(one.camera, name, scale=2.0, distortions=(-0.08, 0.01, 0.0, 0.0, 0.0), unit=1000.0)
        for name, one in (("int_cam2_img", seen[1]), ("int_cam1_img", seen[0]))
    )
    spare = calibrated(replace(seen[0].camera, position_m=np.array([9.0, 2.0, 9.0])), "int_cam03_img", unit=1000.0)
    chosen, is_by_name = choose_cameras(read_calibration((text + spare).encode()), ["cam01_json", "cam02_json"])
    assert is_by_name
    cameras = [camera.for_images((960, 540)) for camera in chosen]
    tracks = [
        [replace(track, keypoints_px=camera.distorted_px(track.keypoints_px)) for track in one.tracks]
        for one, camera in zip(seen, cameras, strict=True)
    ]
    found = reconstruct_views(tracks, database, calibration=cameras)
    pose_m, place_m = errors_m(found.people.methods[-1].people, truth_m, seen[0])
    assert pose_m < 0.02
    assert place_m < 0.02
    with pytest.raises(InputError, match="or the calibration is of other cameras or in another order"):
        reconstruct_views(tracks, database, calibration=cameras[::-1])
    with pytest.raises(InputError, match="the calibration has 1 cameras, and 2 are given"):
        reconstruct_views(tracks, database, calibration=cameras[:1])
    with pytest.raises(
        InputError, match=r"somebody would be 0\.0\d+ m tall by the calibration; its translations must be"
    ):
        _check_sizes([replace(view, position_m=view.position_m / 39.0) for view in found.views])


def test_exact_rays_give_back_cameras_and_joints(truth_m: np.ndarray) -> None:
    cameras = [one.camera for one in see(truth_m, (0.0, 70.0))]
    world_m = truth_m[::16]
    views = []
    for camera in cameras:
        lens = see(truth_m, (0.0,))[0].tracks[0].lens
        rotmat = camera.camera_from_world_rotmat @ cameras[0].camera_from_world_rotmat.T
        px = camera.project(world_m).px
        place_m = cameras[0].camera_from_world(camera.position_m)
        lens = replace(lens, focal_px=camera.focal_px, is_known=True)
        views.append(View(lens, rotmat, place_m, 0.0, px, np.zeros(px.shape), np.ones(px.shape[:-1])))
    true_m = cameras[0].camera_from_world(world_m)
    np.testing.assert_allclose(meet(views), true_m, atol=1e-4)
    wrong = replace(views[1], position_m=views[1].position_m + np.array([0.1, -0.1, 0.1]))
    legs = bone_lengths(OP14, true_m)
    statures_m = body_height_m(OP14, np.median(legs, axis=0))
    found = calibrate([views[0], wrong], statures_m, 30.0)
    np.testing.assert_allclose(found[1].position_m, views[1].position_m, atol=0.02)
    # One stature that is stated sets the scale, whatever is likely for the other.
    likely_m, far_m = statures_m * [1.0, 1.12], np.linalg.norm(views[1].position_m)
    for is_stated, least, most in (([False, False], 1.04, 1.08), ([True, False], 0.99, 1.02)):
        sized = calibrate([views[0], wrong], likely_m, 30.0, is_stated=np.array(is_stated))
        assert least < np.linalg.norm(sized[1].position_m) / far_m < most


def test_people_who_move_otherwise_are_not_the_same() -> None:
    rng = np.random.default_rng(0)
    first, second = ({0: Rising(0.0, rng.standard_normal((90, 14)), np.ones(90, dtype=bool))} for _ in range(2))
    with pytest.raises(InputError, match="do not show the same people at the same time"):
        match_cameras(first, second, 30.0)
    with pytest.raises(InputError, match="they show nobody for 1 s together, or for half of the shorter film"):
        match_cameras(first, {0: replace(second[0], is_known=np.arange(90) % 9 == 0)}, 30.0)
    late = {4: replace(first[0], first_s=7.0, speed_m_s=first[0].speed_m_s[15:], is_known=np.ones(75, dtype=bool))}
    same = match_cameras(first, late, 30.0)
    assert same.person_ids == {4: 0}
    assert same.offset_s == pytest.approx(6.5, abs=0.01)


def test_the_gradient_of_rays_agrees_with_finite_differences() -> None:
    rng = np.random.default_rng(1)
    rays = rng.standard_normal((3, 4, 3))
    term = RayTerm(
        rng.standard_normal(3), rays / np.linalg.norm(rays, axis=-1, keepdims=True), rng.uniform(0, 2, (3, 4))
    )
    positions, direction = rng.standard_normal((2, 3, 4, 3))
    normal = Normal.zeros(3, 4)
    term.add_gradient(positions, normal)
    term.add_curvature(positions, normal)
    step = 1e-6 * direction
    slope = (term.energy(positions + step) - term.energy(positions - step)) / 2e-6
    assert 2.0 * (normal.gradient * direction).sum() == pytest.approx(slope, rel=1e-6)
    # It is quadratic: half the curvature along a direction is the energy of the direction alone.
    bent = sum((weights * (direction * unit).sum(axis=-1) ** 2).sum() for _, _, weights, unit in normal.stencils)
    away = term.energy(positions + direction) - term.energy(positions) - 2.0 * (normal.gradient * direction).sum()
    assert bent == pytest.approx(away, rel=1e-9)


_CALIBRATION = """
[one]
name = "front"
size = [ 960.0, 540.0,]
matrix = [ [ 800.0, 0.0, 480.0,], [ 0.0, 800.0, 270.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.1, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 0.1, 0.0,]
translation = [ 0.0, 1.0, SCALE,]
[metadata]
adjusted = false
"""


_POSE2SIM = """
[int_cam01_img]
name = "int_cam01_img"
size = [ 1088.0, 1920.0]
matrix = [ [ 1671.5, 0.0, 564.6], [ 0.0, 1671.4, 933.0], [ 0.0, 0.0, 1.0]]
distortions = [ -0.053, 0.151, -0.00012, 0.00065]
rotation = [ 1.679, 1.032, -0.391]
translation = [ 0.261, 0.964, 2.933]
fisheye = false

[int_cam02_img]
name = "int_cam02_img"
size = [ 1088.0, 1920.0]
matrix = [ [ 1675.7, 0.0, 555.8], [ 0.0, 1675.4, 937.7], [ 0.0, 0.0, 1.0]]
distortions = [ -0.052, 0.149, 1.7e-05, -0.00065]
rotation = [ 1.358, 1.58, -1.182]
translation = [ -0.165, 0.808, 3.204]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""
_ANIPOSE = """
[cam_0]
name = "A"
size = [ 1440, 1080,]
matrix = [ [ 1852.4, 0.0, 719.5,], [ 0.0, 1852.4, 539.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.036, 0.0, 0.0, 0.0, 0.0,]
rotation = [ -0.0017, -0.0018, -0.0046,]
translation = [ 2.55, -2.77, -18.2,]

[cam_1]
name = "B"
size = [ 1440, 1080,]
matrix = [ [ 1935.9, 0.0, 719.5,], [ 0.0, 1935.9, 539.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.313, 0.0, 0.0, 0.0, 0.0,]
rotation = [ -0.226, -2.982, 0.387,]
translation = [ 117.4, 262.5, 1478.8,]

[metadata]
adjusted = true
error = 1.668
"""
_FREEMOCAP = """
[cam_0]
name = "Camera_000_synchronized"
size = [1280, 720]
matrix = [[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 0.0]
world_orientation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
world_position = [0.0, 0.0, 0.0]

[cam_1]
name = "Camera_001_synchronized"
size = [1280, 720]
matrix = [[910.0, 0.0, 640.0], [0.0, 910.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 1.2, 0.0]
translation = [-2100.0, 40.0, 1500.0]
world_orientation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
world_position = [0.0, 0.0, 0.0]

[metadata]
adjusted = false
charuco_square_size = 51.0
date_time_calibrated = "2026-02-06T15:02:56"
path_to_this_calibration = "C:\\\\Users\\\\me\\\\calibration.toml"

[metadata.charuco_board_object]
number_of_squares_width = 7
"""


@pytest.mark.parametrize(
    ("text", "files", "focal_px", "far_m"),
    [
        (_POSE2SIM, ("cam02_json", "cam01_json"), (1675.7, 1671.5), (3.308, 3.098)),
        (_POSE2SIM, ("int_cam1_img", "int_cam2_img"), (1671.5, 1675.7), (3.098, 3.308)),
        (_POSE2SIM, ("front", "side"), (1671.5, 1675.7), (3.098, 3.308)),
        (_ANIPOSE, ("take4-camB", "take4-camA"), (1935.9, 1852.4), (1.506, 0.019)),
        (_ANIPOSE, ("cam_1.take", "cam_0.take"), (1935.9, 1852.4), (1.506, 0.019)),
        (_FREEMOCAP, ("Camera_001_synchronized", "Camera_000_synchronized"), (910.0, 900.0), (2.581, 0.0)),
        (_FREEMOCAP, ("camera-1", "camera-0"), (910.0, 900.0), (2.581, 0.0)),
    ],
)
def test_calibrations_of_other_programs_are_read(
    text: str, files: tuple[str, ...], focal_px: tuple[float, ...], far_m: tuple[float, ...]
) -> None:
    chosen, is_by_name = choose_cameras(read_calibration(text.encode()), files)
    assert is_by_name == ("front" not in files)
    assert [camera.matrix[0, 0] for camera in chosen] == list(focal_px)
    np.testing.assert_allclose([np.linalg.norm(camera.position_m) for camera in chosen], far_m, atol=0.001)


@pytest.mark.parametrize(
    ("text", "files", "says"),
    [
        (
            _POSE2SIM,
            ("a", "b", "c"),
            r"the calibration has 2 cameras \(int_cam01_img, int_cam02_img\), 3 are given \(a, b",
        ),
        (_POSE2SIM, ("a",), "the calibration has 2 cameras"),
        (_POSE2SIM, ("cam1", "side"), r"fit only some files by their names \(cam1: int_cam01_img; side: none\)"),
        (_POSE2SIM, ("cam1", "cam3"), "fit only some files by their names"),
        (_ANIPOSE, ("cam", "b"), r"\(cam: none; b: B\)"),
        (
            _FREEMOCAP.replace("[-2100.0, 40.0, 1500.0]", "[0.0, 0.0, 0.0]"),
            ("a", "b"),
            "cameras Camera_000_synchronized and Camera_001_synchronized of the calibration are at one place",
        ),
    ],
)
def test_calibrations_that_do_not_fit_the_files_are_named(text: str, files: tuple[str, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        choose_cameras(read_calibration(text.encode()), files)


@pytest.mark.parametrize(
    ("cameras", "files", "chosen"),
    [
        (("GoPro2", "GoPro1"), ("gopro1", "gopro2"), ("GoPro1", "GoPro2")),
        (("1", "2"), ("2024-05-01_cam2", "2024-05-01_cam1"), ("2", "1")),
        (("1", "2"), ("take1_left", "take1_right"), None),
        (("rig2_cam1", "rig2_cam2"), ("cam2", "cam1"), ("rig2_cam2", "rig2_cam1")),
        (("left", "right", "top"), ("take7 top", "take7 left"), ("top", "left")),
        (("a", "b"), ("cam1_x", "cam1_y"), None),
    ],
)
def test_words_that_all_names_share_do_not_tell_cameras(
    cameras: tuple[str, ...], files: tuple[str, ...], chosen: tuple[str, ...] | None
) -> None:
    tables = "".join(
        f"[{name!r}]\nmatrix = [[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]]\n"
        f"rotation = [0.0, 0.0, 0.0]\ntranslation = [{at}.0, 0.0, 0.0]\n"
        for at, name in enumerate(cameras)
    )
    found, is_by_name = choose_cameras(read_calibration(tables.encode()), files)
    assert (tuple(camera.name for camera in found), is_by_name) == (chosen or cameras, chosen is not None)


@pytest.mark.parametrize("size", ["[0, 0]", "[-1920, -1080]", "[1920]"])
def test_images_of_no_size_are_refused(size: str) -> None:
    with pytest.raises(InputError, match="size must"):
        read_calibration(re.sub(r"size = .*", f"size = {size}", _FREEMOCAP).encode())


def test_a_lens_of_two_focal_lengths_is_made_one_of_one_and_back() -> None:
    camera = replace(
        read_calibration(_FREEMOCAP.encode())[1], matrix=np.array([[1200.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    )
    for lens in (camera, replace(camera, distortions=np.zeros(0))):
        ray = np.array([[0.3, 0.2, 1.0]])
        seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), lens.matrix, lens.distortions)[0][:, 0]
        plain = lens.undistorted_px(seen)
        np.testing.assert_allclose((plain - [640.0, 360.0]) / lens.focal_px, ray[:, :2], atol=1e-4)
        np.testing.assert_allclose(lens.distorted_px(plain), seen, atol=0.1)


def test_people_who_stand_still_have_no_clocks() -> None:
    still = {0: Rising(0.0, np.zeros((90, 14)), np.ones(90, dtype=bool))}
    with pytest.raises(InputError, match="nobody moves, so that their clocks cannot be found"):
        match_cameras(still, still, 30.0)


def test_cameras_are_named_by_as_many_folders_as_tell_them_apart(tmp_path: Path) -> None:
    (tmp_path / "cam.1").mkdir()
    (tmp_path / "cam.2").mkdir()
    assert camera_names([tmp_path / "cam.1", tmp_path / "cam.2"]) == ["cam.1", "cam.2"]
    assert camera_names([tmp_path / "2" / "x" / "pose.json", tmp_path / "1" / "x" / "pose.json"]) == [
        "2/x/pose",
        "1/x/pose",
    ]
    assert camera_names([tmp_path / "pose.json"] * 2) == ["1: pose", "2: pose"]


def test_calibrations_are_of_images_of_any_size_but_one_shape() -> None:
    camera = read_calibration(_FREEMOCAP.encode())[1]
    half = camera.for_images((640.0, 360.0))
    px = camera.distorted_px(np.array([[100.0, 50.0], [640.0, 360.0], [np.nan, np.nan]]))
    np.testing.assert_allclose(
        half.undistorted_px((px + 0.5) / 2.0 - 0.5), [[49.75, 24.75], [319.75, 179.75], px[2]], atol=0.05
    )
    assert camera.for_images(None) is camera
    with pytest.raises(InputError, match="is of images of 1280 x 720, and those that are given are 720 x 1280"):
        camera.for_images((720.0, 1280.0))


def test_calibrations_are_read_in_metres_and_millimetres() -> None:
    (camera,) = read_calibration(_CALIBRATION.replace("SCALE", "4.5").encode())
    np.testing.assert_allclose(camera.translation_m, [0.0, 1.0, 4.5])
    assert camera.name == "front"
    (small,) = read_calibration(_CALIBRATION.replace("SCALE", "4500").encode())
    np.testing.assert_allclose(small.translation_m, [0.0, 0.001, 4.5])
    px = np.array([[480.0, 270.0], [np.nan, np.nan], [900.0, 270.0]])
    straight = camera.undistorted_px(px)
    np.testing.assert_allclose(straight[:2], px[:2], atol=1e-6)
    assert straight[2, 0] < 895.0


def _bad(line: str = "", distortions: str = "[ 0.1, 0.0, 0.0, 0.0,]") -> str:
    text = _CALIBRATION.replace("SCALE", "1.0").replace("[ 0.1, 0.0, 0.0, 0.0,]", distortions)
    return text.replace("[metadata]", f"{line}\n[metadata]")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[one", "the calibration is no TOML"),
        ("[metadata]\nadjusted = false", "the calibration has no camera"),
        (_CALIBRATION.replace("SCALE", "'far'"), "camera one of the calibration: translation must hold numbers"),
        (_CALIBRATION.replace("SCALE", "1.0, 2.0"), r"translation must hold numbers of shape \(3,\)"),
        (_bad().replace("size = [ 960.0, 540.0,]", "size = 960"), r"size must hold numbers of shape \(2,\)"),
        (_bad("fisheye = true"), "has a fisheye lens"),
        (_bad(distortions="[0.1, 0.0, 0.0]"), "distortions must be a list of 0, 4, 5, 8, 12, 14 numbers"),
        (_bad(distortions="0.1"), "distortions must be a list"),
        (_bad(distortions="[0.1, 0.0, 0.0, nan]"), r"distortions must hold numbers of shape \(4,\)"),
        (_CALIBRATION.replace("SCALE", "1.0").replace("[ [ 800.0", "[ [ -800.0"), "focal lengths of matrix must be"),
    ],
)
def test_bad_calibrations_are_named(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_calibration(text.encode())


def write_side(folder: Path, seen: FilmedCamera, num_frames: int) -> FoundFilm:
    """Write the first frames of a camera as grey film with detections."""
    film = write_film(folder / "side.avi", [np.full((540, 960, 3), 90, dtype=np.uint8)] * num_frames)
    lines = [
        f"{frame},{track.person_id},{name},{x},{y}"
        for track in seen.tracks
        for frame, points in enumerate(track.keypoints_px[:num_frames])
        for name, (x, y) in zip(OP14.joint_names, points, strict=True)
    ]
    head = ("# layout: op14", "# image_size: 960x540", "# rate_hz: 30", "frame,person,joint,x,y")
    (folder / "side.csv").write_text("\n".join([*head, *lines]))
    (found,) = find_videos(FilmOptions(id="side", path=film, detections=folder / "side.csv"))
    return found


def page_with(together: SeenTogether, found: FoundFilm, out: Path, *, later_s: float = 0.0) -> Page:
    """Return the page of a take with the film of the second camera, as if that had begun so much later."""
    first, second = together.cameras
    motion = CameraMotion(0, np.eye(3)[None], SIZE_PX)
    written = write_reconstruction(
        Reconstruction(together.people, together.judged),
        found.resolve().sequences[0],
        out,
        units="cm",
        footage=[CameraData(), CameraData(motion, film=found)],
        cameras=[first, replace(second, first_time_s=second.first_time_s + later_s)],
    )
    return Page(written.page.read_text())


def test_the_page_shows_the_film_of_a_camera_with_another_clock(
    together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path
) -> None:
    """The film has the first 24 frames of the second camera."""
    page = page_with(together, write_side(tmp_path, seen[1], 24), tmp_path / "out")
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert "camera 2: the reconstruction over the film; faces are blurred." in page.text
    assert "Camera 2: the camera moves: " in page.text
    views = [panel.get("view") for panel in page.scenes[0]["panels"]]
    assert [view and view[0] for view in views] == ["1", "2", None]
    assert np.rad2deg(abs(views[0][1] - views[1][1])) == pytest.approx(80.0, abs=4.0)
    assert np.rad2deg(views[0][2]) == pytest.approx(np.rad2deg(0.12), abs=4.0)
    # People are drawn where the camera sees them, from the first frame on that both clocks have.
    (svg,) = page.figures
    jpeg = base64.b64decode(re.findall(rb"base64,([^\"]+)", svg)[0])
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(np.float64)
    drawn = np.argwhere(np.abs(image - 90.0).max(axis=-1) > 40.0)[:, ::-1]
    first = max(0, int(np.ceil(seen[1].ahead_s * 30.0)))
    true_px = np.concatenate([track.keypoints_px[first] for track in seen[1].tracks]) / 2.0
    np.testing.assert_allclose(
        [drawn.min(axis=0), drawn.max(axis=0)], [true_px.min(axis=0), true_px.max(axis=0)], atol=20
    )


def test_somebody_who_leaves_is_drawn_over_film_up_to_the_last_frame() -> None:
    """A clock off by rounding asks for a moment just after that frame, between it and one without that person."""
    places_m = np.tile(np.arange(4.0)[:, None, None], (1, 2, 3))
    places_m[3:, 1] = np.nan
    moved_m = _between_frames(places_m, np.array([2.0 + 1e-9, 1.5, 2.5]))
    np.testing.assert_array_equal(moved_m[:, 1], [[2.0] * 3, [1.5] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(moved_m[2, 0], [2.5] * 3)


def test_the_film_on_the_page_is_the_middle_of_what_it_has_of_the_take(
    together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film of 20 of 60 frames has none of the half second in the middle of all 60."""
    monkeypatch.setattr("pasdedeux.evaluation.pictures._MAX_S", 0.5)
    found = write_side(tmp_path, seen[1], 20)
    (svg,) = page_with(together, found, tmp_path / "out").figures
    assert svg.count(b"base64,") == 8
    for later_s in (-10.0, 10.0):
        assert page_with(together, found, tmp_path / "out", later_s=later_s).figures == []


def test_files_have_the_steady_images_of_all_cameras_by_their_own_clocks(
    together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path
) -> None:
    """The second camera pans by a pixel a frame: which frame it was shows in each matrix."""
    first, second = together.cameras
    pan = np.tile(np.eye(3), (60, 1, 1))
    pan[:, 0, 2] = np.arange(60.0)
    write_reconstruction(
        Reconstruction(together.people, together.judged),
        write_side(tmp_path, seen[1], 24).resolve().sequences[0],
        tmp_path / "out",
        units="cm",
        footage=[CameraData(), CameraData(CameraMotion(0, pan, SIZE_PX))],
        cameras=[first, second],
    )
    motion = read_npz(next((tmp_path / "out").glob("*_0.npz")).read_bytes(), "the motion")
    steady = motion["cameras_steady_from_image"]
    assert "steady_from_image" not in motion
    np.testing.assert_array_equal(steady[0], np.broadcast_to(np.eye(3), steady[0].shape))
    late = int(np.rint(second.offset_s * 30.0))
    assert abs(late) > 5
    expected = np.clip(np.arange(len(steady[1])) + late, 0, 59)
    np.testing.assert_array_equal(steady[1, :, 0, 2], expected)


def test_a_camera_with_fewer_people_and_other_joints_counts_for_those_whom_it_shows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, out, front, side = build_store(tmp_path / "store"), tmp_path / "out", tmp_path / "front", tmp_path / "side"
    for folder, yaw_rad in ((front, 0.3), (side, 1.6)):
        folder.mkdir()
        write_walkers(folder, yaw_rad=yaw_rad)
    rows = ["# layout: coco17", "# image_size: 1920x1080", "# rate_hz: 30", "frame,person,joint,x,y"]
    names = KEYPOINT_LAYOUTS["coco18"].keypoint_names
    for frame, path in enumerate(sorted(side.iterdir())):
        people = [np.array(one["pose_keypoints_2d"]).reshape(18, 3) for one in json.loads(path.read_text())["people"]]
        leftmost = min(people, key=lambda points: points[8, 0])
        rows += [
            f"{frame},7,{name},{x},{y}"
            for name, (x, y, seen) in zip(names, leftmost, strict=True)
            if seen and name != "neck"
        ]
    (tmp_path / "side.csv").write_text("\n".join(rows))
    command = ["reconstruct", str(front), *reference(store), "--set", "image_size_px=[1920, 1080]", "--out", str(out)]
    assert run_command_line([*command, "--camera", str(tmp_path / "side.csv")]) == 0
    said = capsys.readouterr()
    assert len(list(out.glob("*.bvh"))) == 1
    assert "was skipped: no other camera shows this person" in said.err
    assert run_command_line([*command[:1], str(tmp_path / "side.csv"), *command[2:], "--camera", str(front)]) == 0
    assert re.search(
        r"camera front: person \d was left out: matches nobody reconstructed from camera side", capsys.readouterr().err
    )


def test_several_cameras_are_checked_before_any_is_read(
    seen: list[FilmedCamera], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film that a detector has to see takes minutes."""

    def resolve(source: FoundAnnotations) -> NoReturn:
        raise AssertionError(f"{source.parameters.id} was read")

    found = write_side(tmp_path, seen[1], 20)
    film, calibration, poses = str(tmp_path / "side.avi"), tmp_path / "calib.toml", str(tmp_path / "side.csv")
    take = ["reconstruct", film, "--detections", poses, "--camera", poses]
    calibration.write_text(calibrated(seen[0].camera) + "[one")
    monkeypatch.setattr(type(found), "resolve", resolve)
    assert run_command_line([*take[:-1], str(tmp_path / "none"), "--calibration", str(calibration)]) == 2
    assert f"--calibration {calibration}: the calibration is no TOML" in capsys.readouterr().err
    far = replace(seen[1].camera, image_size_px=(540, 960))
    calibration.write_text(calibrated(far, "one") + calibrated(seen[0].camera, "two"))
    assert run_command_line([*take, "--calibration", str(calibration)]) == 2
    said = capsys.readouterr().err
    assert f"--calibration {calibration}: video " in said
    assert "those that are given are 960 x 540; name the camera's video as it was recorded" in said
    cut = [np.full((540, 960, 3), grey, dtype=np.uint8) for grey in (20, 230) for _ in range(10)]
    write_film(tmp_path / "side.avi", cut)
    assert run_command_line(take) == 2
    assert (
        "one video of the take is needed, found side.shot00, side.shot01; name one file of one camera, and of a film "
        "with cuts cut the take out, or set has_cuts = false" in capsys.readouterr().err
    )


_PLACES = {"side": 1.6, "front": 0.3, "back": 3.0}
"""Yaws of cameras, radians, in an order that is not that of the command."""


def test_files_of_two_cameras_become_one_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, out = build_store(tmp_path / "store"), tmp_path / "out"
    folders = [tmp_path / name for name in ("front", "side")]
    for folder, yaw_rad in zip(folders, (0.3, 1.6), strict=True):
        folder.mkdir()
        write_walkers(folder, yaw_rad=yaw_rad)
    front, side = map(str, folders)
    command = ["reconstruct", front, *reference(store), "--set", "image_size_px=[1920, 1080]", "--out", str(out)]
    assert run_command_line([*command, "--camera", side]) == 0
    said = capsys.readouterr()
    assert re.search(r"camera front: .*; joints are \d\.\d px \(median\)", said.out)
    assert re.search(r"camera side: .* 7\d degrees from the first camera; joints are \d\.\d px", said.out)
    assert sorted(path.suffix for path in out.iterdir()).count(".bvh") == 2
    facts = read_npz(next(out.glob("*_0.npz")).read_bytes(), "the motion")
    assert facts["camera_position_m"].shape == (3,)
    assert facts["cameras_name"].tolist() == ["front", "side"]
    assert facts["cameras_off_px"].max() < 20.0
    glb = (out / "front.glb").read_bytes()
    scene = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    placed = {node["name"]: node["translation"] for node in scene["nodes"] if "camera" in node}
    assert [camera["name"] for camera in scene["cameras"]] == ["camera front", "camera side"] == list(placed)
    np.testing.assert_allclose(list(placed.values()), facts["cameras_position_m"])
    page = Page((out / "front.html").read_text())
    assert (page.problems, page.outside) == ([], [])
    assert [panel["is_flat"] for panel in page.scenes[0]["panels"]] == [True, True, False]
    assert "Camera side: " in page.text
    # What is judged stands above what moves, the worst first.
    shown = re.findall(r'<li class="(.*?)">.*?</span> <b>(.*?), expected error (\d+.*?)</b>', page.text)
    assert {name for _, name, _ in shown} == {"person 0", "person 1", "place of 0 and 1"}
    assert [level for level, _, _ in shown] == sorted(
        (level for level, _, _ in shown), key=lambda one: -Level(one).rank
    )
    assert page.text.index(shown[-1][1]) < page.text.index("<canvas")
    assert run_command_line([*command, "--camera", side, "--person", "0"]) == 0
    said = capsys.readouterr()
    assert re.search(r"camera side: person \d was left out: matches nobody reconstructed from camera front", said.err)
    (tmp_path / "calib.toml").write_text("".join(calibrated(camera_of(at), name) for name, at in _PLACES.items()))
    assert run_command_line([*command, "--camera", side, "--calibration", str(tmp_path / "calib.toml")]) == 0
    said = capsys.readouterr()
    assert "calibration by name: front is front, side is side; left out: back" in said.err
    assert len(re.findall(r"lens 1400 px .*joints are [01]\.\d px", said.out)) == 2
    assert run_command_line([*command, "--camera", front]) == 2
    assert "see the people from one side (0 degrees apart)" in capsys.readouterr().err
    assert run_command_line([*command, "--camera", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
    assert run_command_line([*command, "--camera", side, "--calibration", "/dev/zero"]) == 2
    assert "--calibration /dev/zero: /dev/zero is a device" in capsys.readouterr().err
    (tmp_path / "calib.toml").write_text("[one")
    assert run_command_line([*command, "--camera", side, "--calibration", str(tmp_path / "calib.toml")]) == 2
    assert f"--calibration {tmp_path / 'calib.toml'}: the calibration is no TOML" in capsys.readouterr().err
    assert run_command_line([*command, "--calibration", "calib.toml"]) == 2
    assert "--calibration is of several cameras: name the others by --camera" in capsys.readouterr().err
    assert run_command_line(["reconstruct", front, *reference(store), "--follow", "--camera", side]) == 2
    assert "--camera is for whole videos" in capsys.readouterr().err
