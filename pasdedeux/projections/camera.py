"""The camera of a projection database: how a pose before it falls on the image, in metres at the mid-hip.

Every camera looks straight at the mid-hip; images of a camera that looks past it are turned first (`straighten_rays`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

Floats = npt.NDArray[Any]

CameraModel = Literal["orthographic", "pinhole"]

_STANDING_MID_HIP_M = 0.93
"""Height of the hip joints of the reference body, standing (Winter 2009, fig. 4.1: 0.530 of stature)."""
_MIN_DISTANCE_M = 1.5


@dataclass(frozen=True)
class DatabaseCamera:
    """A camera on the +Z side of the body that looks at its mid-hip; image x right, y up, metres at its depth.

    Args:
        pitch_rad: Angle above the horizontal that it looks from.
        distance_m: From the mid-hip to the point that all rays meet in; inf for parallel rays.

    Raises:
        InputError: The camera stands on its head, or inside the body.
    """

    pitch_rad: float = 0.0
    distance_m: float = np.inf

    def __post_init__(self) -> None:
        """Check that both can be."""
        if not -np.pi / 2 < self.pitch_rad < np.pi / 2:
            raise InputError(f"the camera's pitch is {self.pitch_rad} rad; it must lie between -pi/2 and pi/2")
        if not self.distance_m > _MIN_DISTANCE_M:
            raise InputError(f"the camera's distance is {self.distance_m} m; it must be more than {_MIN_DISTANCE_M} m")

    @property
    def camera_from_upright_rotmat(self) -> Floats:
        """Rotation (3, 3) from upright axes before the camera to the camera's own (x right, y up, z towards it).

        A camera that looks down sees the top of the head come nearer.
        """
        cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])

    def project(self, poses_m: Floats) -> Floats:
        """Project poses (*batch, joint, 3) about the mid-hip to (*batch, joint, 2) about its image."""
        x, up, towards = np.moveaxis(poses_m, -1, 0)
        if self.pitch_rad != 0.0:
            cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
            up, towards = cosine * up - sine * towards, sine * up + cosine * towards
        image = np.stack([x, up], axis=-1)
        if np.isinf(self.distance_m):
            return image
        image = image * (self.distance_m / (self.distance_m - towards))[..., None]
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
    model: CameraModel, *, pitches_deg: Sequence[float], heights_m: Sequence[float] = (), distance_m: float = 4.0
) -> tuple[DatabaseCamera, ...]:
    """Return the cameras of a study's words, by rising pitch; the same pitch twice gives one.

    Args:
        model: `orthographic` or `pinhole`.
        pitches_deg: Pitches, degrees.
        heights_m: Heights over the floor, see `pitch_of_height`.
        distance_m: Distance from the mid-hip: of the pinhole, and of both for what a height means.

    Raises:
        InputError: No camera, or one that cannot be.
    """
    pitches = {float(np.deg2rad(pitch)) for pitch in pitches_deg}
    pitches |= {pitch_of_height(height, distance_m) for height in heights_m}
    if not pitches:
        raise InputError("a projection database needs a camera: no pitch and no height is given")
    return tuple(DatabaseCamera(pitch, distance_m if model == "pinhole" else np.inf) for pitch in sorted(pitches))
