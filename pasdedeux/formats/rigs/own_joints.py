"""The joints of any motion file, also if they fit no layout, for drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.bvh import BVH, read_bvh_joints
from pasdedeux.formats.file_format import MotionFormat
from pasdedeux.formats.positions_as_motion import source_from_positions
from pasdedeux.formats.rigs.resolution import resolve_motion
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.skeletons import Skeleton


@dataclass(frozen=True)
class OwnJoints:
    """One hierarchy of a file over time.

    Args:
        skeleton: Joints and parents of the file.
        positions: Positions (frame, J, 3), file units and axes; bones may change their length.
        rate_hz: Frame rate that the file states; None if it states none.
        metres_per_unit: Length of its unit; None if it states none.
    """

    skeleton: Skeleton
    positions: Array
    rate_hz: float | None
    metres_per_unit: float | None

    @property
    def source(self) -> SourceMotion:
        """The joints as a motion without twist, bones at median lengths, from which unit and axis are estimated."""
        return source_from_positions(
            self.skeleton, self.positions, rate_hz=self.rate_hz, metres_per_unit=self.metres_per_unit
        )


def read_own_joints(kind: MotionFormat, data: bytes, companion: bytes = b"") -> list[OwnJoints]:
    """Return each hierarchy of a motion file; several people in one tree are one hierarchy.

    Raises:
        FormatError: The file is damaged.
    """
    if kind is BVH:
        rate_hz, trees = read_bvh_joints(data)
        return [OwnJoints(skeleton, positions, rate_hz, None) for skeleton, positions in trees]
    return [
        OwnJoints(
            person.skeleton,
            forward_kinematics(person.skeleton, person.rest_offsets, person.root_translation, person.local_unitquat)[0],
            person.rate_hz,
            person.metres_per_unit,
        )
        for person in kind.read_people(data, companion)
    ]


def is_body(kind: MotionFormat, data: bytes, companion: bytes = b"") -> bool:
    """Return whether all people of a file have a known layout and bones of constant length."""
    try:
        people: Sequence[SourceMotion] = kind.read_people(data, companion)
    except FormatError:
        return False
    return all(resolve_motion(person.rest).layout is not None for person in people)
