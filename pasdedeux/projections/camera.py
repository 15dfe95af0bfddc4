"""The camera of a projection database: how a pose before it falls on the image, in metres at the mid-hip.

Every camera looks straight at the mid-hip; images of a camera that looks past it are turned first (`straighten_rays`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

Floats = npt.NDArray[Any]

CAMERA_MODELS = ("orthographic", "pinhole")

_STANDING_MID_HIP_M = 0.93
"""Height of the hip joints of the reference body, standing (Winter 2009, fig. 4.1: 0.530 of stature)."""
_MIN_DISTANCE_M = 1.5


@dataclass(frozen=True)
class DatabaseCamera(ABC):
    """A camera on the +Z side of the body that looks at its mid-hip from `pitch_rad` above the horizontal.

    Image x right, y up, metres at the depth of the mid-hip.
    """

    pitch_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a camera that stands on its head."""
        if not -np.pi / 2 < self.pitch_rad < np.pi / 2:
            raise InputError(f"the camera's pitch is {self.pitch_rad} rad; it must lie between -pi/2 and pi/2")

    @abstractmethod
    def project(self, poses_m: Floats) -> Floats:
        """Project poses (*batch, joint, 3) about the point looked at to (*batch, joint, 2) about its image."""

    @property
    @abstractmethod
    def ray_distance_m(self) -> float:
        """Distance from the mid-hip to the point that all rays meet in; inf for parallel rays."""

    @property
    def camera_from_upright_rotmat(self) -> Floats:
        """Rotation (3, 3) from upright axes before the camera to the camera's own (x right, y up, z towards it).

        A camera that looks down sees the top of the head come nearer.
        """
        cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])

    def _upwards(self, poses_m: Floats) -> Floats:
        if self.pitch_rad == 0.0:
            return np.asarray(poses_m[..., 1])
        return np.asarray(np.cos(self.pitch_rad) * poses_m[..., 1] - np.sin(self.pitch_rad) * poses_m[..., 2])

    def _towards(self, poses_m: Floats) -> Floats:
        if self.pitch_rad == 0.0:
            return np.asarray(poses_m[..., 2])
        return np.asarray(np.sin(self.pitch_rad) * poses_m[..., 1] + np.cos(self.pitch_rad) * poses_m[..., 2])


@dataclass(frozen=True)
class OrthographicCamera(DatabaseCamera):
    """Parallel rays."""

    @property
    def ray_distance_m(self) -> float:
        """Parallel rays meet nowhere."""
        return float("inf")

    def project(self, poses_m: Floats) -> Floats:
        """Drop the depth of the camera's axes."""
        if self.pitch_rad == 0.0:
            return poses_m[..., :2]
        return np.stack([poses_m[..., 0], self._upwards(poses_m)], axis=-1)


@dataclass(frozen=True)
class PinholeCamera(DatabaseCamera):
    """Rays through one point, `distance_m` from the mid-hip."""

    distance_m: float = 4.0

    def __post_init__(self) -> None:
        """Refuse a camera inside the body too."""
        super().__post_init__()
        if not (np.isfinite(self.distance_m) and self.distance_m > _MIN_DISTANCE_M):
            raise InputError(f"the camera's distance is {self.distance_m} m; it must be more than {_MIN_DISTANCE_M} m")

    @property
    def ray_distance_m(self) -> float:
        """The distance of the pinhole."""
        return self.distance_m

    def project(self, poses_m: Floats) -> Floats:
        """Divide by depth; the scale is that at the mid-hip's."""
        shrink = self.distance_m / (self.distance_m - self._towards(poses_m))
        image = np.stack([poses_m[..., 0] * shrink, self._upwards(poses_m) * shrink], axis=-1)
        return np.asarray(image.astype(poses_m.dtype, copy=False))


def pitch_of_height(height_m: float, distance_m: float) -> float:
    """Return the pitch in radians at which a camera `height_m` over the floor looks at the mid-hip of who stands there.

    Raises:
        InputError: The camera would be straight above or below, or a value is not finite.
    """
    sine = (height_m - _STANDING_MID_HIP_M) / distance_m if distance_m > 0 else float("nan")
    if not abs(sine) < 1.0:
        raise InputError(f"no camera stands {height_m} m over the floor, {distance_m} m from the hips of a person")
    return float(np.arcsin(sine))


def cameras_of(
    model: str, *, pitches_deg: Sequence[float], heights_m: Sequence[float] = (), distance_m: float = 4.0
) -> tuple[DatabaseCamera, ...]:
    """Return the cameras of a study's words, by rising pitch; the same pitch twice gives one.

    Args:
        model: `orthographic` or `pinhole`.
        pitches_deg: Pitches, degrees.
        heights_m: Heights over the floor, see `pitch_of_height`.
        distance_m: Distance from the mid-hip: of the pinhole, and of both for what a height means.

    Raises:
        InputError: Another model, no camera, or one that cannot be.
    """
    if model not in CAMERA_MODELS:
        raise InputError(f"camera '{model}' is not known; known cameras: {', '.join(CAMERA_MODELS)}")
    pitches = {float(np.deg2rad(pitch)) for pitch in pitches_deg}
    pitches |= {pitch_of_height(height, distance_m) for height in heights_m}
    if not pitches:
        raise InputError("a projection database needs a camera: no pitch and no height is given")
    if model == "orthographic":
        return tuple(OrthographicCamera(pitch) for pitch in sorted(pitches))
    return tuple(PinholeCamera(pitch, distance_m) for pitch in sorted(pitches))
