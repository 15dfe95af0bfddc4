"""Calibrations of several cameras: files of other programs are read and their cameras are matched to the videos."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.calibration import choose_cameras, read_calibration


def lens(focal_px: float, x_px: float = 640.0, y_px: float = 360.0) -> list[list[float]]:
    return [[focal_px, 0.0, x_px], [0.0, focal_px, y_px], [0.0, 0.0, 1.0]]


def camera(table: str, **keys: object) -> str:
    """Return the table of a camera with these keys in place of the plain ones."""
    plain = {"size": [1280, 720], "matrix": lens(910.0), "distortions": [-0.1, 0.0, 0.0, 0.0, 0.0]}
    plain |= {"rotation": [0.0, 0.1, 0.0], "translation": [0.0, 1.0, 4.5]}
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in (plain | keys).items()]
    return "".join([f"[{table}]\n", *lines]).replace("NaN", "nan")


_METADATA = "[metadata]\nadjusted = true\nerror = 1.668\n[metadata.charuco_board_object]\nnumber_of_squares_width = 7\n"
_CAMERAS = {
    "int_cam01_img": {"matrix": lens(1671.5), "rotation": [1.679, 1.032, -0.391], "translation": [0.261, 0.964, 2.933]},
    "int_cam02_img": {"matrix": lens(1675.7), "rotation": [1.358, 1.58, -1.182], "translation": [-0.165, 0.808, 3.204]},
}
_POSE2SIM = "".join(
    camera(name, name=name, size=[1088.0, 1920.0], fisheye=False, **keys) for name, keys in _CAMERAS.items()
)
_ANIPOSE = camera(
    "cam_0", name="A", matrix=lens(1852.4), rotation=[-0.0017, -0.0018, -0.0046], translation=[2.55, -2.77, -18.2]
) + camera("cam_1", name="B", matrix=lens(1935.9), rotation=[-0.226, -2.982, 0.387], translation=[117.4, 262.5, 1478.8])
_FREEMOCAP = camera("cam_0", name="Camera_000_synchronized", matrix=lens(900.0), translation=[0.0, 0.0, 0.0]) + camera(
    "cam_1",
    name="Camera_001_synchronized",
    rotation=[0.1, 1.2, 0.0],
    translation=[-2100.0, 40.0, 1500.0],
    world_position=[0.0, 0.0, 0.0],
)


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
    chosen, is_by_name = choose_cameras(read_calibration((text + _METADATA).encode()), files)
    assert is_by_name == ("front" not in files)
    assert [camera.matrix[0, 0] for camera in chosen] == list(focal_px)
    np.testing.assert_allclose([np.linalg.norm(camera.position_m) for camera in chosen], far_m, atol=0.001)


@pytest.mark.parametrize(
    ("text", "files", "says"),
    [
        (_POSE2SIM, "abc", r"the calibration has 2 cameras \(int_cam01_img, int_cam02_img\), 3 are given \(a, b"),
        (_POSE2SIM, "a", "the calibration has 2 cameras"),
        (_POSE2SIM, ("cam1", "side"), r"fit only some files by their names \(cam1: int_cam01_img; side: none\)"),
        (_POSE2SIM, ("cam1", "cam3"), "fit only some files by their names"),
        (_ANIPOSE, ("cam", "b"), r"\(cam: none; b: B\)"),
        (
            "".join(camera(name, translation=[0.0, 0.0, 0.0]) for name in ("left", "right")),
            "ab",
            "cameras left and right of the calibration are at one place",
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
def test_words_that_all_names_share_do_not_identify_cameras(
    cameras: tuple[str, ...], files: tuple[str, ...], chosen: tuple[str, ...] | None
) -> None:
    text = "".join(camera(name, translation=[at, 0.0, 0.0]) for at, name in enumerate(cameras))
    found, is_by_name = choose_cameras(read_calibration(text.encode()), files)
    assert (tuple(camera.name for camera in found), is_by_name) == (chosen or cameras, chosen is not None)


def test_a_lens_with_two_focal_lengths_is_converted_to_one_focal_length_and_back() -> None:
    (plain,) = read_calibration(camera("front").encode())
    distorted = replace(plain, matrix=np.array([[1200.0, 0, 640], [0, 900, 360], [0, 0, 1]]))
    for calibrated in (distorted, replace(distorted, distortions=np.zeros(0))):
        ray = np.array([[0.3, 0.2, 1.0]])
        seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), calibrated.matrix, calibrated.distortions)[0][:, 0]
        straight = calibrated.undistorted_px(seen)
        np.testing.assert_allclose((straight - [640.0, 360.0]) / calibrated.focal_px, ray[:, :2], atol=1e-4)
        np.testing.assert_allclose(calibrated.distorted_px(straight), seen, atol=0.1)


def test_calibrations_are_of_images_of_any_size_but_one_shape() -> None:
    (front,) = read_calibration(camera("front").encode())
    half = front.for_images((640.0, 360.0))
    px = front.distorted_px(np.array([[100.0, 50.0], [640.0, 360.0], [np.nan, np.nan]]))
    np.testing.assert_allclose(
        half.undistorted_px((px + 0.5) / 2.0 - 0.5), [[49.75, 24.75], [319.75, 179.75], px[2]], atol=0.05
    )
    assert front.for_images(None) is front
    with pytest.raises(InputError, match="is of images of 1280 x 720, and those that are given are 720 x 1280"):
        front.for_images((720.0, 1280.0))


@pytest.mark.parametrize(("far", "translation_m"), [(4.5, [0.0, 1.0, 4.5]), (4500, [0.0, 0.001, 4.5])])
def test_calibrations_are_read_in_metres_and_millimetres(far: float, translation_m: list[float]) -> None:
    (front,) = read_calibration(camera("one", name="front", translation=[0.0, 1.0, far]).encode())
    np.testing.assert_allclose(front.translation_m, translation_m)
    assert front.name == "front"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[one", "the calibration is no TOML"),
        (_METADATA, "the calibration has no camera"),
        (camera("one", translation="far"), "camera one of the calibration: translation must hold numbers"),
        (camera("one", translation=[0.0, 1.0, 1.0, 2.0]), r"translation must hold numbers of shape \(3,\)"),
        (camera("one", size=960), r"size must hold numbers of shape \(2,\)"),
        (camera("one", size=[1920]), r"size must hold numbers of shape \(2,\)"),
        (camera("one", size=[0, 0]), "width and height in size must be positive"),
        (camera("one", size=[-1920, -1080]), "width and height in size must be positive"),
        (camera("one", fisheye=True), "has a fisheye lens"),
        (camera("one", distortions=[0.1, 0.0, 0.0]), "distortions must be a list of 0, 4, 5, 8, 12, 14 numbers"),
        (camera("one", distortions=0.1), "distortions must be a list"),
        (camera("one", distortions=[0.1, 0.0, 0.0, np.nan]), r"distortions must hold numbers of shape \(4,\)"),
        (camera("one", matrix=lens(-800.0)), "focal lengths of matrix must be"),
    ],
)
def test_bad_calibrations_are_named(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_calibration(text.encode())
