"""Reconstruction of a take from several cameras: clocks, people, cameras and poses."""

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
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.poses2d.calibration import choose_cameras, read_calibration
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.sequence import Reconstruction, SearchedDatabase
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.reconstruction.views.calibration import View, calibrate, meet
from pasdedeux.reconstruction.views.cameras import camera_facts, upright_m
from pasdedeux.reconstruction.views.clocks import Rising, match_cameras
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
    return reconstruct_views([camera.tracks for camera in seen], database)


def test_two_unknown_cameras_suffice(together: SeenTogether, seen: list[FilmedCamera], truth_m: np.ndarray) -> None:
    pose_m, place_m = errors_m(together.people.methods[-1].people, truth_m, seen[0])
    assert pose_m < 0.03
    assert place_m < 0.04
    # The clock is right to half a frame, people are not exchanged, and the camera is in place.
    assert abs(together.views[1].offset_s - seen[1].ahead_s) < 0.5 / 30.0
    first, second = (view.camera for view in seen)
    turned = second.camera_from_world_rotmat @ first.camera_from_world_rotmat.T
    assert np.arccos(np.clip((np.trace(together.views[1].rotmat @ turned.T) - 1.0) / 2.0, -1.0, 1.0)) < 0.06
    assert together.off_m < 0.02


def test_each_camera_is_given_in_the_frame_of_the_motions(together: SeenTogether, seen: list[FilmedCamera]) -> None:
    placed_m, cameras = upright_m(together.people), together.cameras
    assert [camera.name for camera in cameras] == ["1", "2"]
    for camera, true in zip(cameras, seen, strict=True):
        assert camera.off_px(placed_m) < 8.0
        assert camera.camera.focal_px == pytest.approx(true.camera.focal_px, rel=0.15)
        assert abs(camera.first_time_s + true.ahead_s) < 0.5 / 30.0
    assert np.rad2deg(cameras[1].angle_rad) == pytest.approx(80.0, abs=4.0)
    apart_m = np.linalg.norm(np.subtract(*(camera.camera.position_m for camera in cameras)))
    assert apart_m == pytest.approx(2.0 * 4.5 * np.sin(np.deg2rad(40.0)), rel=0.1)
    said = [camera.in_words(placed_m) for camera in cameras]
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


def test_expected_errors_of_cameras_hold(together: SeenTogether, seen: list[FilmedCamera], truth_m: np.ndarray) -> None:
    pose_m, _ = errors_m(together.people.methods[-1].people, truth_m, seen[0])
    judged = together.judged.people.values()
    assert 0.5 * pose_m < np.mean([reliability.expected_error_m for reliability in judged]) < 2.0 * pose_m
    assert {reliability.verdict.level for reliability in judged} == {Level.PASS}
    for apart in (replace(together, off_m=0.12), replace(together, bones_vary=0.12)):
        assert {verdict.level for verdict in apart.judged.verdicts.values()} == {Level.WARN}


def test_cameras_of_two_takes_are_refused(seen: list[FilmedCamera], database: SearchedDatabase) -> None:
    judo = see(duet_m("judo"), (20.0, 100.0))[1]
    with pytest.raises(InputError, match=r"cameras front and side: they do not show the same|front, side do not"):
        reconstruct_views([seen[0].tracks, judo.tracks], database, names=["front", "side"])


def test_cameras_that_see_other_joints_are_refused(truth_m: np.ndarray) -> None:
    px = truth_m[::40, ..., :2] * 300.0
    is_upper = np.zeros(px.shape[:-1])
    is_upper[..., :8] = 1.0
    lens = Lens(800.0, (480.0, 270.0))
    views = [View(lens, np.eye(3), np.zeros(3), 0.0, px, 0.0 * px, is_seen) for is_seen in (is_upper, 1.0 - is_upper)]
    with pytest.raises(InputError, match="no two cameras see the same 5 joints of a person at one time"):
        calibrate(views, np.array([1.7, 1.7]), 30.0)


def test_calibrated_cameras_give_true_sizes(
    seen: list[FilmedCamera], database: SearchedDatabase, truth_m: np.ndarray
) -> None:
    """The file has three cameras in another order, in millimetres, for images of twice the size, with distortion."""
    text = "".join(
        calibrated(view.camera, name, scale=2.0, distortions=(-0.08, 0.01, 0.0, 0.0, 0.0), unit=1000.0)
        for name, view in (("int_cam2_img", seen[1]), ("int_cam1_img", seen[0]))
    )
    spare = calibrated(replace(seen[0].camera, position_m=np.array([9.0, 2.0, 9.0])), "int_cam03_img", unit=1000.0)
    chosen, is_by_name = choose_cameras(read_calibration((text + spare).encode()), ["cam01_json", "cam02_json"])
    assert is_by_name
    cameras = [camera.for_images((960, 540)) for camera in chosen]
    tracks = [
        [replace(track, keypoints_px=camera.distorted_px(track.keypoints_px)) for track in view.tracks]
        for view, camera in zip(seen, cameras, strict=True)
    ]
    found = reconstruct_views(tracks, database, calibration=cameras)
    pose_m, place_m = errors_m(found.people.methods[-1].people, truth_m, seen[0])
    assert pose_m < 0.02
    assert place_m < 0.02
    with pytest.raises(InputError, match="or the calibration is of other cameras or in another order"):
        reconstruct_views(tracks, database, calibration=cameras[::-1])
    with pytest.raises(InputError, match="the calibration has 1 cameras, and 2 are given"):
        reconstruct_views(tracks, database, calibration=cameras[:1])
    with pytest.raises(InputError, match=r"somebody would be 0\.0\d+ m tall by the calibration; its translations"):
        _check_sizes([replace(view, position_m=view.position_m / 39.0) for view in found.views])


def test_exact_rays_give_back_cameras_and_joints(truth_m: np.ndarray) -> None:
    cameras = [view.camera for view in see(truth_m, (0.0, 70.0))]
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
    # A stated stature sets the scale, whatever is likely for the other person.
    likely_m, far_m = statures_m * [1.0, 1.12], np.linalg.norm(views[1].position_m)
    for is_stated, least, most in (([False, False], 1.04, 1.08), ([True, False], 0.99, 1.02)):
        sized = calibrate([views[0], wrong], likely_m, 30.0, is_stated=np.array(is_stated))
        assert least < np.linalg.norm(sized[1].position_m) / far_m < most


def test_people_who_move_differently_are_not_matched() -> None:
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
    """Return the page of a take with the film of the second camera, whose start is shifted by a time."""
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


def test_film_on_the_page_follows_its_clock(together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path) -> None:
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
    np.testing.assert_allclose([drawn.min(0), drawn.max(0)], [true_px.min(0), true_px.max(0)], atol=20)


def test_somebody_who_leaves_is_drawn_over_film_up_to_the_last_frame() -> None:
    """A rounding error asks for a moment just after that frame, between it and one without that person."""
    places_m = np.tile(np.arange(4.0)[:, None, None], (1, 2, 3))
    places_m[3:, 1] = np.nan
    moved_m = _between_frames(places_m, np.array([2.0 + 1e-9, 1.5, 2.5]))
    np.testing.assert_array_equal(moved_m[:, 1], [[2.0] * 3, [1.5] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(moved_m[2, 0], [2.5] * 3)


def test_the_film_on_the_page_is_the_middle_of_what_it_has_of_the_take(
    together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film of the first 20 of 60 frames does not cover the half second in the middle of the take."""
    monkeypatch.setattr("pasdedeux.evaluation.pictures._MAX_S", 0.5)
    found = write_side(tmp_path, seen[1], 20)
    (svg,) = page_with(together, found, tmp_path / "out").figures
    assert svg.count(b"base64,") == 8
    for later_s in (-10.0, 10.0):
        assert page_with(together, found, tmp_path / "out", later_s=later_s).figures == []


def test_files_have_steady_images_of_all_cameras(
    together: SeenTogether, seen: list[FilmedCamera], tmp_path: Path
) -> None:
    """The second camera pans by a pixel a frame, so each matrix shows its frame."""
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


def test_a_camera_counts_for_the_people_whom_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, out, front, side = build_store(tmp_path / "store"), tmp_path / "out", tmp_path / "front", tmp_path / "side"
    for folder, yaw_rad in ((front, 0.3), (side, 1.6)):
        folder.mkdir()
        write_walkers(folder, yaw_rad=yaw_rad)
    rows = ["# layout: coco17", "# image_size: 1920x1080", "# rate_hz: 30", "frame,person,joint,x,y"]
    names = KEYPOINT_LAYOUTS["coco18"].keypoint_names
    for frame, path in enumerate(sorted(side.iterdir())):
        shown = json.loads(path.read_text())["people"]
        people = [np.array(person["pose_keypoints_2d"]).reshape(18, 3) for person in shown]
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


def test_several_cameras_are_checked_before_any_is_read(
    seen: list[FilmedCamera], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Detecting people in a film takes minutes."""

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
    # Verdicts stand above the player, the worst first.
    shown = re.findall(r'<li class="(.*?)">.*?</span> <b>(.*?), expected error (\d+.*?)</b>', page.text)
    assert {name for _, name, _ in shown} == {"person 0", "person 1", "place of 0 and 1"}
    levels = [level for level, _, _ in shown]
    assert levels == sorted(levels, key=lambda level: -Level(level).rank)
    assert page.text.index(shown[-1][1]) < page.text.index("<canvas")
    yaws_rad = {"side": 1.6, "front": 0.3, "back": 3.0}  # in another order than that of the command
    (tmp_path / "calib.toml").write_text("".join(calibrated(camera_of(at), name) for name, at in yaws_rad.items()))
    calibration = ["--calibration", str(tmp_path / "calib.toml"), "--person", "0"]
    assert run_command_line([*command, "--camera", side, *calibration]) == 0
    said = capsys.readouterr()
    assert re.search(r"camera side: person \d was left out: matches nobody reconstructed from camera front", said.err)
    assert "calibration by name: front is front, side is side; left out: back" in said.err
    assert len(re.findall(r"lens 1400 px .*joints are [01]\.\d px", said.out)) == 2
    for words, says in (
        ([*command, "--camera", front], "see the people from one side (0 degrees apart)"),
        ([*command, "--camera", str(tmp_path / "none")], "none"),
        ([*command, "--camera", side, "--calibration", "/dev/zero"], "--calibration /dev/zero: /dev/zero is a device"),
        ([*command, "--calibration", "calib.toml"], "is of several cameras: name the others by --camera"),
        (["reconstruct", front, *reference(store), "--follow", "--camera", side], "--camera is for whole videos"),
    ):
        assert run_command_line(words) == 2
        assert says in capsys.readouterr().err
