"""A dancer: one person posed over time, trunk and feet first, then hands, with explicit rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.curves import soft_minimum
from pasdedeux.choreography.geometry import SIDES, STRETCH, Part, columns, facing, reach, turn
from pasdedeux.choreography.steps import FootPath
from pasdedeux.kinematics import Motion, local_from_world
from pasdedeux.kinematics.rotations import (
    conjugate,
    continuous_signs,
    identity_unitquat,
    multiply,
    normalise,
    rotate,
    unitquat_from_rotmat,
    unitquat_from_rotvec,
)
from pasdedeux.skeletons import BODY22

Angles = tuple[Part, Part, Part]
_ELEVATION, _PROTRACTION = 0.20, 0.28
"""Rotation of the shoulder girdle with the arm, radians per unit of the arm's direction (about a third of the
humerus up to the horizontal: Inman, Saunders and Abbott 1944)."""
_PELVIS_SOFTNESS_M = 0.010


class DancerFrames:
    """World positions (frame, 22, 3) and rotations (frame, 22, 4) of one person, filled in step by step.

    A new figure has trunk and legs, and its arms hang.  Then comes `reach_hand` for both arms, then `motion`.

    Args:
        body: Size and girth.
        feet: Left foot, right foot.
        floor_m: Pelvis, world X and Z (frame, 2).
        height_m: Wanted height of the pelvis (frame,); the legs may pull it lower.
        pelvis: Its yaw to the left, pitch forward and roll to the right, radians, each (frame,) or constant.
        spine: Rotation vector of the chest against the pelvis, likewise: forward bend, twist to the left, bend to the
            right; shared by three joints.
        head: Rotation vector of the head against the chest; shared by neck and head.
    """

    def __init__(
        self,
        body: Physique,
        feet: tuple[FootPath, FootPath],
        *,
        floor_m: Array,
        height_m: Array,
        pelvis: Angles,
        spine: Angles,
        head: Angles,
    ) -> None:
        self.body, self.feet = body, feet
        self.positions_m = np.zeros((len(floor_m), BODY22.num_joints, 3))
        self.unitquat = identity_unitquat(len(floor_m), BODY22.num_joints)
        self.unitquat[:, 0] = turn(*pelvis)
        height = soft_minimum([height_m, *self._highest_pelvis(floor_m)], _PELVIS_SOFTNESS_M)
        self.positions_m[:, 0] = columns(floor_m[:, 0], height, floor_m[:, 1])
        third, half = (unitquat_from_rotvec(columns(*angles) / share) for angles, share in ((spine, 3.0), (head, 2.0)))
        for name, local in {"spine1": third, "spine2": third, "spine3": third, "neck": half, "head": half}.items():
            joint = BODY22.index(name)
            self._follow(joint, multiply(self.unitquat[:, BODY22.parents[joint]], local))
        for side, foot in zip(SIDES, feet, strict=True):
            self._place_leg(side, foot)
            shoulder = self.on_bone(f"{side}_shoulder", 1.0)
            down = self.chest_vector(0.0, -0.9 * body.length_m("left_elbow") - body.length_m("left_wrist"), 0.0)
            self.reach_hand(side, shoulder + down, self.chest_vector(0.0, 0.0, -1.0))

    def joint(self, joint_name: str) -> Array:
        """Return a joint's world positions (frame, 3)."""
        return np.asarray(self.positions_m[:, BODY22.index(joint_name)])

    def on_bone(self, bone_name: str, fraction: float, offset_m: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return a point (frame, 3) that moves with a bone: at a share of its length, with an offset in its rest axes.

        The bone is named by its end; it moves with the joint where it begins.  Left, up and forward of the rest pose
        are the axes of the offset.
        """
        child = BODY22.index(bone_name)
        parent = BODY22.parents[child]
        local = self.body.rest_offsets_m[child] * fraction + np.asarray(offset_m, dtype=np.float64)
        carried = rotate(self.unitquat[:, parent], local)
        return np.asarray(self.positions_m[:, parent] + carried)

    def round_bone(self, bone_name: str, fraction: float, radius_m: float, angle_rad: float) -> Array:
        """Return a point (frame, 3) beside an upright bone, at an angle from its front over its left."""
        offset = (radius_m * float(np.sin(angle_rad)), 0.0, radius_m * float(np.cos(angle_rad)))
        return self.on_bone(bone_name, fraction, offset)

    def chest_vector(self, left: Part, up: Part, forward: Part) -> Array:
        """Return the world vector (frame, 3) of a direction in the chest's axes."""
        chest = self.unitquat[:, BODY22.index("spine3")]
        return rotate(chest, columns(left, up, forward))

    def reach_hand(self, side: str, target_m: Array, elbow_pole: Array, *, palm: Array | None = None) -> None:
        """Move a wrist to its target (frame, 3).

        Args:
            side: left or right.
            target_m: Wanted wrist (frame, 3).
            elbow_pole: Direction of the elbow (frame, 3), world.
            palm: Direction of the palm, (frame, 3) or (3,), world; the forearm turns at most 85 degrees either way.
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
        local = unitquat_from_rotvec(columns(0.0, forward, lift))
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
        local = local_from_world(BODY22, self.unitquat)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return Motion(
            skeleton=BODY22,
            rest_offsets_m=self.body.rest_offsets_m,
            root_translation_m=self.positions_m[:, BODY22.root].copy(),
            local_unitquat=continuous_signs(local),
            rate_hz=rate_hz,
        )

    def _highest_pelvis(self, floor_m: Array) -> list[Array]:
        """Return the greatest height of the pelvis that either leg allows (frame,)."""
        longest = STRETCH * (self.body.length_m("left_knee") + self.body.length_m("left_ankle"))
        highest = []
        for side, foot in zip(SIDES, self.feet, strict=True):
            hip = rotate(self.unitquat[:, 0], self.body.rest_offsets_m[BODY22.index(f"{side}_hip")])
            away = ((floor_m + hip[:, [0, 2]] - foot.ankle_m[:, [0, 2]]) ** 2).sum(axis=1)
            highest.append(foot.ankle_m[:, 1] - hip[:, 1] + np.sqrt(np.maximum(longest**2 - away, 0.01)))
        return highest

    def _place_leg(self, side: str, foot: FootPath) -> None:
        hip, knee, ankle, toe = BODY22.indices([f"{side}_{part}" for part in ("hip", "knee", "ankle", "toe")])
        self._follow(hip, self.unitquat[:, 0])
        sign = SIDES[side]
        ahead = rotate(self.unitquat[:, 0], np.array([0.12 * sign, 0.0, 1.0]))
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
        carried = rotate(self.unitquat[:, parent], self.body.rest_offsets_m[joint])
        self.positions_m[:, joint] = self.positions_m[:, parent] + carried
        self.unitquat[:, joint] = unitquat

    def _pronation(self, elbow: int, palm: Array | None) -> Array:
        """Return the turn about the forearm (frame, 4) that brings the palm, down at rest, towards a direction."""
        angle = np.zeros(len(self.positions_m))
        if palm is not None:
            seen = rotate(conjugate(self.unitquat[:, elbow]), normalise(palm))
            # Half-angle form: no jump if the palm would have to turn by a half circle; 1.3: at most 85 degrees.
            angle = 1.3 * np.arctan2(-seen[:, 2], 1.1 - seen[:, 1])
        return unitquat_from_rotvec(columns(angle, 0.0, 0.0))


def _from_axes(x: Array, y: Array, z: Array) -> Array:
    return unitquat_from_rotmat(np.stack([x, y, z], axis=-1))
