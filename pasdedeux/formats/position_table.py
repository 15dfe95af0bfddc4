"""Our npz of 3D joint positions without rotations.

`positions_m` (frame, joint, 3) of one person, metres, `joint_names` (joint,) of texts,
`parents` (joint,) with -1 for the root (may be left out when the names are those of body22), `rate_hz`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE
from pasdedeux.formats.working_poses import motion_from_positions
from pasdedeux.skeletons import BODY22, Skeleton

__all__ = ["PositionTake", "read_positions_npz"]

_MAX_JOINTS = 1000


@dataclass(frozen=True)
class PositionTake:
    """Positions (frame, J, 3) of one person in metres; `rate_hz` is None when the file does not say."""

    skeleton: Skeleton
    positions: npt.NDArray[np.float64]
    rate_hz: float | None

    def to_source_motion(self) -> SourceMotion:
        """Return the positions as a motion whose rotations are swings only, in metres."""
        motion = motion_from_positions(self.skeleton, self.positions, self.rate_hz or 1.0)
        return SourceMotion(
            skeleton=motion.skeleton,
            rest_offsets=motion.rest_offsets_m,
            root_translation=motion.root_translation_m,
            local_unitquat=motion.local_unitquat,
            end_sites=frozenset(),
            rate_hz=self.rate_hz,
            metres_per_unit=1.0,
        )


def read_positions_npz(data: bytes) -> PositionTake:
    """Read an npz of 3D positions.

    Raises:
        FormatError: The archive is damaged, an array is missing or wrong, or a position is not finite (frame and joint
            are named).
    """
    arrays = read_npz(data, "archive of positions")
    positions = arrays.get("positions_m")
    if positions is None or positions.dtype.kind != "f" or positions.ndim != 3 or positions.shape[2] != 3:
        raise FormatError("array 'positions_m' (frame, joint, 3) of floats is needed")
    if not 0 < positions.shape[1] <= _MAX_JOINTS or positions.shape[0] < 1:
        raise FormatError(
            f"array 'positions_m' has the shape {positions.shape}; 1 frame and 1 to {_MAX_JOINTS} joints are needed"
        )
    names = arrays.get("joint_names")
    if names is None or names.dtype.kind != "U" or names.shape != (positions.shape[1],):
        raise FormatError(f"array 'joint_names' with {positions.shape[1]} texts is needed")
    joint_names = tuple(str(name) for name in names)
    parents = arrays.get("parents")
    if parents is None and joint_names == BODY22.joint_names:
        skeleton = BODY22
    elif parents is None or parents.dtype.kind not in "iu" or parents.shape != names.shape:
        raise FormatError(f"array 'parents' with {positions.shape[1]} whole numbers is needed")
    else:
        try:
            skeleton = Skeleton(name="positions", joint_names=joint_names, parents=tuple(int(p) for p in parents))
        except InputError as error:
            raise FormatError(str(error)) from None
    values = positions.astype(np.float64)
    is_bad = ~(np.abs(values) <= MAX_MAGNITUDE).all(axis=-1)
    if is_bad.any():
        frame, joint = (int(index) for index in np.argwhere(is_bad)[0])
        raise FormatError(f"frame {frame}: the position of '{joint_names[joint]}' is not finite or absurdly large")
    rate = arrays.get("rate_hz")
    if rate is not None and (rate.shape != () or rate.dtype.kind not in "fiu" or not 1e-3 <= float(rate) <= 1e5):
        raise FormatError("'rate_hz' must be one number from 0.001 to 100000")
    return PositionTake(skeleton=skeleton, positions=values, rate_hz=None if rate is None else float(rate))
