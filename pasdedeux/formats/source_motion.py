"""A motion as read from a file: the file's joints, length unit and up axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError, check_positive
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.kinematics.rotations import conjugate, identity_unitquat, multiply, rotate, unitquat_from_rotvec
from pasdedeux.skeletons import Skeleton
from pasdedeux.skeletons.layouts.names import with_sides_exchanged

UP_AXES = {
    "x": (0.0, 0.0, np.pi / 2),
    "y": (0.0, 0.0, 0.0),
    "z": (-np.pi / 2, 0.0, 0.0),
    "-x": (0.0, 0.0, -np.pi / 2),
    "-y": (np.pi, 0.0, 0.0),
    "-z": (np.pi / 2, 0.0, 0.0),
}
"""Up axes of files, each with the rotation vector that turns it to y, the up axis inside the project."""

_SAMPLE = 200
"""Number of frames from which estimates are made."""


@dataclass(frozen=True)
class SourceMotion:
    """Motion of one person in the length unit and axes of a file.

    Args:
        skeleton: The file's joints; End Sites are joints named `<parent>_end` that never turn.
        rest_offsets: Offset of each joint from its parent in the parent's frame, (J, 3), file units.
        root_translation: Position of the root, (frame, 3), file units.
        local_unitquat: Local rotations, (frame, J, 4), x, y, z, w.
        end_sites: Names of the joints that are End Sites.
        rate_hz: Frame rate that the file states; None if it states none.
        metres_per_unit: Length of the file's unit; None if the file does not state it.
        notes: Assumptions and changes of the reader, a sentence each.
    """

    skeleton: Skeleton
    rest_offsets: Array
    root_translation: Array
    local_unitquat: Array
    end_sites: frozenset[str] = frozenset()
    rate_hz: float | None = None
    metres_per_unit: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.root_translation)

    @cached_property
    def sample(self) -> tuple[Array, Array]:
        """Positions (frame, J, 3) and world rotations (frame, J, 4) of 200 to 400 frames evenly spread, or all."""
        step = max(1, self.num_frames // _SAMPLE)
        return forward_kinematics(
            self.skeleton, self.rest_offsets, self.root_translation[::step], self.local_unitquat[::step]
        )

    @cached_property
    def rest(self) -> SourceMotion:
        """One frame of its rest pose, the root at the origin."""
        still = identity_unitquat(1, self.skeleton.num_joints)
        return replace(self, root_translation=np.zeros((1, 3)), local_unitquat=still)

    def frames(self, start: int, stop: int) -> SourceMotion:
        """Return frames `start` to `stop` (exclusive)."""
        return replace(
            self, root_translation=self.root_translation[start:stop], local_unitquat=self.local_unitquat[start:stop]
        )

    def mirrored(self, up_axis: str = "y") -> SourceMotion:
        """Return the mirror image of the motion with unchanged joint names, for files that show a mirrored scene.

        Mirroring twice gives the same motion.
        """
        sign = mirror_signs(up_axis)
        return replace(
            self,
            rest_offsets=self.rest_offsets * sign,
            root_translation=self.root_translation * sign,
            # Rotations about the axis across the mirror stay, those about axes in its plane change their sign.
            local_unitquat=self.local_unitquat * np.append(-sign, 1.0),
        )

    def with_sides_exchanged(self) -> SourceMotion:
        """Exchange left and right in the joint names, for files that swap only the names."""
        names = self.skeleton.joint_names
        other = dict(zip(names, with_sides_exchanged(names), strict=True))
        ends = frozenset(other[name] for name in self.end_sites)
        return replace(self, skeleton=replace(self.skeleton, joint_names=tuple(other.values())), end_sites=ends)

    @classmethod
    def at_rest(
        cls,
        skeleton: Skeleton,
        rest_offsets: Array,
        *,
        rate_hz: float | None = None,
        metres_per_unit: float | None = None,
        notes: tuple[str, ...] = (),
    ) -> SourceMotion:
        """Return one frame of a rest pose, the root at the origin."""
        return cls(
            skeleton=skeleton,
            rest_offsets=rest_offsets,
            root_translation=np.zeros((1, 3)),
            local_unitquat=identity_unitquat(1, skeleton.num_joints),
            rate_hz=rate_hz,
            metres_per_unit=metres_per_unit,
            notes=notes,
        )

    def to_motion(self, *, metres_per_unit: float, rate_hz: float, up_axis: str = "y") -> Motion:
        """Return the motion in metres, Y up; rest pose and rotations are converted to the new axes.

        Args:
            metres_per_unit: Length of the file's unit, metres.
            rate_hz: True frame rate.
            up_axis: Up axis of the file, as in `UP_AXES`.  The axes are rotated, never mirrored.
        """
        world_from_file = upright_from_file(up_axis)
        check_positive(metres_per_unit, "the length of the file's unit in metres")

        def turned(vectors: Array) -> Array:
            return rotate(np.broadcast_to(world_from_file, (*vectors.shape[:-1], 4)), vectors)

        local = self.local_unitquat
        if up_axis != "y":
            local = multiply(
                np.broadcast_to(world_from_file, local.shape),
                multiply(local, np.broadcast_to(conjugate(world_from_file), local.shape)),
            )
        return Motion(
            skeleton=self.skeleton,
            rest_offsets_m=turned(self.rest_offsets) * metres_per_unit,
            root_translation_m=turned(self.root_translation) * metres_per_unit,
            local_unitquat=local,
            rate_hz=rate_hz,
        )


def mirror_signs(up_axis: str) -> Array:
    """Return the signs (3,) of the coordinates of a file in a mirror across x, or across z if x points up."""
    upright_from_file(up_axis)
    return np.array([1.0, 1.0, -1.0] if up_axis.endswith("x") else [-1.0, 1.0, 1.0])


def upright_from_file(up_axis: str) -> Array:
    """Return the rotation (4,) from the axes of a file with this up axis to Y up."""
    if up_axis not in UP_AXES:
        raise InputError(f"the up axis is '{up_axis}'; allowed: {', '.join(UP_AXES)}")
    return unitquat_from_rotvec(np.array(UP_AXES[up_axis]))
