"""Key frames of the scaled person: poses that a generated motion goes through (q'_B of Li et al. 2024, section 3.1)."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import Skeleton

_FADE_S = 1.0
"""Before the first and after the last key frame, the change fades out over this time, seconds."""


@dataclass(frozen=True)
class KeyFrames:
    """Poses of person B at some frames of a take.

    Args:
        frames: Frames (K,), increasing; one at least.
        positions_m: Joints of B (K, J, 3), metres, in the axes and at the place of the take.

    Raises:
        InputError: No frame, frames that do not increase, another number of poses, a value that is not finite.
    """

    frames: npt.NDArray[np.int64]
    positions_m: Array

    def __post_init__(self) -> None:
        """Check frames and poses."""
        if not len(self.frames) or (np.diff(self.frames) <= 0).any():
            raise InputError(f"key frames: frames must increase, each named once; found {self.frames.tolist()}")
        shape = self.positions_m.shape
        if len(shape) != 3 or shape[0] != len(self.frames) or shape[2] != 3:
            raise InputError(
                f"key frames: poses of {counted(len(self.frames), 'frame')} have the shape "
                f"({len(self.frames)}, joints, 3); found {shape}"
            )
        if not np.isfinite(self.positions_m).all():
            raise InputError("key frames: a position is not finite")

    def check(self, name: str, num_frames: int, skeleton: Skeleton) -> None:
        """Refuse key frames that do not fit a take of so many frames.

        Raises:
            InputError: A frame outside the motion, or poses of another skeleton.
        """
        outside = self.frames[(self.frames < 0) | (self.frames >= num_frames)]
        if len(outside):
            raise InputError(
                f"key frames: frame {outside[0]} is outside the motion of {name}, which has "
                f"{counted(num_frames, 'frame')}, 0 to {num_frames - 1}"
            )
        if self.positions_m.shape[1] != skeleton.num_joints:
            raise InputError(
                f"key frames: poses have {self.positions_m.shape[1]} joints, {name} is of "
                f"{skeleton.name}, {skeleton.num_joints}"
            )

    def bone_scale(self, source: Source) -> Array:
        """Return the scales (J,) of B's bones: median lengths of the key frames over the take's; 1 for the root."""
        lengths, before = (np.median(bone_lengths(source.skeleton, self.positions_m), axis=0), source.lengths_m[1])
        return np.where(before > 0.0, lengths / np.where(before > 0.0, before, 1.0), 1.0)

    def bend(self, motion_m: Array, rate_hz: float) -> Array:
        """Return a motion of B (T, J, 3), metres, that goes through the key frames.

        The change is interpolated between key frames without overshoot and fades out beyond them.
        """
        from scipy.interpolate import PchipInterpolator  # here: planning need not wait for it

        away = self.positions_m - motion_m[self.frames]
        reach, nothing = _FADE_S * rate_hz, np.zeros_like(away[:1])
        at = np.concatenate([[self.frames[0] - reach], self.frames, [self.frames[-1] + reach]])
        added = PchipInterpolator(at, np.concatenate([nothing, away, nothing]), extrapolate=False)
        return np.asarray(motion_m + np.nan_to_num(added(np.arange(len(motion_m)))))


def read_key_frames(data: bytes, what: str) -> KeyFrames:
    """Read key frames from JSON: `frames`, and for each of them the joints of B, `body22_m` (22, 3), metres.

    Args:
        data: The file.
        what: Its name, for messages.

    Raises:
        InputError: The file is not of this form.
    """
    try:
        content = json.loads(data)
        frames, positions = content["frames"], np.array(content["body22_m"], dtype=np.float64)
        if not all(type(frame) is int for frame in frames):
            raise TypeError("frames are whole numbers")
        return KeyFrames(np.array(frames, dtype=np.int64), positions)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as problem:
        raise InputError(
            f'{what}: no key frames: {{"frames": [...], "body22_m": [22 joints a frame, each [x, y, z] in metres]}} '
            f"is needed ({type(problem).__name__}: {str(problem)[:80]})"
        ) from None
