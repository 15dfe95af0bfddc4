"""Takes of ExPI: 3D positions of 18 joints of two people, without rotations.

Layout as the authors read and draw it (W. Guo, X. Bie, X. Alameda-Pineda and F. Moreno-Noguer, "Multi-Person Extreme
Motion Prediction", CVPR 2022; their public loaders, GUO-W/ExPI_toolbox `util.py` and GUO-W/MultiMotion
`utils/dataset/pi3d.py`): `<acro1 or acro2>/<action>/mocap_cleaned.tsv` is a line of names, then a line of 108 numbers
for each frame, separated by commas whatever the name says: x, y, z of the leader's 18 joints, then of the follower's,
in millimetres, Z up, 25 frames a second.  The data are given out for research on request; none of them is here.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.positions_as_motion import source_from_positions
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import Lines, floats_of, parse_numbers
from pasdedeux.skeletons import EXPI18
from pasdedeux.skeletons.skeleton import by_joint

_NUM_PERSONS = 2
_ORDER = (
    *("head", "left_head", "right_head", "back"),
    *by_joint("left", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe"),
)
"""Joints in the order of the file, by the names of `expi18`: `head` is the front of the head, heels are ankles."""
_NUM_VALUES = _NUM_PERSONS * len(_ORDER) * 3
_RATE_HZ = 25.0
_METRES_PER_UNIT = 1e-3


def read_expi(data: bytes, companion: bytes = b"", person: int = 0) -> SourceMotion:
    """Read one person of a take as a motion whose rotations are swings only: 0 is the leader, 1 the follower.

    Raises:
        FormatError: There is no frame, or a line has another number of values or one that is no finite number; the
            line is named.
    """
    rows = []
    with Lines(data, "take of ExPI") as lines:
        next(iter(lines))
        for text in lines:
            if text.strip():
                rows.append(parse_numbers(text.split(","), "a frame of two people of 18 joints", _NUM_VALUES))
        if not rows:
            raise FormatError("there is no frame after the line of names")
    positions = np.array(rows).reshape(-1, _NUM_PERSONS, len(_ORDER), 3)[:, person]
    ours = positions[:, [_ORDER.index(name) for name in EXPI18.joint_names]]
    return source_from_positions(EXPI18, ours, rate_hz=_RATE_HZ, metres_per_unit=_METRES_PER_UNIT)


def _is_expi(start: FileStart) -> bool:
    """Return whether a line of names is followed by one of 108 numbers, separated by commas."""
    names, _, rest = start.text.partition("\n")
    return any(map(str.isalpha, names)) and len(floats_of(rest.partition("\n")[0].split(","))) == _NUM_VALUES


EXPI = MotionFormat(
    name="expi",
    suffixes=(".tsv",),
    recognises=_is_expi,
    read=read_expi,
    read_other=read_expi,
    count_people=lambda data: _NUM_PERSONS,
    has_rotations=False,
)
"""Positions of the two people of an ExPI take: 25 Hz, millimetres."""
