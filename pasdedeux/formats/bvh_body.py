"""People among the joints of a BVH file: the root of each body, and its motion from the values of the frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.euler import turn_joints
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics import place_bones
from pasdedeux.kinematics.rotations import conjugate, identity_unitquat, multiply, rotate
from pasdedeux.skeletons import Skeleton
from pasdedeux.skeletons.layouts.names import normal_names

LIMB_JOINTS = 3
"""Number of joints of the shortest limb: hip, knee, ankle."""
MAX_STRETCH_M, STATURE_M = 0.01, 1.7
"""Largest movement of a joint against its parent, on a body of this stature, for which its bone is fixed, metres."""
_STILL = 1e-6
"""Largest movement of a fixed joint, a share of the stature: rounding in the file."""
_HIP_NAMES = ("hips", "hip", "pelvis")


@dataclass(frozen=True)
class BvhHierarchy:
    """The joints of a BVH file.

    Args:
        skeleton: Joints in the order of the file; an End Site with an offset is a joint `<parent>_end`.
        rest_offsets: Offset of each joint from its parent, (J, 3), file units.
        channels: For each joint its channels in the order of the file: x, y, z are positions, X, Y, Z rotations.
        end_sites: Names of the joints that are End Sites.
    """

    skeleton: Skeleton
    rest_offsets: Array
    channels: tuple[str, ...]
    end_sites: frozenset[str]

    @property
    def num_people(self) -> int:
        """Number of people among the joints, at least 1."""
        return max(len(self._bodies), 1)

    def motion(
        self,
        values: Array,
        *,
        person: int = 0,
        rate_hz: float | None = None,
        notes: tuple[str, ...] = (),
        is_head: bool = False,
    ) -> SourceMotion:
        """Return the motion of a person, counted from 0.

        Position channels of a joint replace its OFFSET.  The root is the joint where legs and spine branch; the motion
        of the nodes above it is composed into its own.  Below it, a joint that moves against its parent by up to 1 cm,
        on a body of 1.7 m, is fixed at its median offset, with a note.

        Args:
            values: Values (frame, sum of channels), lengths in file units, angles in degrees.
            person: Number of the person.
            rate_hz: Frame rate that the file states.
            notes: Notes of the reader so far.
            is_head: Return only one frame of the rest pose.

        Raises:
            FormatError: A joint moves by more; the message has the joint, the frame and the amount.
        """
        root = self._root(values, person)
        chain = self.skeleton.path(root)[:-1]
        kept = sorted(self.skeleton.branch(root))
        names, parents = self.skeleton.joint_names, self.skeleton.parents
        skeleton = self.skeleton
        if chain:
            places = {joint: at for at, joint in enumerate(kept)}
            tree = tuple(-1 if joint == root else places[parents[joint]] for joint in kept)
            skeleton = Skeleton(skeleton.name, tuple(names[joint] for joint in kept), tree)
        offsets, fixed = self._fixed_offsets(values, kept, skeleton)
        carried, origin = identity_unitquat(len(values)), np.zeros((len(values), 3))
        for joint in chain:
            origin = origin + rotate(carried, self._place(joint, values))
            carried = multiply(carried, self._turns([joint], values)[:, 0])
        constant = carried[0] if np.abs(carried - carried[0]).max() < 1e-12 else identity_unitquat()
        if chain:
            offsets = rotate(np.broadcast_to(constant, (len(offsets), 4)), offsets)
        said = (*notes, *self._left_out(root), *fixed)
        ends = frozenset(names[joint] for joint in kept) & self.end_sites
        if is_head:
            return SourceMotion.at_rest(skeleton, offsets, rate_hz=rate_hz, notes=said)
        local = self._turns(kept, values)
        if chain:
            at = kept.index(root)
            relative = multiply(conjugate(np.broadcast_to(constant, carried.shape)), carried)
            local[:, at] = multiply(relative, local[:, at])
            turned = np.broadcast_to(constant, local.shape)
            local = multiply(turned, multiply(local, conjugate(turned)))
        return SourceMotion(
            skeleton=skeleton,
            rest_offsets=offsets,
            root_translation=origin + rotate(carried, self._place(root, values)),
            local_unitquat=local,
            end_sites=ends,
            rate_hz=rate_hz,
            notes=said,
        )

    def positions(self, values: Array) -> Array:
        """Return the positions of all joints (frame, J, 3), file units, from values (frame, sum of channels)."""
        places, turns = [np.zeros((0, 3))] * self.skeleton.num_joints, self._turns(list(self.skeleton.order), values)
        carried = dict(zip(self.skeleton.order, np.moveaxis(turns, 1, 0), strict=True))
        for joint in self.skeleton.order:
            places[joint], parent = self._place(joint, values), self.skeleton.parents[joint]
            if parent >= 0:
                places[joint] = places[parent] + rotate(carried[parent], places[joint])
                carried[joint] = multiply(carried[parent], carried[joint])
        return np.stack(places, axis=1)

    @cached_property
    def _starts(self) -> list[int]:
        """First column of each joint, then the number of columns."""
        return [0, *np.cumsum([len(letters) for letters in self.channels]).tolist()]

    def _place(self, joint: int, values: Array) -> Array:
        """Return the position of a joint in its parent's frame (frame, 3).

        Position channels that are all zero are ignored, except those of the file's root.
        """
        letters, start = self.channels[joint], self._starts[joint]
        place = np.tile(self.rest_offsets[joint], (len(values), 1))
        moves = {"xyz".index(letter): start + at for at, letter in enumerate(letters) if letter in "xyz"}
        moved = values[:, list(moves.values())]
        if moves and (moved.any() or joint == self.skeleton.root):
            place[:, list(moves)] = moved
        return place

    def _turns(self, joints: list[int], values: Array) -> Array:
        """Return local rotations (frame, joint, 4) of some joints."""
        columns = [column for joint in joints for column in range(self._starts[joint], self._starts[joint + 1])]
        return turn_joints(np.deg2rad(values[:, columns]), [self.channels[joint] for joint in joints])

    def _fixed_offsets(self, values: Array, kept: list[int], skeleton: Skeleton) -> tuple[Array, list[str]]:
        """Return the median offsets of the joints below the root (J, 3), and a note if some move."""
        offsets, away = self.rest_offsets[kept].copy(), np.zeros((len(kept), len(values)))
        for at, source in enumerate(kept):
            if at != skeleton.root and any(letter in "xyz" for letter in self.channels[source]):
                place = self._place(source, values)
                offsets[at] = np.median(place, axis=0)
                away[at] = np.linalg.norm(place - offsets[at], axis=1)
        rest = place_bones(skeleton, np.zeros(3), offsets, np.ones(len(kept)))
        away *= STATURE_M / max(float(np.ptp(rest, axis=0).max()), 1e-9)
        joint, frame = map(int, np.unravel_index(int(np.argmax(away)), away.shape))
        most = f"joint '{skeleton.joint_names[joint]}' moves by {100 * away[joint, frame]:.2g} cm against its parent"
        if away[joint, frame] > MAX_STRETCH_M:
            raise FormatError(
                f"frame {frame}: {most}, on a body of {STATURE_M} m; bones may change by {100 * MAX_STRETCH_M:g} cm: "
                "export the motion without stretching bones"
            )
        num_moving = int((away.max(axis=1) > _STILL * STATURE_M).sum())
        others = f" (and {num_moving - 1} more, by less)" if num_moving > 1 else ""
        return offsets, [f"{most}{others}: fixed at the median"] * bool(num_moving)

    def _left_out(self, root: int) -> list[str]:
        """Return notes on other people and on branches that are left out."""
        notes = []
        if self.num_people > 1:
            notes.append(f"the file holds {self.num_people} people, this is the one of '{self._name(root)}'")
        skeleton = self.skeleton
        used = {joint for body in (root, *self._bodies) for joint in (*skeleton.path(body), *skeleton.branch(body))}
        beside = [name for joint, name in enumerate(skeleton.joint_names) if joint not in used]
        if beside := [name for name in beside if name not in self.end_sites]:
            more = f" and {len(beside) - 1} more" if len(beside) > 1 else ""
            notes.append(f"joint '{beside[0]}'{more} beside '{self._name(root)}' left out")
        return notes

    def _name(self, joint: int) -> str:
        return self.skeleton.joint_names[joint]

    def _root(self, values: Array, person: int) -> int:
        """Return the root joint of a person; if there is no body, the last joint of the first chain that moves."""
        if not self._bodies:
            chain = [self.skeleton.root]
            while len(below := self._children(chain[-1])) == 1:
                chain += below
            moving = [joint for joint in chain[1:] if np.ptp(self._place(joint, values), axis=0).any()]
            return moving[-1] if moving else chain[0]
        body = self._bodies[person]
        chain = self.skeleton.path(body)
        moving = [at for at, joint in enumerate(chain[1:], 1) if np.ptp(self._place(joint, values), axis=0).any()]
        normal = normal_names(self.skeleton.joint_names)
        hips = [
            at for at, joint in enumerate(chain) if normal[joint].endswith(_HIP_NAMES) and at >= max(moving, default=0)
        ]
        return chain[hips[0]] if hips else body

    def _children(self, joint: int) -> list[int]:
        """Return the children of a joint except End Sites."""
        return [child for child in self.skeleton.children(joint) if self._name(child) not in self.end_sites]

    @cached_property
    def _limbs(self) -> list[list[int]]:
        """For each joint its children that start a limb or more, except targets of inverse kinematics (`ik_...`)."""
        depth = [0] * self.skeleton.num_joints
        for joint in reversed(self.skeleton.order):
            depth[joint] = 1 + max((depth[child] for child in self._children(joint)), default=0)
        return [
            [
                child
                for child in self._children(joint)
                if depth[child] >= LIMB_JOINTS and not self._name(child).lower().startswith("ik_")
            ]
            for joint in range(self.skeleton.num_joints)
        ]

    @cached_property
    def _bodies(self) -> list[int]:
        """The joint of each person where legs and spine branch; empty if there is no body."""
        return self._bodies_below(self.skeleton.root)

    def _bodies_below(self, joint: int) -> list[int]:
        while True:
            limbs = self._limbs[joint]
            people = [limb for limb in limbs if self._is_body(limb)]
            if len(people) > 1:
                return [body for limb in people for body in self._bodies_below(limb)]
            if len(limbs) != 1:
                return [joint] if limbs else []
            joint = limbs[0]

    def _is_body(self, joint: int) -> bool:
        """Return whether a joint, or the first below it with several limbs, has a limb that branches again."""
        while len(self._limbs[joint]) == 1:
            joint = self._limbs[joint][0]
        below = [other for limb in self._limbs[joint] for other in self.skeleton.branch(limb)]
        return any(len(self._limbs[other]) > 1 for other in below)
