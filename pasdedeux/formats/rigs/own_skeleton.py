"""The skeleton of a source file: its mapping to body22, and variants of its motion for other bodies.

body22 is derived from a source's joints by fixed weights, so a variant of body22 determines how the source is scaled
and posed: its offsets are scaled, and its rotations change only where the variant needs it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics import (
    Motion,
    best_rotation,
    bone_directions,
    bone_lengths,
    forward_kinematics,
    local_from_world,
    place_bones,
)
from pasdedeux.kinematics.rotations import (
    conjugate,
    identity_unitquat,
    multiply,
    normalise,
    rotate,
    swing_between,
    unitquat_from_rotmat,
)
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.humanoid import t_pose
from pasdedeux.skeletons.layouts import Layout
from pasdedeux.skeletons.mapping import weighted_points

_HOLD_M = 1e-3
"""If the points of a joint do not fix its rotation, it is held as by points at this distance."""
_HOLD_SCALE = 1e-3
"""Weight, relative to body22, with which bones outside body22 are scaled like the bone before them."""
_HOLD_INNER = 0.1
"""Weight of joints of body22 between joints of the source, relative to those that are joints of the source."""
_END_SHARE = 0.25
"""Length of an added End Site, relative to the bone before it; programs need bones to have a length."""
_SHORTEST_M = 1e-3
"""Shorter joints have no length in programs that draw them."""
_HINGES = {limb[1]: limb[2] for limb in BODY22.limbs}
"""Elbows and knees, each with the wrist or ankle that it moves to its place."""
_HIPS = BODY22.indices(["left_hip", "right_hip"])
_HIP_WEIGHT = 30.0
"""Weight of the hips, relative to pelvis and spine, in the fit of the root: nearly straight legs cannot compensate hips
that are off, while arms are mostly bent."""
_TRUNK = BODY22.indices(["pelvis", "left_hip", "right_hip", "left_shoulder", "right_shoulder", "neck"])


@dataclass(frozen=True)
class BodyMap:
    """Joints of body22 as points of a source's J joints: x_b = sum over i of weight[b, i] x_i + R_i offset_m[b, i].

    Args:
        weight: Weights (22, J); those of a joint sum to 1.
        offset_m: Offsets in the frames of the joints (22, J, 3), metres; zero except for points beside joints.
    """

    weight: Array
    offset_m: Array

    def positions(self, positions_m: Array, world_unitquat: Array) -> Array:
        """Return body22 (*batch, 22, 3) from positions (*batch, J, 3) and world rotations (*batch, J, 4), metres."""
        weighted = weighted_points(self.weight, positions_m)
        for joint, carrier in zip(*np.nonzero(self.offset_m.any(axis=-1)), strict=True):
            offset = np.broadcast_to(self.offset_m[joint, carrier], weighted[..., joint, :].shape)
            weighted[..., joint, :] += rotate(world_unitquat[..., carrier, :], offset)
        return weighted

    def joint_names(self, skeleton: Skeleton) -> list[str]:
        """Return for each joint of body22 the name of the equal source joint; empty if there is none."""
        is_one = (np.count_nonzero(self.weight, axis=1) == 1) & ~self.offset_m.any(axis=(1, 2))
        return [
            skeleton.joint_names[joint] if is_equal else ""
            for is_equal, joint in zip(is_one, self.weight.argmax(axis=1), strict=True)
        ]

    def of(self, motion: Motion) -> Array:
        """Return body22 (frame, 22, 3) of a motion of the source's joints, metres."""
        return self.positions(*motion.world())


def body_map(layout: Layout, skeleton: Skeleton, rest_offsets_m: Array) -> BodyMap:
    """Return the mapping of a layout from a source's joints to body22."""
    table = layout.joint_map(BODY22.name)
    points = {point.name: point for point in layout.points}
    weight = np.zeros((BODY22.num_joints, skeleton.num_joints))
    offset = np.zeros((*weight.shape, 3))
    for row, joint in enumerate(BODY22.joint_names):
        for name, share in table.weights(joint).items():
            point = points.get(name)
            at = skeleton.index(point.joint if point else name)
            weight[row, at] += share
            if point:
                unit = np.linalg.norm(rest_offsets_m[skeleton.index(point.unit_bone)])
                offset[row, at] += share * unit * np.array(point.offset)
    return BodyMap(weight, offset)


@dataclass(frozen=True)
class OwnSkeleton:
    """Motion of a person on the skeleton of the file, with the mapping to body22.

    Args:
        motion: The motion, with rotations relative to the source's rest pose.
        body: The mapping.
    """

    motion: Motion
    body: BodyMap

    @cached_property
    def rest_body22_m(self) -> Array:
        """body22 in the rest pose (22, 3), metres, the root at the origin."""
        still = identity_unitquat(1, self.motion.skeleton.num_joints)
        return self.body.positions(self.motion.rest_positions_m()[None], still)[0]

    def scaled_offsets(self, bone_scale: Array) -> Array:
        """Return rest offsets (J, 3), metres, that scale the bones of body22 by `bone_scale` (22,).

        This is a least-squares fit of a scale for each of the source's bones, in the rest pose.  Distances between
        joints of body22 that are joints of the source are exact if possible; bones outside body22, such as fingers, are
        scaled like the bone before them.  The root's entry of `bone_scale` is not used.
        """
        skeleton, offsets, rest = self.motion.skeleton, self.motion.rest_offsets_m, self.rest_body22_m
        wanted = place_bones(
            BODY22, np.zeros(3), rest - rest[[max(parent, 0) for parent in BODY22.parents]], bone_scale
        )
        places = np.zeros((skeleton.num_joints, skeleton.num_joints, 3))  # of joint i, per scale of bone k
        for joint in skeleton.order[1:]:
            places[joint] = places[skeleton.parents[joint]]
            places[joint, joint] = offsets[joint]
        body = np.einsum("bi,ikx->bxk", self.body.weight, places)
        carried = self.body.offset_m.sum(axis=1) * bone_scale[:, None]
        joints = [joint for _, joint in BODY22.bones]
        above = [self._exact_before(joint) for joint in joints]
        share = np.where(np.isin(joints, list(self._exact)), 1.0, _HOLD_INNER)[:, None]
        rows = share[..., None] * (body[joints] - body[above])
        values = share * (wanted[joints] - wanted[above] - carried[joints] + carried[above])
        # Bones of the source along one bone of body22 are scaled alike if possible, other bones like the one before.
        length = np.linalg.norm(offsets, axis=-1)
        hold = np.zeros((skeleton.num_joints, skeleton.num_joints))
        held = np.zeros(skeleton.num_joints)
        for joint in skeleton.order[1:]:
            hold[joint, joint] = _HOLD_SCALE * max(float(length[joint]), _SHORTEST_M)
            ends = [body_joint for body_joint, (end, _) in self._ends.items() if end == joint] or self._aims[joint]
            before = skeleton.parents[joint]
            while before != skeleton.root and length[before] == 0:
                before = skeleton.parents[before]
            if ends or before == skeleton.root:
                held[joint] = hold[joint, joint] * bone_scale[ends or slice(1, None)].mean()
            else:
                hold[joint, before] = -hold[joint, joint]
        matrix = np.concatenate([rows.reshape(-1, skeleton.num_joints), hold])
        scale = np.linalg.lstsq(matrix, np.concatenate([values.reshape(-1), held]), rcond=None)[0]
        return offsets * scale[:, None]

    def posed(self, body22_m: Array, bone_scale: Array, *, meets_tips: bool = True) -> Motion:
        """Return the motion with scaled bones, posed so that its body22 has positions (frame, 22, 3), metres.

        From the root outwards, every joint that moves joints of body22 is turned from its rotation in the source by the
        shortest rotation that brings them to their targets: a single one in direction, several in the least-squares
        sense (Kabsch).  Elbows and knees adapt so that wrists and ankles reach their targets.  Other joints, such as
        fingers, keep their local rotation.  With the body22 of the source and scales of 1 the result is the source.

        Args:
            body22_m: Target positions of body22 (frame, 22, 3), metres.
            bone_scale: Scale of each bone (22,).
            meets_tips: If false, limbs have the directions of body22, wherever they end.
        """
        source, skeleton = self.motion, self.motion.skeleton
        if body22_m.shape != (source.num_frames, BODY22.num_joints, 3):
            raise InputError(
                f"body22 has the shape {body22_m.shape}; the motion has {counted(source.num_frames, 'frame')}"
            )
        offsets = self.scaled_offsets(bone_scale)
        body = BodyMap(self.body.weight, self.body.offset_m * bone_scale[:, None, None])
        old, old_world = forward_kinematics(skeleton, offsets, source.root_translation_m, source.local_unitquat)
        old_body = body.positions(old, old_world)
        world = np.empty_like(old_world)
        place = np.zeros_like(old)
        turn = np.empty_like(old_world)
        root, pelvis = skeleton.root, BODY22.root
        for joint in skeleton.order:
            parent, aims = skeleton.parents[joint], self._aims[joint]
            if joint == root:
                points = [pelvis, *aims]
                weight = np.where(np.isin(points, _HIPS), _HIP_WEIGHT, 1.0)[:, None]
                middle, to = (
                    np.average(positions_m[:, points], axis=1, weights=weight[:, 0])
                    for positions_m in (old_body, body22_m)
                )
                start, end = old_body[:, points] - middle[:, None], body22_m[:, points] - to[:, None]
                turn[:, joint] = _turn_onto(np.sqrt(weight) * start, np.sqrt(weight) * end)
                place[:, joint] = to - rotate(turn[:, joint], middle - old[:, joint])
            else:
                carried = np.broadcast_to(offsets[joint], place[:, joint].shape)
                place[:, joint] = place[:, parent] + rotate(world[:, parent], carried)
                if not aims or aims == self._aims[parent]:
                    turn[:, joint] = turn[:, parent]
                else:
                    moved = sorted(self._below[joint])
                    fixed = np.setdiff1d(np.arange(skeleton.num_joints), moved)
                    weight = body.weight[aims]
                    start, end = (
                        points[:, aims]
                        - np.einsum("bi,tix->tbx", weight[:, fixed], at[:, fixed])
                        - weight[:, moved].sum(axis=1)[:, None] * at[:, [joint]]
                        for points, at in ((old_body, old), (body22_m, place))
                    )
                    aim, before = aims[0], BODY22.parents[aims[0]]
                    if not meets_tips and len(aims) == 1 and self._ends.get(before) == (joint, False):
                        end = body22_m[:, [aim]] - body22_m[:, [before]]
                    elif meets_tips and len(aims) == 1 and aim in _HINGES:
                        tip = _HINGES[aim]
                        bones = [
                            np.linalg.norm(bone_m, axis=-1)
                            for bone_m in (start[:, 0], old_body[:, tip] - old_body[:, aim])
                        ]
                        end[:, 0] = _bent(end[:, 0], body22_m[:, tip] - place[:, joint], *bones)
                    turn[:, joint] = _turn_onto(start, end)
            world[:, joint] = multiply(turn[:, joint], old_world[:, joint])
        local = local_from_world(skeleton, world)
        return replace(source, rest_offsets_m=offsets, root_translation_m=place[:, root], local_unitquat=local)

    def retargeted(self, body22_m: Array, bone_scale: Array) -> OwnSkeleton:
        """Return the person with scaled bones, posed as a variant's body22 (frame, 22, 3), metres.

        Variants have bones of constant length, the median lengths of the source.  The body22 of the source may differ
        from that if its joints lie between joints that move; the targets are corrected by the difference first.
        """
        moved = self.body.of(self.motion)
        lengths = np.median(bone_lengths(BODY22, moved), axis=0)
        constant = place_bones(BODY22, moved[:, BODY22.root], bone_directions(BODY22, moved), lengths)
        offset = self.body.offset_m * bone_scale[:, None, None]
        return OwnSkeleton(self.posed(body22_m + moved - constant, bone_scale), BodyMap(self.body.weight, offset))

    def _exact_before(self, joint: int) -> int:
        """Return the joint of body22 above another; for an exact joint the nearest exact one above, if any."""
        before = BODY22.parents[joint]
        while joint in self._exact and before not in self._exact and before != BODY22.root:
            before = BODY22.parents[before]
        return before

    @cached_property
    def _exact(self) -> frozenset[int]:
        """Joints of body22 that are one joint of the source, or a point fixed to one."""
        return frozenset(np.flatnonzero(np.count_nonzero(self.body.weight, axis=1) == 1).tolist())

    @cached_property
    def _below(self) -> list[frozenset[int]]:
        """For each joint of the source the joints that move when it turns."""
        skeleton = self.motion.skeleton
        return [frozenset(skeleton.branch(joint)[1:]) for joint in range(skeleton.num_joints)]

    @cached_property
    def _ends(self) -> dict[int, tuple[int, bool]]:
        """For each joint of body22 that determines poses, the last source joint that it depends on.

        The flag says whether it moves when that joint turns.  Joints of body22 that depend on several branches are left
        out, and inexact ones whose last source joint is also that of an exact one.
        """
        ends: dict[int, tuple[int, bool]] = {}
        for joint in range(BODY22.num_joints):
            needed = np.flatnonzero(self.body.weight[joint])
            last = [source for source in needed if not self._below[source].intersection(needed)]
            if len(last) == 1:
                ends[joint] = (int(last[0]), bool(self.body.offset_m[joint, last[0]].any()))
        exact = {end for joint, end in ends.items() if joint in self._exact}
        return {joint: end for joint, end in ends.items() if joint in self._exact or end not in exact}

    @cached_property
    def _aims(self) -> list[list[int]]:
        """For each joint of the source the joints of body22 that it turns to their targets: the next ones below."""
        aims = []
        for source, below in enumerate(self._below):
            stops = [end for end, is_carried in self._ends.values() if not is_carried and end in below]
            moved = [joint for joint in self._ends if self._moves(source, joint)]
            aims.append([joint for joint in moved if not any(self._moves(stop, joint) for stop in stops)])
        return aims

    def _moves(self, source: int, joint: int) -> bool:
        """Return whether a joint of body22 moves when a joint of the source turns."""
        end, is_carried = self._ends[joint]
        return end in self._below[source] or (end == source and is_carried)


def standing(made: OwnSkeleton) -> OwnSkeleton:
    """Return the same motion with rotations from a standing T-pose: upright, facing +Z, arms out along X.

    Every joint j gets a rest frame Q_j, its world rotation in the standing T-pose of the source's skeleton.  Offsets
    become Q_parent offset, and world rotations W_j become W_j Q_j^-1.  Positions of joints do not change.
    """
    motion, skeleton = made.motion, made.motion.skeleton
    rest = made.rest_body22_m
    directions = bone_directions(BODY22, np.array([t_pose(joint) for joint in BODY22.joint_names]))
    wanted = place_bones(BODY22, np.zeros(3), directions, bone_lengths(BODY22, rest))
    trunk, its = rest[_TRUNK] - rest[_TRUNK].mean(axis=0), wanted[_TRUNK] - wanted[_TRUNK].mean(axis=0)
    local = identity_unitquat(1, skeleton.num_joints)
    local[:, skeleton.root] = unitquat_from_rotmat(best_rotation(trunk, its))
    upright = replace(motion, root_translation_m=np.zeros((1, 3)), local_unitquat=local)
    stood = OwnSkeleton(upright, made.body).posed(wanted[None], np.ones(BODY22.num_joints), meets_tips=False)
    frames = stood.world()[1][0]
    offsets = np.array(motion.rest_offsets_m)
    for parent, child in skeleton.bones:
        offsets[child] = rotate(frames[parent], offsets[child])
    world = motion.world()[1]
    turned = multiply(world, np.broadcast_to(conjugate(frames), world.shape))
    carried = rotate(np.broadcast_to(frames, (BODY22.num_joints, *frames.shape)), made.body.offset_m)
    return OwnSkeleton(
        replace(motion, rest_offsets_m=offsets, local_unitquat=local_from_world(skeleton, turned)),
        BodyMap(made.body.weight, carried),
    )


def with_end_sites(made: OwnSkeleton) -> OwnSkeleton:
    """Return the same person with End Sites, see `ended`."""
    motion = ended(made.motion)
    padding = ((0, 0), (0, motion.skeleton.num_joints - made.motion.skeleton.num_joints))
    return OwnSkeleton(
        motion, BodyMap(np.pad(made.body.weight, padding), np.pad(made.body.offset_m, (*padding, (0, 0))))
    )


def ended(motion: Motion) -> Motion:
    """Return the motion with an End Site, `<joint>_end`, for every joint that would have no length without one.

    Programs draw a bone from a joint to the joints below it.  The End Site of a leaf continues the bone before it; that
    of a joint whose children coincide with it points to the ends of their bones.  End Sites of the source are kept.
    """
    skeleton, offsets = motion.skeleton, motion.rest_offsets_m
    names: list[str] = []
    parents: list[int] = []
    ends: list[Array] = []
    for joint, name in enumerate(skeleton.joint_names):
        parent, below = skeleton.parents[joint], list(skeleton.children(joint))
        if not below and parent >= 0 and name.startswith(f"{skeleton.joint_names[parent]}_end"):
            continue
        while below and np.linalg.norm(offsets[below].mean(axis=0)) < _SHORTEST_M:
            below = [child for joints in below for child in skeleton.children(joints)]
        if below and set(below) <= set(skeleton.children(joint)):
            continue
        before = joint
        while not below and skeleton.parents[before] >= 0 and np.linalg.norm(offsets[before]) < _SHORTEST_M:
            before = skeleton.parents[before]
        names.append(f"{name}_end")
        parents.append(joint)
        ends.append(_END_SHARE * (offsets[below].mean(axis=0) if below else offsets[before]))
    return motion.with_joints(names, parents, ends)


def _turn_onto(start: Array, end: Array) -> Array:
    """Return the rotations (frame, 4) about the origin that fit points (frame, n, 3) best to others."""
    if start.shape[1] == 1:
        return swing_between(start[:, 0], end[:, 0])
    hold = np.broadcast_to(_HOLD_M * np.eye(3), (len(start), 3, 3))
    held = hold
    for _ in range(3):  # the hold follows the last rotation, so that it does not pull the fit back
        turn = best_rotation(np.concatenate([start, hold], axis=1), np.concatenate([end, held], axis=1))
        held = _HOLD_M * np.swapaxes(turn, -1, -2)
    return unitquat_from_rotmat(turn)


def _bent(joint_m: Array, tip_m: Array, first_m: Array, second_m: Array) -> Array:
    """Return the position of the middle joint of a two-bone limb whose tip is on target, nearest to the joint's target.

    Args:
        joint_m: Target of the middle joint, from the limb's root (frame, 3), metres.
        tip_m: Target of the tip (frame, 3), metres; if it is out of reach, the limb is stretched towards it.
        first_m: Length of the first bone (frame,).
        second_m: Length of the second bone (frame,).
    """
    distance = np.maximum(np.linalg.norm(tip_m, axis=-1), 1e-9)
    axis = tip_m / distance[:, None]
    along = np.clip((distance**2 + first_m**2 - second_m**2) / (2.0 * distance), -first_m, first_m)
    side = joint_m - np.sum(joint_m * axis, axis=-1, keepdims=True) * axis
    away = np.sqrt(np.maximum(first_m**2 - along**2, 0.0))
    return np.asarray(along[:, None] * axis + away[:, None] * normalise(side))
