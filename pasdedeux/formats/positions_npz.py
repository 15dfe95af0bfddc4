"""The npz format of this project for 3D joint positions without rotations.

`positions_m` (frame, joint, 3) of one person or (frame, person, joint, 3), metres, `joint_names` (joint,) of texts,
`parents` (joint,) with -1 for the root (optional when the names are those of body22), `rate_hz`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import MotionFormat
from pasdedeux.formats.npz import get_array, read_npz
from pasdedeux.formats.poses2d.annotated_frames import RATE_HZ
from pasdedeux.formats.positions_as_motion import source_from_positions
from pasdedeux.formats.rates import plain_rate
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE, check_range
from pasdedeux.skeletons import BODY22, Skeleton

_MAX_JOINTS = 1000
_MAX_PEOPLE = 26


def read_positions_npz(data: bytes, companion: bytes = b"", person: int = 0) -> SourceMotion:
    """Read a person of an npz of 3D positions as a motion whose rotations are swings only, in metres."""
    arrays = read_npz(data, "archive of positions")
    axes = np.ndim(arrays.get("positions_m", ()))
    positions = get_array(arrays, "positions_m", "f", (None, None, None, 3) if axes == 4 else (None, None, 3))
    if axes == 4:
        positions = _frames_first(positions)
        check_range(positions.shape[1], "the number of people of array 'positions_m'", 1, _MAX_PEOPLE)
        positions = positions[:, person]
    positions = positions.astype(np.float64)
    num_frames, num_joints, _ = positions.shape
    check_range(num_frames, "the number of frames of array 'positions_m'", 1, np.inf)
    check_range(num_joints, "the number of joints of array 'positions_m'", 1, _MAX_JOINTS)
    names = tuple(str(name) for name in get_array(arrays, "joint_names", "U", (num_joints,)))
    skeleton = BODY22
    if "parents" not in arrays and sorted(names) == sorted(BODY22.joint_names):
        positions = positions[:, [names.index(joint) for joint in BODY22.joint_names]]
        names = BODY22.joint_names
    else:
        skeleton = Skeleton("positions", names, tuple(get_array(arrays, "parents", "iu", (num_joints,)).tolist()))
    for frame, joint in np.argwhere(~(np.abs(positions) <= MAX_MAGNITUDE).all(axis=-1)):
        raise FormatError(f"frame {frame}: the position of '{names[joint]}' is not finite or absurdly large")
    rate_hz = None
    if "rate_hz" in arrays:
        rate_hz = check_range(plain_rate(float(get_array(arrays, "rate_hz", "fiu", ()))), "'rate_hz'", *RATE_HZ)
    return source_from_positions(skeleton, positions, rate_hz=rate_hz, metres_per_unit=1.0)


def _frames_first(positions: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return positions (frame, person, joint, 3), also if the axis of people comes first in the file."""
    return np.swapaxes(positions, 0, 1) if positions.shape[0] <= _MAX_PEOPLE < positions.shape[1] else positions


def _count_people(data: bytes) -> int:
    positions = read_npz(data, "archive of positions", "positions_m".__eq__)["positions_m"]
    return _frames_first(positions).shape[1] if positions.ndim == 4 else 1


POSITIONS_NPZ = MotionFormat(
    name="positions_npz",
    suffixes=(".npz",),
    recognises=lambda start: "positions_m" in start.array_names,
    read=read_positions_npz,
    read_other=read_positions_npz,
    count_people=_count_people,
    has_rotations=False,
)
"""Our npz of 3D positions in metres, y up, which may state its rate."""
