"""A figure: one person posed over time, trunk and feet first, then hands; every rotation is built, none is guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import Numbers, facing, soft_minimum
from pasdedeux.choreography.reach import STRETCH, reach
from pasdedeux.choreography.steps import FootPath
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import (
    conjugate,
    multiply,
    normalise,
    rotate,
    unitquat_from_rotmat,
    unitquat_from_rotvec,
)
from pasdedeux.skeletons import BODY22

SIDES = {"left": 1.0, "right": -1.0}
"""Both sides, and the sign of what points there."""
_ELEVATION, _PROTRACTION = 0.20, 0.28
"""How far the shoulder girdle goes with the arm, radians per unit of the arm's direction (about a third of the
humerus up to the horizontal: Inman, Saunders and Abbott 1944)."""
_PELVIS_SOFTNESS_M = 0.010


@dataclass(frozen=True)
class Trunk:
    """Where the trunk wants to be.

    Args:
        x_m: Pelvis, world X (frame,).
        z_m: Pelvis, world Z (frame,).
        height_m: Wanted height of the pelvis (frame,); the legs may pull it lower.
        unitquat: World rotation of the pelvis (frame, 4).
        spine_rotvec: Rotation of the chest against the pelvis (frame, 3): forward bend, twist to the left, bend to
            the right; shared by three joints.
        head_rotvec: Rotation of the head against the chest (frame, 3); shared by neck and head.
    """

    x_m: Array
    z_m: Array
    height_m: Array
    unitquat: Array
    spine_rotvec: Array
    head_rotvec: Array

    @classmethod
    def at(
        cls, where_m: Array, height_m: Numbers, unitquat: Array, spine: Sequence[Numbers], head: Sequence[Numbers]
    ) -> Self:
        """Return a trunk above (frame, x and z) or (frame, 3); parts of rotation vectors are numbers or (frame,)."""
        x, z = where_m[:, 0], where_m[:, -1]
        parts = [np.stack(np.broadcast_arrays(*parts, x)[:3], axis=-1) for parts in (spine, head)]
        return cls(x, z, np.broadcast_to(height_m, x.shape), unitquat, *parts)


@dataclass
class Figure:
    """World positions (frame, 22, 3) and rotations (frame, 22, 4) of one person, filled in step by step.

    The order is: `Figure(body, trunk, left foot, right foot)`, which places trunk and legs, then `reach_hand` for both
    arms, then `motion`.
    """

    body: Body
    trunk: Trunk
    feet: tuple[FootPath, FootPath]
    positions_m: Array = field(init=False)
    unitquat: Array = field(init=False)

    def __post_init__(self) -> None:
        """Place trunk and legs, and let the arms hang."""
        frames = len(self.trunk.x_m)
        self.positions_m = np.zeros((frames, BODY22.num_joints, 3))
        self.unitquat = np.tile([0.0, 0.0, 0.0, 1.0], (frames, BODY22.num_joints, 1))
        self._place_trunk()
        for side, foot in zip(SIDES, self.feet, strict=True):
            self._place_leg(side, foot)
            shoulder = self.on_bone(f"{side}_shoulder", 1.0)
            down = self.chest_vector(
                0.0, -0.9 * self.body.length_m("left_elbow") - self.body.length_m("left_wrist"), 0.0
            )
            self.reach_hand(side, shoulder + down, self.chest_vector(0.0, 0.0, -1.0))

    def joint(self, joint_name: str) -> Array:
        """Return a joint's world positions (frame, 3)."""
        return np.asarray(self.positions_m[:, BODY22.index(joint_name)])

    def on_bone(
        self, bone_name: str, fraction: float, offset_m: Array | tuple[float, float, float] = (0, 0, 0)
    ) -> Array:
        """Return a point (frame, 3) that is carried by a bone: a share of its length, and an offset in its rest axes.

        The bone is named by its end; it is carried by the joint where it begins.  Left, up and forward of the rest pose
        are the axes of the offset.
        """
        child = BODY22.index(bone_name)
        parent = BODY22.parents[child]
        local = self.body.rest_offsets_m[child] * fraction + np.asarray(offset_m, dtype=np.float64)
        carried = rotate(self.unitquat[:, parent], np.broadcast_to(local, (len(self.positions_m), 3)))
        return np.asarray(self.positions_m[:, parent] + carried)

    def round_bone(self, bone_name: str, fraction: float, radius_m: float, angle_rad: float) -> Array:
        """Return a point (frame, 3) beside an upright bone, at an angle from its front over its left."""
        offset = (radius_m * float(np.sin(angle_rad)), 0.0, radius_m * float(np.cos(angle_rad)))
        return self.on_bone(bone_name, fraction, offset)

    def chest_vector(self, left: Array | float, up: Array | float, forward: Array | float) -> Array:
        """Return the world vector (frame, 3) of a direction in the chest's axes."""
        frames = len(self.positions_m)
        parts = [np.broadcast_to(np.asarray(part, dtype=np.float64), (frames,)) for part in (left, up, forward)]
        return rotate(self.unitquat[:, BODY22.index("spine3")], np.stack(parts, axis=-1))

    def reach_hand(self, side: str, target_m: Array, elbow_pole: Array, *, palm: Array | None = None) -> None:
        """Bring a wrist to its target (frame, 3).

        Args:
            side: left or right.
            target_m: Wanted wrist (frame, 3).
            elbow_pole: Where the elbow points (frame, 3), world.
            palm: Where the palm looks (frame, 3), world; the forearm turns towards it, at most 85 degrees either way.
        """
        sign = SIDES[side]
        chest, collar, shoulder, elbow, wrist = BODY22.indices(
            ["spine3", f"{side}_collar", f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist"]
        )
        upper, lower = self.body.length_m(f"{side}_elbow"), self.body.length_m(f"{side}_wrist")
        self._follow(collar, self.unitquat[:, chest])
        self._follow(shoulder, self.unitquat[:, chest])
        inward = rotate(conjugate(self.unitquat[:, chest]), target_m - self.positions_m[:, shoulder]) / (upper + lower)
        inward = inward / np.sqrt(1.0 + np.sum(inward**2, axis=-1, keepdims=True)) * np.sqrt(2.0)
        lift = sign * _ELEVATION * (1.0 + inward[:, 1])
        forward = -sign * _PROTRACTION * inward[:, 2]
        local = unitquat_from_rotvec(np.stack([0.0 * lift, forward, lift], axis=-1))
        self._follow(collar, multiply(self.unitquat[:, chest], local))
        self._follow(shoulder, self.unitquat[:, collar])
        arm = reach(self.positions_m[:, shoulder], target_m, elbow_pole, upper, lower)
        axis = np.cross(arm.bend, sign * arm.upper)
        self.unitquat[:, shoulder] = _from_axes(sign * arm.upper, axis, arm.bend)
        self.unitquat[:, elbow] = _from_axes(sign * arm.lower, axis, np.cross(sign * arm.lower, axis))
        self.unitquat[:, wrist] = multiply(self.unitquat[:, elbow], self._pronation(elbow, palm))
        self.positions_m[:, elbow], self.positions_m[:, wrist] = arm.middle_m, arm.end_m

    def motion(self, rate_hz: float) -> Motion:
        """Return the motion: local rotations, continuous in sign, and the pelvis as root."""
        local = self.unitquat.copy()
        for parent, child in BODY22.bones:
            local[:, child] = multiply(conjugate(self.unitquat[:, parent]), self.unitquat[:, child])
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        is_flipped = np.sum(local[1:] * local[:-1], axis=-1) < 0
        signs = np.cumprod(np.where(is_flipped, -1.0, 1.0), axis=0)
        local[1:] *= signs[..., None]
        return Motion(
            skeleton=BODY22,
            rest_offsets_m=self.body.rest_offsets_m,
            root_translation_m=self.positions_m[:, BODY22.root].copy(),
            local_unitquat=local,
            rate_hz=rate_hz,
        )

    def _place_trunk(self) -> None:
        trunk = self.trunk
        self.unitquat[:, 0] = trunk.unitquat
        height = soft_minimum([trunk.height_m, *self._highest_pelvis()], _PELVIS_SOFTNESS_M)
        self.positions_m[:, 0] = np.stack([trunk.x_m, height, trunk.z_m], axis=-1)
        third = unitquat_from_rotvec(trunk.spine_rotvec / 3.0)
        half = unitquat_from_rotvec(trunk.head_rotvec / 2.0)
        for name in ("spine1", "spine2", "spine3", "neck", "head"):
            joint = BODY22.index(name)
            local = third if name.startswith("spine") else half
            self._follow(joint, multiply(self.unitquat[:, BODY22.parents[joint]], local))

    def _highest_pelvis(self) -> list[Array]:
        longest = STRETCH * (self.body.length_m("left_knee") + self.body.length_m("left_ankle"))
        highest = []
        for side, foot in zip(SIDES, self.feet, strict=True):
            hip = rotate(self.trunk.unitquat, np.broadcast_to(self._offset(f"{side}_hip"), foot.ankle_m.shape))
            away = (self.trunk.x_m + hip[:, 0] - foot.ankle_m[:, 0]) ** 2
            away = away + (self.trunk.z_m + hip[:, 2] - foot.ankle_m[:, 2]) ** 2
            highest.append(foot.ankle_m[:, 1] - hip[:, 1] + np.sqrt(np.maximum(longest**2 - away, 0.01)))
        return highest

    def _place_leg(self, side: str, foot: FootPath) -> None:
        hip, knee, ankle, toe = BODY22.indices([f"{side}_{part}" for part in ("hip", "knee", "ankle", "toe")])
        self._follow(hip, self.unitquat[:, 0])
        sign = SIDES[side]
        ahead = rotate(self.unitquat[:, 0], np.broadcast_to([0.12 * sign, 0.0, 1.0], foot.ankle_m.shape))
        pole = ahead * [1.0, 0.0, 1.0] + facing(foot.yaw_rad, 0.0, 0.0, 1.0)
        upper, lower = self.body.length_m(f"{side}_knee"), self.body.length_m(f"{side}_ankle")
        leg = reach(self.positions_m[:, hip], foot.ankle_m, pole, upper, lower)
        hinge = np.cross(leg.upper, leg.bend)
        self.unitquat[:, hip] = _from_axes(hinge, -leg.upper, -leg.bend)
        self.unitquat[:, knee] = _from_axes(hinge, -leg.lower, np.cross(hinge, -leg.lower))
        self.positions_m[:, knee], self.positions_m[:, ankle] = leg.middle_m, leg.end_m
        self.unitquat[:, ankle] = foot.unitquat
        self._follow(toe, foot.unitquat)

    def _follow(self, joint: int, unitquat: Array) -> None:
        """Place a joint by its parent's rotation, and give it a world rotation."""
        parent = BODY22.parents[joint]
        offset = np.broadcast_to(self.body.rest_offsets_m[joint], (len(self.positions_m), 3))
        self.positions_m[:, joint] = self.positions_m[:, parent] + rotate(self.unitquat[:, parent], offset)
        self.unitquat[:, joint] = unitquat

    def _offset(self, joint_name: str) -> Array:
        return np.asarray(self.body.rest_offsets_m[BODY22.index(joint_name)])

    def _pronation(self, elbow: int, palm: Array | None) -> Array:
        """Return the turn about the forearm (frame, 4) that brings the palm, down at rest, towards a direction."""
        angle = np.zeros(len(self.positions_m))
        if palm is not None:
            seen = rotate(conjugate(self.unitquat[:, elbow]), normalise(palm))
            # Half-angle form: no jump where the palm would have to turn by a half circle; 1.3: at most 85 degrees.
            angle = 1.3 * np.arctan2(-seen[:, 2], 1.1 - seen[:, 1])
        return unitquat_from_rotvec(np.stack([angle, 0.0 * angle, 0.0 * angle], axis=-1))


def _from_axes(x: Array, y: Array, z: Array) -> Array:
    return unitquat_from_rotmat(np.stack([x, y, z], axis=-1))
