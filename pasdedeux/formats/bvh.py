"""Reading BVH motion files, and bare rows of joint angles over a BVH template.

An own parser, because the package considered (pybvh 0.9) reads from a path only, gives no line number for a fault in
the motion block, and refuses joints with other than three rotation channels or with position channels.  The tests use
it as an independent oracle.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.euler import turn_joints
from pasdedeux.formats.file_format import FileStart, MotionFormat, MotionHead
from pasdedeux.formats.rates import rate_from_frame_time
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import Lines, parse_integer, parse_number, parse_numbers, shorten
from pasdedeux.formats.yolo import YOLO
from pasdedeux.skeletons import Skeleton

MAX_JOINTS = 1000
"""More joints than this is a damaged file: the largest rigs in use have a few hundred."""
MIN_FRAME_TIME_S, MAX_FRAME_TIME_S = 1e-5, 10.0
MAX_JOINT_SLIDE = 0.05
"""Share of a bone by which a joint with position channels may move against its parent and still count as rigid."""

_CHANNELS = {f"{axis}position": axis.lower() for axis in "XYZ"} | {f"{axis}rotation": axis for axis in "XYZ"}
"""The letter that stands for each channel."""


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

    def read_rows(self, lines: Lines, num_frames: int | None = None) -> Array:
        """Return the numbers (frame, sum of channels) of the lines that are left."""
        names = {letter: channel for channel, letter in _CHANNELS.items()}
        joints = zip(self.skeleton.joint_names, self.channels, strict=True)
        return lines.numbers([f"{names[one]} of '{joint}'" for joint, letters in joints for one in letters], num_frames)

    def motion(self, values: Array, rate_hz: float | None = None) -> SourceMotion:
        """Return the motion of rows of numbers (frame, sum of channels), lengths in file units, angles in degrees.

        Positions of the root are its place in the file's world and replace its OFFSET; those of another joint replace
        that joint's offset and must stay still.
        """
        rest_offsets = self.rest_offsets.copy()
        root_translation = np.tile(rest_offsets[self.skeleton.root], (len(values), 1))
        column = 0
        for joint, letters in enumerate(self.channels):
            moves = {"xyz".index(letter): column + at for at, letter in enumerate(letters) if letter in "xyz"}
            if moves and joint == self.skeleton.root:
                root_translation[:, list(moves)] = values[:, list(moves.values())]
            elif moves:
                place = np.tile(rest_offsets[joint], (len(values), 1))
                place[:, list(moves)] = values[:, list(moves.values())]
                rest_offsets[joint] = _still_offset(self.skeleton.joint_names[joint], place)
            column += len(letters)
        return SourceMotion(
            skeleton=self.skeleton,
            rest_offsets=rest_offsets,
            root_translation=root_translation,
            local_unitquat=turn_joints(np.deg2rad(values), self.channels),
            end_sites=self.end_sites,
            rate_hz=rate_hz,
        )


def read_bvh(data: bytes | str) -> SourceMotion:
    """Read a BVH file.  An End Site without an offset says nothing and is dropped."""
    return BvhHierarchy.motion(*_read(data))


def read_bvh_head(data: bytes | str) -> MotionHead:
    """Read a BVH file but do not convert its rotations, which takes most of the time.

    Raises:
        FormatError: As `read_bvh`, but for joints that move against their parent.
    """
    hierarchy, values, rate_hz = _read(data)
    return MotionHead(SourceMotion.at_rest(hierarchy.skeleton, hierarchy.rest_offsets, rate_hz=rate_hz), len(values))


def read_rotation_rows(data: bytes | str, template: bytes | str) -> SourceMotion:
    """Read rows of angles over a BVH template, as the projection database of Yiannakides et al. (2019) ships.

    Each line is a frame: for every joint of the template in its order three Euler angles in degrees, in the order of
    the joint's rotation channels.  The root stays at the template's OFFSET.
    """
    with Lines(template, "BVH template") as lines:
        hierarchy = _read_hierarchy(lines)
    turns = tuple("".join(letter for letter in letters if letter in "XYZ") for letters in hierarchy.channels)
    if any(letters and len(angles) != 3 for letters, angles in zip(hierarchy.channels, turns, strict=True)):
        raise FormatError("the template of rotation rows needs three rotation channels for every joint")
    hierarchy = replace(hierarchy, channels=turns)
    with Lines(data, "file of rotation rows") as lines:
        return hierarchy.motion(hierarchy.read_rows(lines))


BVH = MotionFormat(
    name="bvh",
    suffixes=(".bvh",),
    recognises=lambda start: start.text[:9].upper() == "HIERARCHY" and not start.text[9:10].isalnum(),
    read=lambda data, companion: read_bvh(data),
    head=lambda data, companion: read_bvh_head(data),
)
"""A hierarchy and Euler angles.  It states its rate, rounded; never its unit, nor which axis points up."""


def _is_rows(start: FileStart) -> bool:
    """Tell whether the first line is at least three triples of numbers."""
    words = start.first_row.split()
    is_numbers = len(words) >= 9 and len(words) % 3 == 0 and all(re.fullmatch(r"[-+0-9.eE]+", word) for word in words)
    return is_numbers and not YOLO.recognises(start)


ROTATION_ROWS = MotionFormat(
    name="rotation_rows",
    suffixes=(),
    recognises=_is_rows,
    read=read_rotation_rows,
    companion="BVH template",
    companion_names=lambda name: ("template.bvh", "../template.bvh"),
)
"""Rows of angles over a BVH template; they say nothing of rate, unit and axis."""


@dataclass
class _Joint:
    """A joint while it is read."""

    name: str
    parent: str
    is_end: bool
    offset: list[float] | None = None
    channels: str | None = None

    def allowed(self) -> list[str]:
        """Return what may stand next in its block."""
        words = ["OFFSET" if self.offset is None else "}"]
        if self.channels is None and not self.is_end:
            words.append("CHANNELS")
        return words if self.is_end else [*words, "JOINT", "END"]


def _read_hierarchy(lines: Lines) -> BvhHierarchy:
    """Read up to the line MOTION, or all lines of a template."""
    joints: dict[str, _Joint] = {}
    blocks: list[_Joint] = []
    allowed = ["HIERARCHY"]
    for line in lines.words():
        words = " ".join(line).replace("{", " { ").replace("}", " } ").split()
        while words:
            key = words[0].upper()
            if key not in allowed:
                where = f" in '{blocks[-1].name}'" if blocks else ""
                found = shorten(" ".join(words))
                raise FormatError(f"'{found}' is not expected{where}; allowed: {', '.join(allowed)}")
            del words[0]
            match key:
                case "HIERARCHY":
                    allowed = ["ROOT"]
                    continue
                case "ROOT" | "JOINT" | "END":
                    stop = words.index("{") if "{" in words else len(words)
                    name = " ".join(words[:stop]) if key != "END" else _end_name(blocks[-1].name, joints)
                    if not name or name in joints or len(joints) == MAX_JOINTS:
                        why = "has no name" if not name else f"'{shorten(name)}' is the second or one too many"
                        raise FormatError(f"this {key} {why}; allowed: {MAX_JOINTS} joints with names of their own")
                    joints[name] = _Joint(name, blocks[-1].name if blocks else "", key == "END")
                    blocks.append(joints[name])
                    del words[:stop]
                    allowed = ["{"]
                    continue
                case "OFFSET":
                    blocks[-1].offset = parse_numbers(words[:3], f"OFFSET of '{blocks[-1].name}'", 3)
                    del words[:3]
                case "CHANNELS":
                    blocks[-1].channels = _pop_channels(words, blocks[-1].name)
                case "}":
                    blocks.pop()
                case "MOTION":
                    return _hierarchy_of(joints)
            allowed = blocks[-1].allowed() if blocks else ["MOTION"]
    if allowed != ["MOTION"]:
        raise FormatError(f"the file ends where {' or '.join(allowed)} is needed")
    return _hierarchy_of(joints)


def _end_name(parent: str, joints: Collection[str]) -> str:
    """Return a name for an End Site that no joint has."""
    names = (f"{parent}_end{copy if copy > 1 else ''}" for copy in count(1))
    return next(name for name in names if name not in joints)


def _pop_channels(words: list[str], joint: str) -> str:
    """Return the letters of the channels that the first words count and list, and take those words away."""
    what = f"CHANNELS of '{joint}'"
    num_channels = parse_integer(words[0] if words else "", what, 0, len(_CHANNELS))
    listed = [word.capitalize() for word in words[1 : num_channels + 1]]
    if len(listed) != num_channels:
        raise FormatError(f"{what} states {num_channels} channels but lists {len(listed)}")
    for channel in listed:
        if channel not in _CHANNELS or listed.count(channel) > 1:
            known = ", ".join(_CHANNELS)
            raise FormatError(f"channel '{shorten(channel)}' of '{joint}' is not known or there twice; known: {known}")
    del words[: num_channels + 1]
    return "".join(_CHANNELS[channel] for channel in listed)


def _hierarchy_of(joints: Mapping[str, _Joint]) -> BvhHierarchy:
    kept = [joint for joint in joints.values() if not joint.is_end or any(joint.offset or ())]
    names = [joint.name for joint in kept]
    if not any(joint.channels for joint in kept):
        raise FormatError("no joint of this BVH file has channels")
    parents = tuple(names.index(joint.parent) if joint.parent else -1 for joint in kept)
    return BvhHierarchy(
        skeleton=Skeleton(name="bvh", joint_names=tuple(names), parents=parents),
        rest_offsets=np.array([joint.offset for joint in kept]),
        channels=tuple(joint.channels or "" for joint in kept),
        end_sites=frozenset(joint.name for joint in kept if joint.is_end),
    )


def _read(data: bytes | str) -> tuple[BvhHierarchy, Array, float]:
    """Return the joints, the numbers of the frames (frame, sum of channels), and the frame rate."""
    with Lines(data, "BVH file") as lines:
        hierarchy = _read_hierarchy(lines)
        num_frames = parse_integer(_stated(lines, "Frames:"), "the number of frames", 1)
        frame_time = _stated(lines, "Frame Time:")
        parse_number(frame_time, "the frame time in seconds", MIN_FRAME_TIME_S, MAX_FRAME_TIME_S)
        return hierarchy, hierarchy.read_rows(lines, num_frames), rate_from_frame_time(frame_time)[0]


def _stated(lines: Lines, label: str) -> str:
    """Return what stands after a label in the next line that is not blank."""
    text = " ".join(next(lines.words(), []))
    if not text.upper().startswith(label.upper()):
        raise FormatError(f"'{label}' is expected, found '{shorten(text)}'")
    return text[len(label) :].strip()


def _still_offset(name: str, place: Array) -> Array:
    """Return the mean of a joint's own positions (frame, 3), or refuse a joint that moves against its parent."""
    mean = place.mean(axis=0)
    slide = np.linalg.norm(place - mean, axis=1)
    worst = int(np.argmax(slide))
    if slide[worst] > MAX_JOINT_SLIDE * max(float(np.linalg.norm(mean)), 1e-9):
        raise FormatError(
            f"frame {worst}: joint '{name}' moves by {slide[worst]:.3g} units against its parent; "
            "bones must keep their length"
        )
    return mean
