"""Calibrations of several cameras: `calib.toml` as Pose2Sim, Anipose and freemocap write it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec

_SHAPES = {"matrix": (3, 3), "rotation": (3,), "translation": (3,)}
_NUMS_DISTORTIONS = (0, 4, 5, 8, 12, 14)
"""Numbers of distortion coefficients that OpenCV supports."""
_NO_NAMES = {"int", "ext", "img", "json", "keypoints", "pose", "video", "synchronized", "annotations"}
"""Words that these programs add to names of cameras and files; ignored."""
_SHAPE_TOLERANCE = 0.01
"""Largest relative difference of the aspect ratios of images of one camera."""
_ONE_PLACE_M = 0.01
"""Cameras nearer to each other have no known positions: Pose2Sim writes zeros until extrinsics are known."""
_MILLIMETRES_FROM = 100.0
"""If a camera is farther from the origin, the unit is millimetres, as written by Anipose and freemocap."""


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera by OpenCV's conventions: x right, y down, z away from the camera.

    Args:
        name: Its name in the file.
        table: Name of its table.
        matrix: Lens (3, 3), pixels.
        distortions: Coefficients of OpenCV's distortion (n,).
        rotvec: Rotation from the world to the camera (3,).
        translation_m: Translation after the rotation (3,), metres.
        size_px: Width and height of the calibration images; None if not stated.
    """

    name: str
    table: str
    matrix: Array
    distortions: Array
    rotvec: Array
    translation_m: Array
    size_px: tuple[float, float] | None = None

    @property
    def position_m(self) -> Array:
        """Position in the world (3,)."""
        return -rotmat_from_unitquat(unitquat_from_rotvec(self.rotvec)).T @ self.translation_m

    def for_images(self, size_px: tuple[float, float] | None) -> CalibratedCamera:
        """Return the camera scaled to images of another size; unchanged if one of the sizes is unknown.

        Raises:
            InputError: The images have another shape.
        """
        if self.size_px is None or size_px is None or tuple(size_px) == self.size_px:
            return self
        across, down = (ours / theirs for ours, theirs in zip(size_px, self.size_px, strict=True))
        if abs(across / down - 1.0) > _SHAPE_TOLERANCE:
            (width, height), (wide, tall) = self.size_px, size_px
            raise InputError(
                f"camera {self.name} of the calibration is of images of {width:.0f} x {height:.0f}, and those that are "
                f"given are {wide:.0f} x {tall:.0f}"
            )
        # Pixel centres are whole numbers for OpenCV: the corner of the image is at -0.5.
        scale = np.array([[across, 0.0, 0.5 * (across - 1.0)], [0.0, down, 0.5 * (down - 1.0)], [0.0, 0.0, 1.0]])
        return replace(self, matrix=scale @ self.matrix, size_px=(float(size_px[0]), float(size_px[1])))

    @property
    def focal_px(self) -> float:
        """Focal length of the plain lens: geometric mean of both."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @property
    def plain_matrix(self) -> Array:
        """Lens matrix (3, 3) without distortion or skew, with one focal length and the same principal point."""
        return np.array([[self.focal_px, 0.0, self.matrix[0, 2]], [0.0, self.focal_px, self.matrix[1, 2]], [0, 0, 1]])

    @property
    def _is_plain(self) -> bool:
        return not self.distortions.any() and np.array_equal(self.matrix, self.plain_matrix)

    def undistorted_px(self, px: Array) -> Array:
        """Convert pixels (*batch, 2) of the images to those of the plain lens; NaN stays NaN."""
        import cv2  # here: a quarter of a second that others need not wait for

        flat = np.array(px, dtype=np.float64).reshape(-1, 1, 2)
        is_seen = np.isfinite(flat).all(axis=(1, 2))
        if not self._is_plain and is_seen.any():
            flat[is_seen] = cv2.undistortPoints(flat[is_seen], self.matrix, self.distortions, P=self.plain_matrix)
        return np.asarray(flat.reshape(np.shape(px)))

    def distorted_px(self, px: Array) -> Array:
        """Convert pixels (*batch, 2) of the plain lens to those of the images; NaN stays NaN."""
        import cv2  # here: a quarter of a second that others need not wait for

        flat = np.array(px, dtype=np.float64).reshape(-1, 2)
        is_seen = np.isfinite(flat).all(axis=1)
        if not self._is_plain and is_seen.any():
            ahead = np.insert(flat[is_seen], 2, 1.0, axis=1) @ np.linalg.inv(self.plain_matrix).T
            flat[is_seen] = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.matrix, self.distortions)[0][:, 0]
        return flat.reshape(np.shape(px))


def read_calibration(data: bytes) -> list[CalibratedCamera]:
    """Return the cameras of a `calib.toml`, in the order of the file.

    Each camera is a table with `matrix`, `rotation` (a rotation vector), `translation` and optionally `name`, `size`
    and `distortions`.  Tables without `matrix`, such as `metadata`, and other keys are ignored.

    Raises:
        InputError: The file is not TOML, has no camera, or a camera lacks a number or has an unsupported lens.
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
        size = _numbers(name, table, "size", (2,)).tolist() if "size" in table else None
        if size and min(size) <= 0:
            raise InputError(f"camera {name} of the calibration: width and height in size must be positive")
        called, distortions = str(table.get("name", name)), _distortions(name, table)
        cameras.append(CalibratedCamera(called, name, matrix, distortions, rotvec, translation, size and tuple(size)))
    if not cameras:
        raise InputError("the calibration has no camera: a table with matrix, rotation and translation")
    far = max(float(np.linalg.norm(camera.translation_m)) for camera in cameras)
    if far <= _MILLIMETRES_FROM:
        return cameras
    return [replace(camera, translation_m=camera.translation_m / 1e3) for camera in cameras]


def calibrated_camera(text: str, table: str, size_px: tuple[float, float] | None) -> CalibratedCamera:
    """Return the camera in a table of a calibration (TOML), scaled to images of this size if it is known.

    Raises:
        InputError: As `read_calibration`, or the images have another shape.
    """
    camera = next(camera for camera in read_calibration(text.encode()) if camera.table == table)
    return camera.for_images(size_px)


def choose_cameras(cameras: Sequence[CalibratedCamera], names: Sequence[str]) -> tuple[list[CalibratedCamera], bool]:
    """Return the camera of each file, and whether they were matched by name; else they are in the same order.

    A camera and a file match if the words of one name (`name`, else the table's) occur in the other: `int_cam01_img`
    and `cam1.mp4`.  Words with which all files, or all cameras, begin or end are ignored.  The camera with most common
    words is taken.

    Raises:
        InputError: Only some names match, no names match and the numbers differ, or cameras are at one place.
    """
    fits: list[list[CalibratedCamera]] = [[] for _ in names]
    for key in ("name", "table"):
        for split in (_words, _words_without_capitals):
            words = _distinctive([split(getattr(camera, key)) for camera in cameras])
            if not any(fits):
                fits = [_fitting(file, cameras, words) for file in _distinctive([split(name) for name in names])]
    called = ", ".join(camera.name for camera in cameras)
    chosen, is_by_name = list(cameras), any(fits)
    if is_by_name:
        chosen = [camera for fit in fits if len(fit) == 1 for camera in fit]
        if len(chosen) < len(names) or len({camera.table for camera in chosen}) < len(names):
            which = "; ".join(
                f"{name}: {' or '.join(camera.name for camera in fit) or 'none'}"
                for name, fit in zip(names, fits, strict=True)
            )
            raise InputError(
                f"the cameras {called} of the calibration fit only some files by their names ({which}); name the files "
                "as the cameras are"
            )
    elif len(cameras) != len(names):
        raise InputError(
            f"the calibration has {len(cameras)} cameras ({called}), {len(names)} are given ({', '.join(names)}), and "
            "no names fit; name the files as the cameras are"
        )
    for number, camera in enumerate(chosen):
        for other in chosen[:number]:
            if np.linalg.norm(camera.position_m - other.position_m) < _ONE_PLACE_M:
                raise InputError(
                    f"cameras {other.name} and {camera.name} of the calibration are at one place: it has lenses, but "
                    "not where the cameras are; calibrate their places (extrinsics) as well"
                )
    return chosen, is_by_name


def _fitting(
    words: Sequence[str], cameras: Sequence[CalibratedCamera], names: Sequence[Sequence[str]]
) -> list[CalibratedCamera]:
    """Return the cameras whose names match the words of a file best."""
    common = [min(len(words), len(name)) if _is_within(words, name) or _is_within(name, words) else 0 for name in names]
    most = max(common, default=0)
    return [camera for camera, count in zip(cameras, common, strict=True) if count == most > 0]


def _words(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, in lower case, except ignored ones.

    >>> _words("int_cam01_img"), _words("vid-camA"), _words("Camera_000_synchronized")
    (('cam', '1'), ('vid', 'cam', 'a'), ('camera', '0'))
    """
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+", name)
    return tuple(
        part.lstrip("0") or "0" if part.isdigit() else part.lower() for part in parts if part.lower() not in _NO_NAMES
    )


def _words_without_capitals(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name; capitals do not start a new word.

    >>> _words_without_capitals("GoPro1")
    ('gopro', '1')
    """
    return _words(name.lower())


def _distinctive(names: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Remove words with which all names begin or end; unchanged if a name would become empty.

    >>> _distinctive([("take", "1", "left"), ("take", "1", "right")])
    [('left',), ('right',)]
    """
    kept = list(names)
    while len(kept) > 1 and all(kept) and len({name[0] for name in kept}) == 1:
        kept = [name[1:] for name in kept]
    while len(kept) > 1 and all(kept) and len({name[-1] for name in kept}) == 1:
        kept = [name[:-1] for name in kept]
    return kept if all(kept) else list(names)


def _is_within(words: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether some words occur in others one after another; false for no words."""
    starts = range(len(others) - len(words) + 1)
    return bool(words) and any(tuple(others[at : at + len(words)]) == tuple(words) for at in starts)


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
