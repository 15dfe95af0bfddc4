"""Calibrations of several cameras: `calib.toml` as Pose2Sim, Anipose and freemocap write it."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError

_SHAPES = {"matrix": (3, 3), "rotation": (3,), "translation": (3,)}
_NUMS_DISTORTIONS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV knows."""
_MILLIMETRES_FROM = 100.0
"""Cameras of which one is farther from the origin are given in millimetres, as Anipose and freemocap do."""


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera by OpenCV's conventions: x right, y down, z away from the camera.

    Args:
        name: As the file has it.
        matrix: Lens (3, 3), pixels.
        distortions: Coefficients of OpenCV's distortion (n,).
        rotvec: Rotation from the world to the camera (3,).
        translation_m: What is added after it (3,), metres.
    """

    name: str
    matrix: Array
    distortions: Array
    rotvec: Array
    translation_m: Array

    def undistorted_px(self, px: Array) -> Array:
        """Return pixels (*batch, 2) as a lens without distortion would have them; NaN stays NaN."""
        import cv2  # here: a quarter of a second that others need not wait for

        flat = np.array(px, dtype=np.float64).reshape(-1, 1, 2)
        is_seen = np.isfinite(flat).all(axis=(1, 2))
        if self.distortions.any() and is_seen.any():
            flat[is_seen] = cv2.undistortPoints(flat[is_seen], self.matrix, self.distortions, P=self.matrix)
        return np.asarray(flat.reshape(np.shape(px)))

    def distorted_px(self, px: Array) -> Array:
        """Return where pixels (*batch, 2) of a lens without distortion are in its images; NaN stays NaN."""
        import cv2  # here: a quarter of a second that others need not wait for

        flat = np.array(px, dtype=np.float64).reshape(-1, 2)
        is_seen = np.isfinite(flat).all(axis=1)
        if self.distortions.any() and is_seen.any():
            ahead = np.insert(flat[is_seen], 2, 1.0, axis=1) @ np.linalg.inv(self.matrix).T
            flat[is_seen] = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.matrix, self.distortions)[0][:, 0]
        return flat.reshape(np.shape(px))


def read_calibration(data: bytes) -> list[CalibratedCamera]:
    """Return the cameras of a `calib.toml`, in the order of the file.

    Each camera is a table with `matrix`, `rotation` (a rotation vector), `translation` and, where there is any,
    `distortions`.  Tables without `matrix`, such as `metadata`, are left out.

    Raises:
        InputError: The file is no TOML, has no camera, or one lacks a number or has a lens that is not supported.
    """
    try:
        tables = tomllib.loads(data.decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"the calibration is no TOML: {error}") from None
    cameras = []
    for name, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue
        if table.get("fisheye", False):
            raise InputError(f"camera {name} of the calibration has a fisheye lens, which is not supported")
        matrix, rotvec, translation = (_numbers(name, table, key, shape) for key, shape in _SHAPES.items())
        if min(matrix[0, 0], matrix[1, 1]) <= 0:
            raise InputError(f"camera {name} of the calibration: the focal lengths of matrix must be positive")
        cameras.append(
            CalibratedCamera(str(table.get("name", name)), matrix, _distortions(name, table), rotvec, translation)
        )
    if not cameras:
        raise InputError("the calibration has no camera: a table with matrix, rotation and translation")
    far = max(float(np.linalg.norm(camera.translation_m)) for camera in cameras)
    if far <= _MILLIMETRES_FROM:
        return cameras
    return [replace(camera, translation_m=camera.translation_m / 1e3) for camera in cameras]


def _distortions(name: str, table: dict[str, object]) -> Array:
    given = table.get("distortions", [])
    if isinstance(given, list) and len(given) in _NUMS_DISTORTIONS:
        return _numbers(name, {"distortions": given}, "distortions", (len(given),))
    counts = ", ".join(map(str, _NUMS_DISTORTIONS))
    raise InputError(f"camera {name} of the calibration: distortions must be a list of {counts} numbers")


def _numbers(name: str, table: dict[str, object], key: str, shape: tuple[int, ...]) -> Array:
    try:
        numbers = np.array(table[key], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise InputError(f"camera {name} of the calibration: {key} must hold numbers of shape {shape}")
    return numbers
