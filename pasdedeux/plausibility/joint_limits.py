"""Joint limits: the angles of a pose that are out of range, and the nearest pose with all angles in range.

The angles are those that the positions of pair17 determine.  The pelvis frame has y from pelvis to spine, x towards the
left hip, z forward; the chest frame y from spine to chest, x towards the left shoulder.

- `elevation`: of the hip or shoulder bone above the plane square to the frame's y.
- `hip_spread`, `shoulder_spread`: from the left bone around the back to the right one, about y; a line has 180 degrees.
- `flexion` and `lateral` of spine, neck and head: forward, and to the left, against the bone below.
- `torsion`: yaw of the shoulders against the hips, to the left.
- shoulder `extension` and `crossing`: elevation of the upper arm backwards, and towards the other side of the body.
- hip `flexion` and `abduction`: of the thigh, forward and outward, from straight down.
- `rotation` of shoulder and hip: outward turn of the forearm or shank about the bone above, against a reference that is
  carried along without twist from the arm held sideways (forearm forward) or the thigh hanging (shank backward).
- elbow and knee `flexion`: 0 when straight.  Bending a hinge the wrong way shows as rotation out of range.

Rotation and flexion of nearly straight limbs are badly determined.  Their ranges widen by `SLACK_RAD` over the sine of
the bend, so that results are continuous.

Compiled loops (`joint_limits_kernel`) process one pose at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits_kernel import measure_poses, move_poses
from pasdedeux.plausibility.ranges import ANGLE_INDEX, ANGLES, MARGIN_DEG, NUM_ANGLES, SLACK_RAD, TINY
from pasdedeux.skeletons import PAIR17

MAX_INVALID_ANGLES = 8
"""A pair with more invalid angles than this is impossible (Yin et al. 2018, section 4.1)."""
_LEFT_OUT_PERCENT = 0.5
"""Percentage of captured angles at each end for which ranges are not widened."""

_MIRROR = [ANGLE_INDEX[PAIR17.joint_names[PAIR17.mirror[PAIR17.index(angle.joint)]], angle.angle] for angle in ANGLES]


@dataclass(frozen=True)
class NearestValid:
    """Valid poses near given ones.

    Args:
        positions: Valid poses with the same root and bone lengths, (*batch, joint=17, 3), metres.
        num_invalid: Angles of the given poses that were out of range, (*batch,).
        squared_distance_m2: Sum over the joints of the squared distance moved, (*batch,): lift eq. 2.
    """

    positions: Array
    num_invalid: Integers
    squared_distance_m2: Array


@dataclass(frozen=True)
class JointLimits:
    """The allowed range of every joint angle of pair17, radians.

    Args:
        lower_rad: Smallest valid angles, (29,), in the order of `ranges.ANGLES`.
        upper_rad: Greatest valid angles, (29,).
        source: Source of each range, 29 texts.
    """

    lower_rad: Array
    upper_rad: Array
    source: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check shapes and that no range is empty."""
        shape = (NUM_ANGLES,)
        if self.lower_rad.shape != shape or self.upper_rad.shape != shape or len(self.source) != NUM_ANGLES:
            raise InputError(f"joint limits: {NUM_ANGLES} ranges are needed, found {self.lower_rad.shape}")
        is_bad = ~(self.lower_rad < self.upper_rad)
        if is_bad.any():
            angle = ANGLES[int(np.argmax(is_bad))]
            raise InputError(f"joint limits: the range of {angle.joint} {angle.angle} is empty")

    @classmethod
    def published(cls) -> JointLimits:
        """Return the published table with its margin."""
        return cls(
            lower_rad=np.deg2rad([angle.lower_deg - MARGIN_DEG for angle in ANGLES]),
            upper_rad=np.deg2rad([angle.upper_deg + MARGIN_DEG for angle in ANGLES]),
            source=tuple(angle.source for angle in ANGLES),
        )

    def widened(self, pair17_m: Array, *, name: str) -> JointLimits:
        """Return limits widened to most angles of captured poses; left and right get the same ranges.

        Args:
            pair17_m: Captured poses, (*batch, joint=17, 3), metres.
            name: Name of the poses, for `source`.
        """
        angles, slack = angles_and_slack(as_poses(pair17_m))
        if len(angles) == 0:
            return self
        lower, upper, source = self.lower_rad.copy(), self.upper_rad.copy(), list(self.source)
        for index, mirrored in enumerate(_MIRROR):
            pair = [index, mirrored]
            seen = angles[:, pair][slack[:, pair] < 2 * SLACK_RAD]
            if len(seen) == 0:
                continue
            low, high = np.percentile(seen, [_LEFT_OUT_PERCENT, 100.0 - _LEFT_OUT_PERCENT])
            if low < lower[index] or high > upper[index]:
                lower[index], upper[index] = min(lower[index], low), max(upper[index], high)
                source[index] = f"{self.source[index]} + {name}"
        return JointLimits(lower_rad=lower, upper_rad=upper, source=tuple(source))

    def num_invalid(self, pair17_m: Array) -> Integers:
        """Count the angles out of range of poses (*batch, joint=17, 3), (*batch,)."""
        return np.asarray(self.invalid_angles(pair17_m).sum(axis=-1))

    def is_valid(self, pair17_m: Array) -> Flags:
        """Tell which poses (*batch, joint=17, 3) have every angle in range, (*batch,)."""
        return np.asarray(self.num_invalid(pair17_m) == 0)

    def invalid_angles(self, pair17_m: Array) -> Flags:
        """Tell which angles (*batch, 29) of poses (*batch, joint=17, 3) are out of range."""
        angles, slack = angles_and_slack(pair17_m)
        low, high = self.lower_rad - slack, self.upper_rad + slack
        is_within = (low - TINY <= angles) & (angles <= high + TINY)
        return np.asarray(~is_within & (high - low < 2.0 * np.pi))

    def nearest_valid(self, pair17_m: Array) -> NearestValid:
        """Return valid poses near poses (*batch, joint=17, 3): move each bad angle to its nearest limit, root outward.

        Bone lengths and the root are kept; all bones after a moved bone move with it.  The result is nearest joint by
        joint; its distance is an upper bound on that to the nearest pose overall.
        """
        shape = np.shape(pair17_m)
        valid, count, squared = move_poses(as_poses(pair17_m), self.ranges_rad)
        return NearestValid(valid.reshape(shape), count.reshape(shape[:-2]), squared.reshape(shape[:-2]))

    @cached_property
    def ranges_rad(self) -> Array:
        """Smallest and greatest valid angles, (2, 29), for compiled loops."""
        return np.stack([self.lower_rad, self.upper_rad])


def as_poses(pair17_m: Array) -> Array:
    """Return poses (*batch, joint=17, 3) for compiled loops, (n, 17, 3)."""
    return np.ascontiguousarray(pair17_m, dtype=np.float64).reshape(-1, PAIR17.num_joints, 3)


def angles_and_slack(pair17_m: Array) -> tuple[Array, Array]:
    """Return the angles and the slack of their ranges, both (*batch, 29), radians, of poses (*batch, joint=17, 3).

    An angle that positions do not determine (a straight or empty bone) is 0.
    """
    measured = measure_poses(as_poses(pair17_m))
    shape = (*np.shape(pair17_m)[:-2], NUM_ANGLES)
    return measured[:, 0].reshape(shape), measured[:, 1].reshape(shape)
