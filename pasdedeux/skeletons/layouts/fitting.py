"""A layout fitted to one file: missing joints are derived from those that are there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.skeletons.layouts.layout import AddedPoint, Entry, Layout, mixed, working_tables
from pasdedeux.skeletons.layouts.names import SIDES
from pasdedeux.skeletons.skeleton import ARM, LEG, Skeleton
from pasdedeux.skeletons.working import BODY22

_SPINE = {"spine1": 0.23, "spine2": 0.45, "spine3": 0.68, "spine": 1 / 3, "chest": 2 / 3}
"""Positions of joints between pelvis and base of the neck, as shares; those of the T-pose of body22."""
_SNAP = 0.12
"""Largest distance of a joint of the file from that of the spine that it is taken for, a share of the trunk."""
_EAR, _NOSE_FORWARD = 0.243, 0.17
"""Height of the ear over the base of the neck, and distance of the nose before the ear, in trunk lengths."""
_EAR_FACTORS = (0.6, 2.0)
"""Range of the position of the ear on the line from the base of the neck to the head joint, as a factor."""
_TOE_FORWARD, _TOE_DOWN, _NO_AXES_TOE = 0.37, 0.10, 0.2
"""Ball of the foot from the ankle, in shin lengths; the last one along the shin, if forward is unknown."""
_COLLAR, _NECK_OF_SHOULDERS = 0.25, 0.8
_NO_BONE = 0.01
"""Bones shorter than this share of the longest one count as empty."""
_PELVIS_AWAY = 0.5
"""A pelvis that is farther from the middle of the hips, in leg lengths, is a node of the scene."""
_STRAIGHT, _SQUARE, _ALONG = 0.7, 0.4, 0.95
"""Cosines: minimum of legs and trunk, maximum of trunk and hip line, minimum for snapping to the file's axes."""


def fit_parts(name: str, meaning: str, parts: Mapping[str, Entry], skeleton: Skeleton, rest_offsets: Array) -> Layout:
    """Return the layout of parts that are given in the file's names; missing parts are derived.

    Args:
        name: Name of the layout.
        meaning: One line for people.
        parts: As in `Layout`: at least `NEEDED`, and `neck` or `skull`.
        skeleton: The joints of the file.
        rest_offsets: Offset of each joint from its parent, (J, 3), any unit.
    """
    return LayoutFit(Layout(name, meaning, {}, (), parts), skeleton, rest_offsets).layout()


def rest_positions(skeleton: Skeleton, rest_offsets: Array) -> Array:
    """Return the rest pose (J, 3), the root at the origin."""
    places = np.zeros((skeleton.num_joints, 3))
    for joint in skeleton.order[1:]:
        places[joint] = places[skeleton.parents[joint]] + rest_offsets[joint]
    return places


@dataclass(frozen=True)
class LayoutFit:
    """A layout in the names of a file, with the file's rest pose."""

    given: Layout
    skeleton: Skeleton
    rest_offsets: Array

    @cached_property
    def _rest(self) -> Array:
        return rest_positions(self.skeleton, self.rest_offsets)

    @cached_property
    def _lengths(self) -> Array:
        lengths = np.linalg.norm(self.rest_offsets, axis=-1)
        lengths[self.skeleton.root] = 0.0
        return np.asarray(lengths)

    @cached_property
    def _short(self) -> float:
        """Length up to which a bone is empty, file units; negative if the rest pose has no bones."""
        return _NO_BONE * float(self._lengths.max(initial=0.0)) or -1.0

    @cached_property
    def _axes(self) -> Array | None:
        """Left, up and forward of the rest pose as columns (3, 3); None unless a person stands.

        Axes near those of the file are replaced by them.
        """
        if self.given.keeps_axes:
            return np.eye(3)
        left, right = (
            {part: self._place(self.given.parts[f"{side}_{part}"]) for part in (*ARM, *LEG)} for side in SIDES
        )
        hips = (left["hip"] + right["hip"]) / 2
        up = (left["shoulder"] + right["shoulder"]) / 2 - hips
        down = (left["ankle"] + right["ankle"]) / 2 - hips
        across = left["hip"] - right["hip"] + left["shoulder"] - right["shoulder"]
        lengths = [float(np.linalg.norm(vector)) for vector in (across, up, down)]
        if min(lengths) <= max(self._short, 0.0):
            return None
        across, up, down = (vector / length for vector, length in zip((across, up, down), lengths, strict=True))
        if -(up @ down) < _STRAIGHT or abs(up @ across) > _SQUARE:
            return None
        across = across - (across @ up) * up
        across /= np.linalg.norm(across)
        axes = np.stack([across, up, np.cross(across, up)], axis=1)
        is_along = np.abs(axes).max(axis=0) > _ALONG
        return np.where(np.abs(axes) > _ALONG, np.sign(axes), 0.0) if is_along.all() else axes

    def layout(self) -> Layout:
        """Return the layout with all of its parts, points and tables."""
        parts, points = dict(self.given.parts), self._points()
        if parts.get("nose") == "nose" and ("nose" not in points or "neck" not in parts):
            del parts["nose"]  # such a point needs the bone from neck to head
            points.pop("nose", None)
        given_parts = set(parts)
        self._leave_out_empty(parts)
        if "pelvis" not in parts:
            parts["pelvis"] = mixed((parts[f"{side}_hip"], 0.5) for side in SIDES)
        given_parts &= parts.keys()
        skull = self._add_neck_and_head(parts)
        if not parts.keys() >= {"spine1", "spine2", "spine3", "spine", "chest"}:
            given_parts = given_parts - _SPINE.keys() | self._add_spine(parts)
        for side in SIDES:
            if f"{side}_collar" not in parts:
                parts[f"{side}_collar"] = mixed([(parts["spine3"], 1 - _COLLAR), (parts[f"{side}_shoulder"], _COLLAR)])
            if f"{side}_toe" not in parts:
                parts[f"{side}_toe"] = self._toe(side, parts, points)
        if "nose" not in parts:
            parts["nose"] = self._nose(parts, skull, points)
        given_parts |= {"head"} if given_parts & {"skull", "head"} else set()
        return replace(
            self.given,
            tables=working_tables(parts),
            parts=parts,
            points=tuple(points.values()),
            keeps_axes=True,
            derived=tuple(joint for joint in BODY22.joint_names if joint not in given_parts),
        )

    def _points(self) -> dict[str, AddedPoint]:
        """Return the points of the layout in the frames of the file's joints."""
        axes = self._axes
        return {
            point.name: replace(point, offset=tuple((axes @ np.array(point.offset)).tolist()))
            for point in self.given.points
            if axes is not None and self._lengths[self.skeleton.index(point.unit_bone)] > self._short
        }

    def _place(self, entry: Entry) -> Array:
        """Return the position of an entry in the rest pose."""
        shares = ({entry: 1.0} if isinstance(entry, str) else entry).items()
        points = {point.name: point.joint for point in self.given.points}
        return np.asarray(
            sum(share * self._rest[self.skeleton.index(points.get(name, name))] for name, share in shares)
        )

    def _distance(self, first: Entry, second: Entry) -> float:
        return float(np.linalg.norm(self._place(first) - self._place(second)))

    def _leave_out_empty(self, parts: dict[str, Entry]) -> None:
        """Remove joints that coincide with the one before, and a pelvis that is a node of the scene."""
        points = {point.name for point in self.given.points}
        for side in SIDES:
            toe = parts.get(f"{side}_toe")
            if toe and toe not in points and self._distance(toe, parts[f"{side}_ankle"]) <= self._short:
                del parts[f"{side}_toe"]
        if {"neck", "skull"} <= parts.keys() and self._distance(parts["neck"], parts["skull"]) <= self._short:
            del parts["skull"]
            parts.pop("head", None)
        hips = mixed((parts[f"{side}_hip"], 0.5) for side in SIDES)
        leg = self._distance(parts["left_hip"], parts["left_knee"]) + self._distance(
            parts["left_knee"], parts["left_ankle"]
        )
        if "pelvis" in parts and self._distance(parts["pelvis"], hips) > _PELVIS_AWAY * leg > 0:
            del parts["pelvis"]

    def _add_neck_and_head(self, parts: dict[str, Entry]) -> Entry:
        """Add missing neck and head, and return the entry that carries the head."""
        skull = parts.get("skull") or parts.get("head")
        if "neck" not in parts:
            shoulders = mixed((parts[f"{side}_shoulder"], 0.5) for side in SIDES)
            assert skull is not None
            parts["neck"] = mixed([(shoulders, _NECK_OF_SHOULDERS), (skull, 1 - _NECK_OF_SHOULDERS)])
        neck = parts["neck"]
        if skull is None and isinstance(neck, str):
            used = {name for entry in parts.values() for name in ([entry] if isinstance(entry, str) else entry)}
            children = [self.skeleton.joint_names[child] for child in self.skeleton.children(self.skeleton.index(neck))]
            ends = [name for name in children if name not in used and self._distance(neck, name) > self._short]
            skull = max(ends, key=lambda name: self._distance(neck, name), default=None)
        if "head" not in parts:
            trunk = self._distance(neck, parts["pelvis"])
            if skull is None:
                parts["head"] = mixed([(neck, 1 + _EAR), (parts["pelvis"], -_EAR)])
            else:
                length = self._distance(neck, skull)
                factor = float(np.clip(_EAR * trunk / length if length > 0 else 1.0, *_EAR_FACTORS))
                parts["head"] = mixed([(neck, 1 - factor), (skull, factor)])
        return skull or neck

    def _add_spine(self, parts: dict[str, Entry]) -> set[str]:
        """Add the joints between pelvis and neck, and return the parts that are joints of the file."""
        pelvis, neck = parts["pelvis"], parts["neck"]
        names = self.skeleton.joint_names
        path: list[Entry] = [pelvis, *(names[joint] for joint in self._between(parts)), neck]
        kept = path[:1]
        for entry in path[1:-1]:
            if min(self._distance(entry, kept[-1]), self._distance(entry, neck)) > self._short:
                kept.append(entry)
        path = [*kept, neck]
        steps = [self._distance(before, after) for before, after in pairwise(path)]
        at = np.concatenate([[0.0], np.cumsum(steps)])
        at = at / at[-1] if at[-1] > 0 else np.linspace(0.0, 1.0, len(path))
        last, joints = 0, set()
        for part, share in _SPINE.items():
            inner = np.arange(last + 1 if part.startswith("spine") and part != "spine" else 1, len(path) - 1)
            nearest = int(inner[np.argmin(np.abs(at[inner] - share))]) if len(inner) else 0
            if nearest and abs(at[nearest] - share) < _SNAP:
                parts[part] = path[nearest]
                joints.add(part)
                last = nearest if part[-1].isdigit() else last
                continue
            after = int(np.clip(np.searchsorted(at, share), 1, len(path) - 1))
            weight = (share - at[after - 1]) / (at[after] - at[after - 1])
            parts[part] = mixed([(path[after - 1], 1 - weight), (path[after], weight)])
        return joints

    def _between(self, parts: Mapping[str, Entry]) -> list[int]:
        """Return the joints between the last one that trunk and legs share, and the neck."""
        legs = [self._ancestors(parts[f"{side}_hip"]) for side in SIDES]
        neck = self._ancestors(parts["neck"] if isinstance(parts["neck"], str) else parts["left_shoulder"])
        if not isinstance(parts["neck"], str):
            arm = self._ancestors(parts["right_shoulder"])
            neck = [-1, *(joint for joint in neck if joint in arm)]
        shared = set(legs[0]) & set(legs[1])
        pelvis = parts["pelvis"]
        pelvis_joint = self.skeleton.index(pelvis) if isinstance(pelvis, str) else -1
        return [joint for joint in reversed(neck[1:]) if joint not in shared and joint != pelvis_joint]

    def _ancestors(self, entry: Entry) -> list[int]:
        """Return the joint with the largest weight and all joints above it, itself first."""
        name = entry if isinstance(entry, str) else max(entry, key=lambda name: entry[name])
        return self.skeleton.path(self.skeleton.index(name))[::-1]

    def _toe(self, side: str, parts: Mapping[str, Entry], points: dict[str, AddedPoint]) -> Entry:
        """Return the ball of a foot: a child of the ankle off the line of the shin, else a guess."""
        ankle, knee = parts[f"{side}_ankle"], parts[f"{side}_knee"]
        shin = self._place(ankle) - self._place(knee)
        length = float(np.linalg.norm(shin))
        joint = self._ancestors(ankle)[0]
        best, reach = "", 0.1 * length
        for child in self.skeleton.children(joint):
            offset = self.rest_offsets[child]
            across = float(np.linalg.norm(offset - (offset @ shin) * shin / max(length, 1e-12) ** 2))
            if across > reach:
                best, reach = self.skeleton.joint_names[child], across
        if best:
            return best
        if self._axes is None or length <= 0:
            return mixed([(ankle, 1 + _NO_AXES_TOE), (knee, -_NO_AXES_TOE)])
        vector = length * (_TOE_FORWARD * self._axes[:, 2] - _TOE_DOWN * self._axes[:, 1])
        return self._carried(f"{side}_toe", joint, vector, points)

    def _nose(self, parts: Mapping[str, Entry], skull: Entry, points: dict[str, AddedPoint]) -> Entry:
        """Return a point before the ears; the head if forward is unknown."""
        trunk = self._distance(parts["neck"], parts["pelvis"])
        if self._axes is None or trunk <= 0:
            return parts["head"]
        joint = self._ancestors(skull)[0]
        vector = self._place(parts["head"]) - self._rest[joint] + _NOSE_FORWARD * trunk * self._axes[:, 2]
        return self._carried("nose", joint, vector, points)

    def _carried(self, name: str, joint: int, vector: Array, points: dict[str, AddedPoint]) -> str:
        """Add a point fixed to a joint, at this vector from it in the rest pose, and return its name."""
        chain = reversed(self.skeleton.path(joint))
        unit = next((above for above in chain if self._lengths[above] > self._short), int(np.argmax(self._lengths)))
        while name in self.skeleton.joint_names:
            name += "_point"
        offset = tuple((vector / self._lengths[unit]).tolist())
        names = self.skeleton.joint_names
        points[name] = AddedPoint(name, names[joint], offset, names[unit])
        return name
