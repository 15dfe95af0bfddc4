"""Joint limits: which angles of a pose are out of range, and the nearest pose whose angles all are in range.

The angles are those that the positions of pair17 determine.  The pelvis frame has y from pelvis to spine, x towards the
left hip, z forward; the chest frame y from spine to chest, x towards the left shoulder.

- `elevation`: of the hip or shoulder bone above the plane square to the frame's y.
- `hip_spread`, `shoulder_spread`: from the left bone round the back to the right one, about y; 180 degrees is a line.
- `flexion` and `lateral` of spine, neck and head: forward, and to the left, against the bone below.
- `torsion`: yaw of the shoulders against the hips, to the left.
- shoulder `extension` and `crossing`: elevation of the upper arm backwards, and towards the other side of the body.
- hip `flexion` and `abduction`: of the thigh, forward and outward, from straight down.
- `rotation` of shoulder and hip: outward turn of the forearm or shank about the bone above, against a reference that is
  carried along without twist from the arm held sideways (forearm forward) or the thigh hanging (shank backward).
- elbow and knee `flexion`: 0 when straight.  Bending a hinge the wrong way shows as rotation out of range.

Rotation and flexion of nearly straight limbs are badly determined; their ranges widen by `SLACK_RAD` over the sine that
says how well they are determined, so that nothing jumps.

This file is the plain form over batches; `joint_limits_kernel` has the same for one pose at a time, compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import (
    normalise,
    rotmat_from_unitquat,
    swing_between,
    unitquat_from_rotvec,
)
from pasdedeux.plausibility.ranges import ANGLES, MARGIN_DEG
from pasdedeux.skeletons import PAIR17

__all__ = ["MOST_INVALID_ANGLES", "SLACK_RAD", "JointLimits", "NearestValid", "joint_angles"]

Array = npt.NDArray[np.float64]

SLACK_RAD = 0.1
"""Uncertainty of a direction in captured data, radians (1-2 cm at the end of a limb bone)."""

MOST_INVALID_ANGLES = 8
"""A person with more invalid angles than this is impossible (Yin et al. 2018, section 4.1)."""

NUM_ANGLES = len(ANGLES)
TINY = 1e-9


@dataclass(frozen=True)
class NearestValid:
    """Valid poses near given ones.

    Args:
        positions: Valid poses with the same root and bone lengths, (*batch, joint=17, 3), metres.
        num_invalid: Angles of the given poses that were out of range, (*batch,).
        squared_distance_m2: Sum over the joints of the squared distance moved, (*batch,): lift eq. 2.
    """

    positions: Array
    num_invalid: npt.NDArray[np.int64]
    squared_distance_m2: Array


@dataclass(frozen=True)
class JointLimits:
    """The allowed range of every joint angle of pair17, radians.

    Args:
        lower_rad: Least valid angles, (29,), in the order of `ranges.ANGLES`.
        upper_rad: Greatest valid angles, (29,).
        source: Where each range came from, 29 texts.

    Raises:
        InputError: A shape is wrong, or a range is empty or not finite.
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

    def widened(self, pair17_m: Array, *, name: str, percentile: float = 0.5) -> JointLimits:
        """Return limits that also hold the middle of the angles seen in capture; left and right get the same ranges.

        Args:
            pair17_m: Captured poses, (*batch, joint=17, 3), metres.
            name: What they are, for `source`.
            percentile: Share of the observed angles left out at each end, percent.
        """
        angles, slack = measure(np.asarray(pair17_m, dtype=np.float64).reshape(-1, PAIR17.num_joints, 3))
        if len(angles) == 0:
            return self
        lower, upper, source = self.lower_rad.copy(), self.upper_rad.copy(), list(self.source)
        for index, mirrored in enumerate(_MIRROR):
            pair = [index, mirrored]
            seen = angles[:, pair][slack[:, pair] < 2 * SLACK_RAD]
            if len(seen) == 0:
                continue
            low, high = np.percentile(seen, [percentile, 100.0 - percentile])
            if low < lower[index] or high > upper[index]:
                lower[index], upper[index] = min(lower[index], low), max(upper[index], high)
                source[index] = f"{self.source[index]} + {name}"
        return JointLimits(lower_rad=lower, upper_rad=upper, source=tuple(source))

    def num_invalid(self, pair17_m: Array) -> npt.NDArray[np.int64]:
        """Count the angles out of range of poses (*batch, joint=17, 3); gives (*batch,)."""
        angles, slack = measure(pair17_m)
        return np.asarray((self._excess(angles, slack) != 0).sum(axis=-1))

    def is_valid(self, pair17_m: Array) -> npt.NDArray[np.bool_]:
        """Tell which poses (*batch, joint=17, 3) have every angle in range."""
        return np.asarray(self.num_invalid(pair17_m) == 0)

    def invalid_angles(self, pair17_m: Array) -> npt.NDArray[np.bool_]:
        """Tell which angles (*batch, 29) are out of range."""
        return np.asarray(self._excess(*measure(pair17_m)) != 0)

    def nearest_valid(self, pair17_m: Array) -> NearestValid:
        """Return valid poses near poses (*batch, joint=17, 3): each bad angle moves to its nearest limit, root outward.

        Bone lengths and the root are kept; what hangs on a moved bone moves with it.  This is the nearest pose joint by
        joint and an upper bound of the distance to the nearest pose overall.
        """
        given = np.asarray(pair17_m, dtype=np.float64)
        posed = _Posed(given.reshape(-1, PAIR17.num_joints, 3).copy(), self)
        posed.settle()
        num_invalid = self.num_invalid(given)
        positions = np.where((num_invalid == 0)[..., None, None], given, posed.points.reshape(given.shape))
        return NearestValid(
            positions=positions,
            num_invalid=num_invalid,
            squared_distance_m2=np.asarray(((positions - given) ** 2).sum(axis=(-1, -2))),
        )

    def _excess(self, angles: Array, slack: Array) -> Array:
        return self.excess(slice(None), angles, slack)

    def excess(self, index: int | slice, angle: Array, slack: Array | float) -> Array:
        """Return how far angles lie beyond their nearest limit, round the circle, signed; 0 inside."""
        low = self.lower_rad[index] - slack
        high = self.upper_rad[index] + slack
        above, below = _wrap(angle - high), _wrap(angle - low)
        is_inside = ((angle >= low - TINY) & (angle <= high + TINY)) | (high - low >= 2 * np.pi)
        return np.where(is_inside, 0.0, np.where(np.abs(above) < np.abs(below), above, below))


def joint_angles(pair17_m: Array) -> Array:
    """Return the angles (*batch, 29) in radians of poses (*batch, joint=17, 3), in the order of `ranges.ANGLES`.

    An angle that positions do not determine (a straight or empty bone) is 0.
    """
    return measure(pair17_m)[0]


_JOINT = {name: index for index, name in enumerate(PAIR17.joint_names)}
_INDEX = {(angle.joint, angle.angle): index for index, angle in enumerate(ANGLES)}


def _mirrored(joint: str) -> str:
    return PAIR17.joint_names[PAIR17.mirror[_JOINT[joint]]]


_MIRROR = [_INDEX[_mirrored(angle.joint), angle.angle] for angle in ANGLES]


def _subtree(joint: str) -> list[int]:
    found = [_JOINT[joint]]
    for index in found:
        found.extend(PAIR17.children(index))
    return found


_ARMS = {side: _subtree(f"{side}_shoulder") for side in ("left", "right")}
_LEGS = {side: _subtree(f"{side}_hip") for side in ("left", "right")}
_HEAD = _subtree("neck")
_UPPER = _subtree("chest")


def measure(pair17_m: Array) -> tuple[Array, Array]:
    """Return the angles and the slack of their ranges, both (*batch, 29), radians."""
    given = np.asarray(pair17_m, dtype=np.float64)
    posed = _Posed(given.reshape(-1, PAIR17.num_joints, 3), None)
    posed.settle()
    shape = (*given.shape[:-2], NUM_ANGLES)
    return posed.angles.reshape(shape), posed.slack.reshape(shape)


def _wrap(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def _carry(start: Array, end: Array, vector: Array) -> Array:
    """Carry vectors along the shortest turn from unit `start` to unit `end`."""
    total = start + end
    factor = _dot(total, vector) / np.maximum(1.0 + _dot(start, end), TINY)
    return np.asarray(vector - factor[:, None] * total + 2.0 * _dot(start, vector)[:, None] * end)


class _Posed:
    """One walk over the joints, root outward; measures angles and, given limits, moves bad ones to the limit."""

    def __init__(self, points: Array, limits: JointLimits | None) -> None:
        self.points = points
        self.limits = limits
        self.angles = np.zeros((len(points), NUM_ANGLES))
        self.slack = np.zeros((len(points), NUM_ANGLES))

    def settle(self) -> None:
        """Walk over all joints; bones that define a frame come before those measured in it."""
        up_pelvis = self.bone("pelvis", "spine")
        self.girdle("hip", "pelvis", up_pelvis, _LEGS)
        x, y, z = self.frame("hip", up_pelvis)
        self.swing("spine", "chest", _UPPER, up=y, left=x, front=z, lateral="lateral")
        up_chest = self.bone("spine", "chest")
        self.girdle("shoulder", "chest", up_chest, _ARMS)
        self.torsion(x, y, up_chest)
        chest_x, chest_y, chest_z = self.frame("shoulder", up_chest)
        self.swing("chest", "neck", _HEAD, up=chest_y, left=chest_x, front=chest_z, lateral="lateral")
        up_neck = self.bone("chest", "neck")
        neck_x = normalise(chest_x - _dot(chest_x, up_neck)[:, None] * up_neck)
        self.swing(
            "neck",
            "head",
            [_JOINT["head"]],
            up=up_neck,
            left=neck_x,
            front=np.cross(neck_x, up_neck),
            lateral="lateral",
        )
        for side, sign in (("left", 1.0), ("right", -1.0)):
            outward = sign * chest_x
            self.arm(side, back=-chest_z, across=-outward)
            self.hinge(
                f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", rest=outward, bend=chest_z, outward=chest_y
            )
            outward = sign * x
            knee, ankle, hip = f"{side}_knee", f"{side}_ankle", f"{side}_hip"
            self.swing(hip, knee, [_JOINT[knee], _JOINT[ankle]], up=-y, left=outward, front=z, lateral="abduction")
            self.hinge(hip, knee, ankle, rest=-y, bend=-z, outward=-outward)

    def bone(self, start: str, end: str) -> Array:
        return normalise(self.points[:, _JOINT[end]] - self.points[:, _JOINT[start]])

    def frame(self, pair: str, up: Array) -> tuple[Array, Array, Array]:
        across = self.points[:, _JOINT[f"left_{pair}"]] - self.points[:, _JOINT[f"right_{pair}"]]
        x = normalise(across - _dot(across, up)[:, None] * up)
        return x, up, np.cross(x, up)

    def clamp(self, joint: str, angle: str, value: Array, slack: Array | float = 0.0) -> Array:
        """Keep an angle and its slack, and give how far it must move to be in range (0 without limits)."""
        index = _INDEX[joint, angle]
        self.angles[:, index] = value
        self.slack[:, index] = slack
        if self.limits is None:
            return np.zeros(len(value))
        return -self.limits.excess(index, value, slack)

    def turn(self, joints: Sequence[int], pivot: str, rotmat: Array) -> None:
        centre = self.points[:, _JOINT[pivot], None].copy()
        self.points[:, joints] = np.einsum("nij,nkj->nki", rotmat, self.points[:, joints] - centre) + centre

    def turn_about(self, joints: Sequence[int], pivot: str, axis: Array, angle: Array) -> None:
        if angle.any():
            self.turn(joints, pivot, rotmat_from_unitquat(unitquat_from_rotvec(axis * angle[:, None])))

    def turn_to(self, joints: Sequence[int], pivot: str, before: Array, after: Array, is_moved: npt.NDArray) -> None:
        if is_moved.any():
            after = np.where(is_moved[:, None], after, before)
            self.turn(joints, pivot, rotmat_from_unitquat(swing_between(before, after)))

    def girdle(self, pair: str, centre: str, up: Array, limbs: dict[str, list[int]]) -> None:
        """Hips on the pelvis or shoulders on the chest: elevations, then the spread about `up`."""
        for side in ("left", "right"):
            direction = self.bone(centre, f"{side}_{pair}")
            elevation = np.arcsin(np.clip(_dot(direction, up), -1.0, 1.0))
            change = self.clamp(f"{side}_{pair}", "elevation", elevation)
            level = normalise(direction - _dot(direction, up)[:, None] * up)
            target = elevation + change
            after = np.cos(target)[:, None] * level + np.sin(target)[:, None] * up
            self.turn_to(limbs[side], centre, direction, after, change != 0)
        left, right = (self.bone(centre, f"{side}_{pair}") for side in ("left", "right"))
        left = left - _dot(left, up)[:, None] * up
        right = right - _dot(right, up)[:, None] * up
        spread = np.arctan2(_dot(np.cross(left, right), up), _dot(left, right)) % (2 * np.pi)
        change = self.clamp(centre, f"{pair}_spread", spread)
        self.turn_about(limbs["left"], centre, up, -0.5 * change)
        self.turn_about(limbs["right"], centre, up, 0.5 * change)

    def swing(
        self, joint: str, end: str, joints: Sequence[int], *, up: Array, left: Array, front: Array, lateral: str
    ) -> None:
        """A bone's flexion (longitude about `left`, from `up` to `front`) and lateral angle (latitude to `left`)."""
        direction = self.bone(joint, end)
        sideways = np.arcsin(np.clip(_dot(direction, left), -1.0, 1.0))
        change_sideways = self.clamp(joint, lateral, sideways)
        sideways = sideways + change_sideways
        flexion = np.arctan2(_dot(direction, front), _dot(direction, up))
        change_flexion = self.clamp(
            joint, "flexion", flexion, SLACK_RAD * (1.0 / np.maximum(np.cos(sideways), TINY) - 1.0)
        )
        flexion = flexion + change_flexion
        level = np.cos(flexion)[:, None] * up + np.sin(flexion)[:, None] * front
        after = np.cos(sideways)[:, None] * level + np.sin(sideways)[:, None] * left
        self.turn_to(joints, joint, direction, after, (change_sideways != 0) | (change_flexion != 0))

    def torsion(self, hips_x: Array, up_pelvis: Array, up_chest: Array) -> None:
        shoulders_x, _, _ = self.frame("shoulder", up_chest)
        carried = _carry(up_pelvis, up_chest, hips_x)
        angle = np.arctan2(_dot(np.cross(carried, shoulders_x), up_chest), _dot(carried, shoulders_x))
        change = self.clamp("spine", "torsion", angle)
        self.turn_about([*_HEAD, *_ARMS["left"], *_ARMS["right"]], "chest", up_chest, change)

    def arm(self, side: str, *, back: Array, across: Array) -> None:
        """The upper arm: two caps of the sphere are out of reach, behind the body and across it."""
        joint, elbow, wrist = f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist"
        direction = self.bone(joint, elbow)
        b, m = _dot(direction, back), _dot(direction, across)
        up = np.cross(back, across)
        rest = _dot(direction, up)
        change_b = self.clamp(joint, "extension", np.arcsin(np.clip(b, -1.0, 1.0)))
        change_m = self.clamp(joint, "crossing", np.arcsin(np.clip(m, -1.0, 1.0)))
        if self.limits is None:
            return
        most_b = np.sin(self.limits.upper_rad[_INDEX[joint, "extension"]])
        most_m = np.sin(self.limits.upper_rad[_INDEX[joint, "crossing"]])
        side_of = np.where(rest < 0, -1.0, 1.0)
        # Behind: to the edge of the first cap; then across: to the edge of the second, staying out of the first.
        grown = np.sqrt((1.0 - most_b**2) / np.maximum(m**2 + rest**2, TINY))
        is_behind = change_b != 0
        new_b, new_m = np.where(is_behind, most_b, b), np.where(is_behind, m * grown, m)
        new_rest = np.where(is_behind, rest * grown, rest)
        is_across = new_m > most_m + TINY
        grown = np.sqrt((1.0 - most_m**2) / np.maximum(new_b**2 + new_rest**2, TINY))
        new_b = np.where(is_across, np.minimum(new_b * grown, min(most_b, np.sqrt(1.0 - most_m**2))), new_b)
        new_m = np.where(is_across, most_m, new_m)
        new_rest = np.where(is_across, side_of * np.sqrt(np.maximum(1.0 - new_m**2 - new_b**2, 0.0)), new_rest)
        after = new_b[:, None] * back + new_m[:, None] * across + new_rest[:, None] * up
        self.turn_to([_JOINT[elbow], _JOINT[wrist]], joint, direction, after, is_behind | is_across | (change_m != 0))

    def hinge(self, joint: str, middle: str, end: str, *, rest: Array, bend: Array, outward: Array) -> None:
        """Flexion of a hinge, and the rotation of the bone above it that the bent hinge shows."""
        upper, lower = self.bone(joint, middle), self.bone(middle, end)
        along = _dot(upper, lower)
        across = lower - along[:, None] * upper
        sine = np.linalg.norm(across, axis=-1)
        flexion = np.arctan2(sine, along)
        change_flexion = self.clamp(middle, "flexion", flexion)
        certainty = np.where(along > 0, sine, 1.0)
        carried_bend, carried_out = _carry(rest, upper, bend), _carry(rest, upper, outward)
        rotation = np.where(sine > TINY, np.arctan2(_dot(across, carried_out), _dot(across, carried_bend)), 0.0)
        slack = SLACK_RAD / np.maximum(certainty, TINY)
        change = self.clamp(joint, "rotation", rotation, slack)
        bent = flexion + change_flexion
        after = np.cos(bent)[:, None] * upper + np.sin(bent)[:, None] * normalise(across)
        self.turn_to([_JOINT[end]], middle, lower, after, change_flexion != 0)
        # Rotation counts from the bend direction to the outward one; about the bone that is +1 or -1.
        handed = np.where(_dot(np.cross(carried_bend, carried_out), upper) < 0, -1.0, 1.0)
        self.turn_about([_JOINT[end]], middle, upper, handed * change)
