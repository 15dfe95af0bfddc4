"""A take that several cameras saw: clocks, people and cameras are found, and poses fitted to all; calibrations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.console.app import run_command_line
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.fitting.terms import Normal
from pasdedeux.formats.calibration import CalibratedCamera, read_calibration
from pasdedeux.formats.npz import read_npz
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import rotvec_from_unitquat, unitquat_from_rotmat
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.sequence import SearchedDatabase
from pasdedeux.reconstruction.views.calibration import View, calibrate, meet
from pasdedeux.reconstruction.views.clocks import Rising, match_cameras
from pasdedeux.reconstruction.views.fit import RayTerm
from pasdedeux.reconstruction.views.together import SeenTogether, reconstruct_views
from pasdedeux.skeletons import OP14
from pasdedeux.verdict import Level
from tests.builders.cameras_of_a_take import Seen, database_of_duets, duet_m, errors_m, see
from tests.builders.walkers_on_video import build_store, reference, write_walkers


@pytest.fixture(scope="module")
def truth_m() -> np.ndarray:
    return duet_m("waltz")


@pytest.fixture(scope="module")
def database() -> SearchedDatabase:
    return database_of_duets("push_hands", "hug", "judo")


@pytest.fixture(scope="module")
def seen(truth_m: np.ndarray) -> list[Seen]:
    return see(truth_m, (20.0, 100.0))


@pytest.fixture(scope="module")
def together(seen: list[Seen], database: SearchedDatabase) -> SeenTogether:
    return reconstruct_views([one.tracks for one in seen], database)


def calibrated(camera: PinholeCamera) -> CalibratedCamera:
    """Return a camera by OpenCV's conventions."""
    rotmat = np.diag([1.0, -1.0, -1.0]) @ camera.camera_from_world_rotmat
    (cx, cy), focal = camera.principal_point_px, camera.focal_px
    return CalibratedCamera(
        "cam",
        np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]]),
        np.zeros(5),
        rotvec_from_unitquat(unitquat_from_rotmat(rotmat)),
        -rotmat @ camera.position_m,
    )


def test_two_unknown_cameras_tell_poses_and_places(
    together: SeenTogether, seen: list[Seen], truth_m: np.ndarray
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
    assert "2 cameras: joints are " in together.in_words()


def test_bones_keep_their_lengths_before_several_cameras(together: SeenTogether) -> None:
    lengths = bone_lengths(OP14, together.people.methods[0].people[0].positions_m)
    legs = [joint for leg in OP14.legs for joint in leg[1:]]
    assert np.ptp(lengths[:, legs], axis=0).max() < 1e-6


def test_what_is_expected_of_several_cameras_holds(
    together: SeenTogether, seen: list[Seen], truth_m: np.ndarray
) -> None:
    pose_m, _ = errors_m(together.people.methods[-1].people, truth_m, seen[0])
    expected = [one.expected_error_m for one in together.judged.people.values()]
    assert 0.5 * pose_m < np.mean(expected) < 2.0 * pose_m
    assert {one.verdict.level for one in together.judged.people.values()} == {Level.PASS}
    apart = replace(together, off_m=0.12)
    assert {verdict.level for verdict in apart.judged.verdicts.values()} == {Level.WARN}


def test_calibrated_cameras_give_true_sizes(seen: list[Seen], database: SearchedDatabase, truth_m: np.ndarray) -> None:
    cameras = [calibrated(one.camera) for one in seen]
    found = reconstruct_views([one.tracks for one in seen], database, calibration=cameras)
    pose_m, place_m = errors_m(found.people.methods[-1].people, truth_m, seen[0])
    assert pose_m < 0.02
    assert place_m < 0.02
    with pytest.raises(InputError, match="the calibration has 1 cameras, and 2 are given"):
        reconstruct_views([one.tracks for one in seen], database, calibration=cameras[:1])


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
    found = calibrate([views[0], wrong], body_height_m(OP14, np.median(legs, axis=0)), 30.0)
    np.testing.assert_allclose(found[1].position_m, views[1].position_m, atol=0.02)


def test_people_who_move_otherwise_are_not_the_same() -> None:
    rng = np.random.default_rng(0)
    first, second = ({0: Rising(0.0, rng.standard_normal((90, 14)), np.ones(90, dtype=bool))} for _ in range(2))
    with pytest.raises(InputError, match="do not show the same people at the same time"):
        match_cameras(first, second, 30.0)
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
    assert "2 cameras: joints are 0." in said.out
    assert "turned by 7" in said.out
    assert sorted(path.suffix for path in out.iterdir()).count(".bvh") == 2
    facts = read_npz(next(out.glob("*_0.npz")).read_bytes(), "the motion")
    assert facts["camera_position_m"].shape == (3,)
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
