"""A motion as a file gives it: the file's own joints, length unit and up axis."""

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
"""Axes that may point up in a file, each with the rotation vector that turns it to y, as it is inside the project."""

_SAMPLE = 200
"""Frames that guesses are made from."""


@dataclass(frozen=True)
class SourceMotion:
    """One person's motion in a file's own length unit and axes.

    Args:
        skeleton: The file's joints; End Sites are joints named `<parent>_end` that never turn.
        rest_offsets: Offset of each joint from its parent in the parent's frame, (J, 3), file units.
        root_translation: Position of the root, (frame, 3), file units.
        local_unitquat: Local rotations, (frame, J, 4), x, y, z, w.
        end_sites: Names of the joints that are End Sites.
        rate_hz: Frame rate the file states, None where it states none.
        metres_per_unit: Length of the file's unit if the file states it, else None.
        notes: What the reader assumed or changed, a sentence each.
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
        """Return the motion as a mirror shows it, joints under their names: mends a file that swaps left and right.

        Twice mirrored is the same motion.
        """
        sign = mirror_signs(up_axis)
        return replace(
            self,
            rest_offsets=self.rest_offsets * sign,
            root_translation=self.root_translation * sign,
            # A turn about an axis in the mirror goes on about the same axis, one across it turns the other way.
            local_unitquat=self.local_unitquat * np.append(-sign, 1.0),
        )

    def with_sides_exchanged(self) -> SourceMotion:
        """Return the motion with the names of left and right exchanged, for files that swap only the names."""
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
        """Return one frame of a rest pose, its root at the origin."""
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
        """Return the motion in metres, Y up; rest pose and rotations are expressed in the new axes alike.

        Args:
            metres_per_unit: Length of the file's unit, metres.
            rate_hz: True frame rate.
            up_axis: Axis of the file that points up, as in `UP_AXES`.  The axes are turned, never mirrored.
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
    """Return the factors (3,) of the coordinates of a file by which an upright mirror shows it.

    The mirror stands across x, or across z where x points up.
    """
    upright_from_file(up_axis)
    return np.array([1.0, 1.0, -1.0] if up_axis.endswith("x") else [-1.0, 1.0, 1.0])


def upright_from_file(up_axis: str) -> Array:
    """Return the rotation (4,) from the axes of a file, of which this one points up, to Y up."""
    if up_axis not in UP_AXES:
        raise InputError(f"the up axis is '{up_axis}'; allowed: {', '.join(UP_AXES)}")
    return unitquat_from_rotvec(np.array(UP_AXES[up_axis]))
