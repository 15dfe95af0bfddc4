"""A motion: one person's skeleton moving over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.kinematics.rotations import slerp
from pasdedeux.skeletons import Skeleton

__all__ = ["Motion"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """One person's motion on its own skeleton, right-handed, Y up, metres, seconds.

    Args:
        skeleton: The source's own joints, J of them.
        rest_offsets_m: Offset of each joint from its parent at rest, (J, 3); the root's is ignored.
        root_translation_m: World position of the root, (frame, 3).
        local_unitquat: Local rotations, (frame, J, 4), x, y, z, w.
        rate_hz: Frames per second.

    Raises:
        InputError: Shapes do not fit, the rate is not positive, or a value is not finite (the frame is named).
    """

    skeleton: Skeleton
    rest_offsets_m: Array
    root_translation_m: Array
    local_unitquat: Array
    rate_hz: float

    def __post_init__(self) -> None:
        """Check shapes, rate and finiteness."""
        joints, frames = self.skeleton.num_joints, len(self.root_translation_m)
        if self.rest_offsets_m.shape != (joints, 3):
            raise InputError(f"rest offsets have shape {self.rest_offsets_m.shape}, expected ({joints}, 3)")
        if self.root_translation_m.shape != (frames, 3) or self.local_unitquat.shape != (frames, joints, 4):
            raise InputError(
                f"root translations {self.root_translation_m.shape} and rotations {self.local_unitquat.shape} "
                f"do not fit {joints} joints: expected (frames, 3) and (frames, {joints}, 4)"
            )
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise InputError(f"the frame rate is {self.rate_hz}, it must be positive")
        is_bad = ~(
            np.isfinite(self.root_translation_m).all(axis=-1) & np.isfinite(self.local_unitquat).all(axis=(-1, -2))
        )
        if is_bad.any():
            raise InputError(f"frame {int(np.argmax(is_bad))}: a value is not finite")

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.root_translation_m)

    @property
    def duration_s(self) -> float:
        """Time between the first and the last frame."""
        return max(self.num_frames - 1, 0) / self.rate_hz

    def world(self) -> tuple[Array, Array]:
        """Return world positions (frame, J, 3) and world rotations (frame, J, 4)."""
        return forward_kinematics(self.skeleton, self.rest_offsets_m, self.root_translation_m, self.local_unitquat)

    def rest_positions_m(self) -> Array:
        """Return the rest pose (J, 3) with the root at the origin."""
        rest = np.zeros((self.skeleton.num_joints, 4))
        rest[:, 3] = 1.0
        positions, _ = forward_kinematics(self.skeleton, self.rest_offsets_m, np.zeros(3), rest)
        return positions

    def slice(self, start: int, stop: int) -> Motion:
        """Return frames `start` to `stop` (exclusive)."""
        return Motion(
            skeleton=self.skeleton,
            rest_offsets_m=self.rest_offsets_m,
            root_translation_m=self.root_translation_m[start:stop],
            local_unitquat=self.local_unitquat[start:stop],
            rate_hz=self.rate_hz,
        )

    def resample(self, rate_hz: float) -> Motion:
        """Return motion at another rate: positions linearly, rotations on the short arc, from the first frame on."""
        if rate_hz == self.rate_hz or self.num_frames < 2:
            return Motion(
                skeleton=self.skeleton,
                rest_offsets_m=self.rest_offsets_m,
                root_translation_m=self.root_translation_m,
                local_unitquat=self.local_unitquat,
                rate_hz=rate_hz,
            )
        count = int(np.floor(self.duration_s * rate_hz + 1e-9)) + 1
        at = np.arange(count) * (self.rate_hz / rate_hz)
        before = np.minimum(np.floor(at + 1e-9).astype(int), self.num_frames - 1)
        after = np.minimum(before + 1, self.num_frames - 1)
        fraction = np.clip(at - before, 0.0, 1.0)
        roots = self.root_translation_m
        return Motion(
            skeleton=self.skeleton,
            rest_offsets_m=self.rest_offsets_m,
            root_translation_m=roots[before] + fraction[:, None] * (roots[after] - roots[before]),
            local_unitquat=slerp(
                self.local_unitquat[before],
                self.local_unitquat[after],
                np.broadcast_to(fraction[:, None], (count, self.skeleton.num_joints)),
            ),
            rate_hz=rate_hz,
        )
