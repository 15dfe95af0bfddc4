"""Our npz of 3D joint positions without rotations.

`positions_m` (frame, joint, 3) of one person, metres, `joint_names` (joint,) of texts,
`parents` (joint,) with -1 for the root (may be left out when the names are those of body22), `rate_hz`.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.positions_as_motion import motion_from_positions
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE
from pasdedeux.skeletons import BODY22, Skeleton

_MAX_JOINTS = 1000


class PositionsNpz(MotionFormat):
    """Our npz of 3D positions: metres, y up; it may state its rate."""

    name = "positions_npz"
    recognised_by = "npz archive with 'positions_m'"
    suffixes = (".npz",)
    has_rotations = False

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is an archive with the array positions_m."""
        return "positions_m" in start.array_names

    def read(self, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read everything."""
        return read_positions_npz(data)


def read_positions_npz(data: bytes) -> SourceMotion:
    """Read an npz of 3D positions as a motion whose rotations are swings only, in metres.

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
    rate_hz = None if rate is None else float(rate)
    motion = motion_from_positions(skeleton, values, rate_hz or 1.0)
    return SourceMotion(
        skeleton=motion.skeleton,
        rest_offsets=motion.rest_offsets_m,
        root_translation=motion.root_translation_m,
        local_unitquat=motion.local_unitquat,
        rate_hz=rate_hz,
        metres_per_unit=1.0,
    )
