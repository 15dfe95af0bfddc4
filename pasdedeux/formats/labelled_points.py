"""Joints of people as labelled points, as in C3D and TRC files, and the motion of each person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.poses2d.annotated_frames import RATE_HZ
from pasdedeux.formats.positions_as_motion import source_from_positions
from pasdedeux.formats.rates import plain_rate
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE, check_range, shorten
from pasdedeux.skeletons import BODY22

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "inches": 0.0254, "ft": 0.3048}
_METRES |= {"meters": 1.0, "metres": 1.0, "meter": 1.0, "metre": 1.0}
_SEPARATORS = ":_.-|/ "
_MIN_JOINTS = 0.5
"""Minimum share of the joints of body22 for points with one prefix to be a person, not an object."""


@dataclass(frozen=True)
class LabelledPoints:
    """The points of a file.

    Args:
        kind: Kind of file, for messages.
        labels: Their names: joints of body22, after a prefix for each person where there are several, `A:pelvis`.
        positions: Positions (frame, point, 3) in the file's unit, NaN in gaps.
        rate_hz: Frames per second.
        unit: The unit that the file states, lower case.
        notes: Assumptions of the reader, a sentence each.
    """

    kind: str
    labels: tuple[str, ...]
    positions: Array
    rate_hz: float
    unit: str
    notes: tuple[str, ...] = ()

    @cached_property
    def people(self) -> list[tuple[str, dict[str, int]]]:
        """People in the order of the file: prefix, and index of the point of each joint; some joints may be missing."""
        joints: dict[str, dict[str, int]] = {}
        for at, label in enumerate(self.labels):
            for joint in BODY22.joint_names:
                prefix = label[: len(label) - len(joint)]
                if label.lower().endswith(joint) and (not prefix or prefix[-1] in _SEPARATORS):
                    joints.setdefault(prefix, {}).setdefault(joint, at)
        least = _MIN_JOINTS * BODY22.num_joints
        return [(prefix, places) for prefix, places in joints.items() if len(places) >= least]

    @property
    def num_people(self) -> int:
        """Number of people, at least 1."""
        return max(len(self.people), 1)

    def source(self, person: int = 0) -> SourceMotion:
        """Return the motion of a person, counted from 0; rotations are swings only.

        Raises:
            FormatError: The points are other markers, a joint of this person is missing, or a point has a gap.
        """
        if not self.people:
            raise FormatError(
                f"the points of this {self.kind} are no joints of a person ({', '.join(map(shorten, self.labels[:4]))}"
                ", ...); needed are those of body22, with a name and ':' before them where it holds several people"
            )
        prefix, places = self.people[person]
        if missing := [joint for joint in BODY22.joint_names if joint not in places]:
            raise FormatError(f"the point '{shorten(prefix)}{missing[0]}' is missing; needed are the joints of body22")
        positions = self.positions[:, [places[joint] for joint in BODY22.joint_names]]
        for frame, joint in np.argwhere(~(np.abs(positions) <= MAX_MAGNITUDE).all(axis=-1)):
            raise FormatError(
                f"frame {frame}: the point '{shorten(prefix)}{BODY22.joint_names[joint]}' is missing, not finite or "
                "absurdly large; fill gaps in the program that captured it"
            )
        rate_hz = check_range(plain_rate(self.rate_hz), f"the rate of this {self.kind}", *RATE_HZ)
        source = source_from_positions(BODY22, positions, rate_hz=rate_hz, metres_per_unit=_METRES.get(self.unit))
        return replace(source, notes=self.notes)
