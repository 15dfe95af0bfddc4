"""The camera of a projection database: how a pose before it falls on the image, in metres at the mid-hip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14

__all__ = ["DatabaseCamera", "OrthographicCamera", "PinholeCamera", "Rays", "camera_from_name"]

_ANKLES = OP14.indices(["left_ankle", "right_ankle"])
_ANKLE_HEIGHT_M = 0.07
"""Height of the ankle joint over the sole (Winter 2009, fig. 4.1: 0.039 of stature)."""

Floats = npt.NDArray[Any]


@dataclass(frozen=True)
class Rays:
    """A database camera in numbers, for kernels: y' = cos y - sin z; all times 1 / (1 - z / distance) about `below`.

    Args:
        cos_pitch: Cosine of the pitch.
        sin_pitch: Sine of the pitch.
        distance_m: Distance from the mid-hip; inf for parallel rays.
        floor_to_camera_m: Height of the camera over the ankle of a standing foot; `below` is minus this and minus the
            height of the lower ankle about the mid-hip.
        ankles: Joints of the ankles.
    """

    cos_pitch: float = 1.0
    sin_pitch: float = 0.0
    distance_m: float = float("inf")
    floor_to_camera_m: float = 0.0
    ankles: tuple[int, ...] = tuple(_ANKLES)


class DatabaseCamera(ABC):
    """A camera on the +Z side of the body; image x right, y up, metres at the depth of the mid-hip."""

    @abstractmethod
    def project(self, poses_m: Floats) -> Floats:
        """Project poses (*batch, 14, 3), mid-hip at the origin, to (*batch, 14, 2), mid-hip at the origin."""

    def project_pairs(self, pairs_m: Floats) -> Floats:
        """Project pairs (*batch, person, 14, 3), the middle of both mid-hips at the origin, to (*batch, person, 14, 2).

        For parallel rays nothing but the axes counts, so people project one by one.
        """
        return self.project(pairs_m)

    @property
    @abstractmethod
    def rays(self) -> Rays:
        """The camera in numbers."""

    @property
    def camera_from_upright_rotmat(self) -> Floats:
        """Rotation (3, 3) from upright axes before the camera to the camera's own (x right, y up, z towards it)."""
        return np.eye(3)


@dataclass(frozen=True)
class OrthographicCamera(DatabaseCamera):
    """Parallel rays; a camera `pitch_rad` above the horizontal looks down on the body."""

    pitch_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a camera that stands on its head."""
        if not -np.pi / 2 < self.pitch_rad < np.pi / 2:
            raise InputError(f"the camera's pitch is {self.pitch_rad} rad; it must lie between -pi/2 and pi/2")

    @property
    def rays(self) -> Rays:
        """Parallel rays at the pitch."""
        return Rays(cos_pitch=float(np.cos(self.pitch_rad)), sin_pitch=float(np.sin(self.pitch_rad)))

    @property
    def camera_from_upright_rotmat(self) -> Floats:
        """A camera that looks down sees the top of the head come nearer."""
        cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])

    def project(self, poses_m: Floats) -> Floats:
        """Drop the depth of the camera's axes."""
        if self.pitch_rad == 0.0:
            return poses_m[..., :2]
        cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        y = cosine * poses_m[..., 1] - sine * poses_m[..., 2]
        return np.stack([poses_m[..., 0], y], axis=-1)


@dataclass(frozen=True)
class PinholeCamera(DatabaseCamera):
    """A level pinhole at `height_m` over the floor and `distance_m` before the mid-hip, as in the paper (1.5 m).

    The lower ankle of each pose stands on the floor, which fixes how far below the camera the mid-hip is.
    """

    height_m: float = 1.5
    distance_m: float = 4.0

    def __post_init__(self) -> None:
        """Refuse a camera inside the body."""
        if not (np.isfinite(self.distance_m) and self.distance_m > 1.5):
            raise InputError(f"the camera's distance is {self.distance_m} m; it must be more than 1.5 m")
        if not np.isfinite(self.height_m):
            raise InputError(f"the camera's height is {self.height_m} m; it must be finite")

    @property
    def rays(self) -> Rays:
        """Level rays through one point."""
        return Rays(distance_m=self.distance_m, floor_to_camera_m=self.height_m - _ANKLE_HEIGHT_M)

    def project(self, poses_m: Floats) -> Floats:
        """Divide by depth, then put the mid-hip's image at the origin and scale to metres at its depth."""
        return self._project(poses_m, np.min(poses_m[..., _ANKLES, 1], axis=-1, keepdims=True))

    def project_pairs(self, pairs_m: Floats) -> Floats:
        """Divide by depth as for one, about the middle of both; the lowest ankle of the two stands on the floor."""
        return self._project(pairs_m, np.min(pairs_m[..., _ANKLES, 1], axis=(-2, -1), keepdims=True))

    def _project(self, points_m: Floats, lowest_ankle: Floats) -> Floats:
        below = _ANKLE_HEIGHT_M - lowest_ankle - points_m.dtype.type(self.height_m)
        shrink = self.distance_m / (self.distance_m - points_m[..., 2])
        x = points_m[..., 0] * shrink
        y = (points_m[..., 1] + below) * shrink - below
        return np.stack([x, y], axis=-1).astype(points_m.dtype, copy=False)


def camera_from_name(name: str, *, pitch_rad: float, height_m: float, distance_m: float) -> DatabaseCamera:
    """Give the camera of a study's words: `orthographic` (uses the pitch) or `pinhole` (uses height and distance)."""
    if name == "orthographic":
        return OrthographicCamera(pitch_rad)
    if name == "pinhole":
        return PinholeCamera(height_m, distance_m)
    raise InputError(f"camera '{name}' is not known; known cameras: orthographic, pinhole")
