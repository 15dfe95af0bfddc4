"""The camera of a projection database: how a pose before it falls on the image, in metres at the mid-hip.

Every camera looks straight at the mid-hip; images of a camera that looks past it are turned first (`straighten_rays`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[Any]


@dataclass(frozen=True)
class DatabaseCamera:
    """A camera on the +Z side of the body that looks at its mid-hip; rays are parallel; image x right, y up, metres.

    Args:
        pitch_rad: Angle above the horizontal that it looks from.
    """

    pitch_rad: float = 0.0

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
            up = cosine * up - sine * towards
        return np.stack([x, up], axis=-1)
