"""Plausibility, plain: joint limits over arrays of poses, the oracle of the compiled walks over one pose at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat, swing_between, unitquat_from_rotvec
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES, NUM_ANGLES, SLACK_RAD, TINY
from pasdedeux.skeletons import PAIR17

Array = npt.NDArray[np.float64]

_JOINT = {name: index for index, name in enumerate(PAIR17.joint_names)}
_INDEX = {(angle.joint, angle.angle): index for index, angle in enumerate(ANGLES)}


def _subtree(joint: str) -> list[int]:
    joints = [_JOINT[joint]]
    for index in joints:
        joints.extend(PAIR17.children(index))
    return joints


_ARMS = {side: _subtree(f"{side}_shoulder") for side in ("left", "right")}
_LEGS = {side: _subtree(f"{side}_hip") for side in ("left", "right")}
_HEAD = _subtree("neck")
_UPPER = _subtree("chest")


def plain_angles(poses: Array) -> tuple[Array, Array]:
    """Return angles and slack (pose, 29), radians, of poses (pose, 17, 3)."""
    posed = Posed(poses.copy(), None)
    posed.walk()
    return posed.angles, posed.slack


def plain_invalid(limits: JointLimits, poses: Array) -> npt.NDArray[np.bool_]:
    angles, slack = plain_angles(poses)
    return excess(limits, slice(None), angles, slack) != 0


def plain_nearest_valid(limits: JointLimits, poses: Array) -> Array:
    posed = Posed(poses.copy(), limits)
    posed.walk()
    return np.where(plain_invalid(limits, poses).any(axis=1)[:, None, None], posed.points, poses)


def excess(limits: JointLimits, index: int | slice, angle: Array, slack: Array | float) -> Array:
    """Return how far angles lie beyond their nearest limit, round the circle, signed; 0 inside."""
    low, high = limits.lower_rad[index] - slack, limits.upper_rad[index] + slack
    above, below = _wrap(angle - high), _wrap(angle - low)
    is_inside = ((angle >= low - TINY) & (angle <= high + TINY)) | (high - low >= 2 * np.pi)
    return np.where(is_inside, 0.0, np.where(np.abs(above) < np.abs(below), above, below))


def _wrap(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def _carry(start: Array, end: Array, vector: Array) -> Array:
    """Carry vectors along the shortest turn from unit `start` to unit `end`."""
    total = start + end
    factor = _dot(total, vector) / np.maximum(1.0 + _dot(start, end), TINY)
    return np.asarray(vector - factor[:, None] * total + 2.0 * _dot(start, vector)[:, None] * end)


class Posed:
    """One walk over the joints, root outward; measures angles and, given limits, moves bad ones to the limit."""

    def __init__(self, points: Array, limits: JointLimits | None) -> None:
        self.points = points
        self.limits = limits
        self.angles = np.zeros((len(points), NUM_ANGLES))
        self.slack = np.zeros((len(points), NUM_ANGLES))

    def walk(self) -> None:
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
        return -excess(self.limits, index, value, slack)

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
        max_b = np.sin(self.limits.upper_rad[_INDEX[joint, "extension"]])
        max_m = np.sin(self.limits.upper_rad[_INDEX[joint, "crossing"]])
        side_of = np.where(rest < 0, -1.0, 1.0)
        # Behind: to the edge of the first cap; then across: to the edge of the second, staying out of the first.
        grown = np.sqrt((1.0 - max_b**2) / np.maximum(m**2 + rest**2, TINY))
        is_behind = change_b != 0
        new_b, new_m = np.where(is_behind, max_b, b), np.where(is_behind, m * grown, m)
        new_rest = np.where(is_behind, rest * grown, rest)
        is_across = new_m > max_m + TINY
        grown = np.sqrt((1.0 - max_m**2) / np.maximum(new_b**2 + new_rest**2, TINY))
        new_b = np.where(is_across, np.minimum(new_b * grown, min(max_b, np.sqrt(1.0 - max_m**2))), new_b)
        new_m = np.where(is_across, max_m, new_m)
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
