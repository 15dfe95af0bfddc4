"""A motion: one person's skeleton moving over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError, check_positive
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.kinematics.rotations import identity_unitquat, slerp
from pasdedeux.skeletons import Skeleton


@dataclass(frozen=True)
class Motion:
    """One person's motion on its own skeleton, right-handed, Y up, metres, seconds.

    Args:
        skeleton: The source's own joints, J of them.
        rest_offsets_m: Offset of each joint from its parent at rest, (J, 3); the root's is ignored.
        root_translation_m: World position of the root, (frame, 3).
        local_unitquat: Local rotations, (frame, J, 4), x, y, z, w.
        rate_hz: Frames per second.
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
        check_positive(self.rate_hz, "the frame rate")
        is_bad = ~(
            np.isfinite(self.root_translation_m).all(axis=-1) & np.isfinite(self.local_unitquat).all(axis=(-1, -2))
        )
        if is_bad.any():
            raise InputError(f"frame {int(np.argmax(is_bad))}: a value is not finite")

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.root_translation_m)

    def world(self) -> tuple[Array, Array]:
        """Return world positions (frame, J, 3) and world rotations (frame, J, 4)."""
        return forward_kinematics(self.skeleton, self.rest_offsets_m, self.root_translation_m, self.local_unitquat)

    def rest_positions_m(self) -> Array:
        """Return the rest pose (J, 3) with the root at the origin."""
        still = identity_unitquat(self.skeleton.num_joints)
        return forward_kinematics(self.skeleton, self.rest_offsets_m, np.zeros(3), still)[0]

    def with_joints(self, names: Sequence[str], parents: Sequence[int], offsets_m: Sequence[Array]) -> Motion:
        """Return the motion with additional joints, which never turn, at offsets from existing joints."""
        if not names:
            return self
        known = self.skeleton
        still = identity_unitquat(self.num_frames, len(names))
        return replace(
            self,
            skeleton=Skeleton(known.name, (*known.joint_names, *names), (*known.parents, *parents)),
            rest_offsets_m=np.concatenate([self.rest_offsets_m, offsets_m]),
            local_unitquat=np.concatenate([self.local_unitquat, still], axis=1),
        )

    def first_frames(self, count: int) -> Motion:
        """Return the first frames of the motion."""
        return replace(
            self, root_translation_m=self.root_translation_m[:count], local_unitquat=self.local_unitquat[:count]
        )

    def resample(self, rate_hz: float, *, start_s: float = 0.0) -> Motion:
        """Return the motion at another rate: positions are interpolated linearly, rotations on the short arc.

        Args:
            rate_hz: The new rate.
            start_s: Time of the new first frame, from the present one.
        """
        if (rate_hz == self.rate_hz and not start_s) or self.num_frames < 2:
            return replace(self, rate_hz=rate_hz)
        before, after, share = frames_at_rate(self.num_frames, from_hz=self.rate_hz, to_hz=rate_hz, start_s=start_s)
        share, roots = share[:, None], self.root_translation_m
        return replace(
            self,
            root_translation_m=roots[before] + share * (roots[after] - roots[before]),
            local_unitquat=slerp(
                self.local_unitquat[before],
                self.local_unitquat[after],
                np.broadcast_to(share, (len(share), self.skeleton.num_joints)),
            ),
            rate_hz=rate_hz,
        )


def frames_at_rate(
    num_frames: int, *, from_hz: float, to_hz: float, start_s: float = 0.0
) -> tuple[Integers, Integers, Array]:
    """Return the frames before and after each frame of another rate, from a time on, and the share of the second."""
    first = start_s * from_hz
    count = int(np.floor((num_frames - 1 - first) * to_hz / from_hz + 1e-9)) + 1
    at = first + np.arange(count) * (from_hz / to_hz)
    before = np.minimum(np.floor(at + 1e-9).astype(int), num_frames - 1)
    return before, np.minimum(before + 1, num_frames - 1), np.clip(at - before, 0.0, 1.0)
