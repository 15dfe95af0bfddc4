"""Reading BVH motion files.

An own parser, because the package considered (pybvh 0.9) reads from a path only, gives no line number for a fault in
the motion block, and refuses joints with other than three rotation channels or with position channels.  The tests use
it as an independent oracle.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.euler import identity_unitquat, unitquat_from_euler
from pasdedeux.formats.file_format import FileStart, MotionFormat, MotionHead
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import MAX_MAGNITUDE, decode, parse_integer, parse_number, shorten, split_lines
from pasdedeux.skeletons import Skeleton

MAX_JOINTS = 1000
"""More joints than this is a damaged file: the largest rigs in use have a few hundred."""
MAX_FRAME_TIME_S = 10.0
MIN_FRAME_TIME_S = 1e-5
MAX_JOINT_SLIDE = 0.05
"""Share of a bone by which a joint with position channels may move against its parent and still count as rigid."""

_NOT_A_DECIMAL = re.compile(r"[^0-9.\s-]")


@dataclass(frozen=True)
class BvhHierarchy:
    """The joints of a BVH file.

    Args:
        skeleton: Joints in the order of the file; an End Site with an offset is a joint `<parent>_end`.
        rest_offsets: Offset of each joint from its parent, (J, 3), file units.
        channels: For each joint its channels in the order of the file, such as ("Xposition", "Zrotation").
        end_sites: Names of the joints that are End Sites.
    """

    skeleton: Skeleton
    rest_offsets: Array
    channels: tuple[tuple[str, ...], ...]
    end_sites: frozenset[str]

    @property
    def num_channels(self) -> int:
        """Numbers per frame."""
        return sum(len(channels) for channels in self.channels)


@dataclass(frozen=True)
class BvhHeader(BvhHierarchy):
    """Everything of a BVH file but the numbers of its frames.

    Args:
        num_frames: Frames in the motion block.
        rate_hz: Frame rate: the one whole number that the digits of the frame time allow, else its inverse.
        first_line: Line number, from 1, of the first line after `Frame Time:`.
    """

    num_frames: int
    rate_hz: float
    first_line: int


def read_bvh_hierarchy(data: bytes | str) -> BvhHierarchy:
    """Read the hierarchy of a BVH file, which may end there: a template.

    Raises:
        FormatError: The hierarchy is mangled; the line is named.
    """
    return _parse_hierarchy(split_lines(decode(data, "BVH file")))[0]


def read_bvh_header(data: bytes | str) -> BvhHeader:
    """Read the hierarchy of a BVH file and check its motion block without converting its numbers.

    Finds everything that `read_bvh` refuses but decimals that are malformed ("1.2.3") or have more than seven digits
    before the point.

    Raises:
        FormatError: The file is mangled; the line is named.
    """
    lines = split_lines(decode(data, "BVH file"))
    header = _parse_header(lines)
    _check_rows(header, lines[header.first_line - 1 :])
    return header


def read_bvh(data: bytes | str) -> SourceMotion:
    """Read a BVH file.

    Position channels of the root are its place in the file's world and replace its OFFSET; those of another joint
    replace that joint's offset and must stay still.  An End Site without an offset says nothing and is dropped.

    Raises:
        FormatError: The file is mangled: truncated, a wrong number of values in a frame, NaN, unknown channels,
            two roots, unbalanced braces, absurd numbers.  The line is named.
    """
    lines = split_lines(decode(data, "BVH file"))
    header = _parse_header(lines)
    rows = lines[header.first_line - 1 :]
    _check_rows(header, rows)
    values = _parse_rows(header, rows)

    skeleton = header.skeleton
    rest_offsets = header.rest_offsets.copy()
    root_translation = np.tile(header.rest_offsets[skeleton.root], (header.num_frames, 1))
    local_unitquat = identity_unitquat(header.num_frames, skeleton.num_joints)

    by_axes: dict[str, list[tuple[int, list[int]]]] = {}
    column = 0
    for joint, channels in enumerate(header.channels):
        turns = [column + i for i, name in enumerate(channels) if name.endswith("rotation")]
        axes = "".join(name[0] for name in channels if name.endswith("rotation"))
        moves = {name[0]: column + i for i, name in enumerate(channels) if name.endswith("position")}
        if turns:
            by_axes.setdefault(axes, []).append((joint, turns))
        if moves:
            place = root_translation if joint == skeleton.root else np.tile(rest_offsets[joint], (header.num_frames, 1))
            for axis, index in moves.items():
                place[:, "XYZ".index(axis)] = values[:, index]
            if joint != skeleton.root:
                rest_offsets[joint] = _still_offset(skeleton.joint_names[joint], place, header.first_line)
        column += len(channels)
    for axes, members in by_axes.items():
        joints = [joint for joint, _ in members]
        columns = np.array([turns for _, turns in members])
        local_unitquat[:, joints] = unitquat_from_euler(np.deg2rad(values[:, columns]), axes)
    return SourceMotion(
        skeleton=skeleton,
        rest_offsets=rest_offsets,
        root_translation=root_translation,
        local_unitquat=local_unitquat,
        end_sites=header.end_sites,
        rate_hz=header.rate_hz,
    )


class Bvh(MotionFormat):
    """BVH: a hierarchy and Euler angles.  It states its rate, rounded; never its unit, nor which axis points up."""

    name = "bvh"
    recognised_by = "starts with HIERARCHY"
    suffixes = (".bvh",)

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file starts with the word HIERARCHY."""
        return start.text[:9].upper() == "HIERARCHY" and not start.text[9:10].isalnum()

    def read(self, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read everything."""
        return read_bvh(data)

    def read_head(self, data: bytes, companion: bytes = b"") -> MotionHead:
        """Read the hierarchy, and check the motion block without converting its numbers."""
        header = read_bvh_header(data)
        rest = SourceMotion.at_rest(header.skeleton, header.rest_offsets, rate_hz=header.rate_hz)
        return MotionHead(rest=rest, num_frames=header.num_frames)


def rate_from_frame_time(token: str) -> float:
    """Return the frame rate that a frame time means as written.

    Files cut the time to a few digits: 0.0333 is 30 Hz and 0.008333 is 120 Hz.  If exactly one whole number of frames
    per second rounds or cuts to these digits it is meant; otherwise the inverse is (0.033367 is 29.97 Hz).
    """
    time = float(token)
    mantissa, _, exponent = token.lower().partition("e")
    num_decimals = len(mantissa.partition(".")[2]) - (int(exponent) if exponent else 0)
    step = max(10.0**-num_decimals, time * 1e-12)
    lowest, highest = 1.0 / (time + step), 1.0 / max(time - step, time * 1e-3)
    first, last = np.ceil(lowest), np.floor(highest)
    return float(first) if first == last and first > 0 else 1.0 / time


class _HierarchyParser:
    """Reads the lines of a HIERARCHY one by one; a stack of open blocks takes the place of recursion."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float] | None] = []
        self.channels: list[tuple[str, ...] | None] = []
        self.is_end: list[bool] = []
        self.open: list[int] = []
        self.is_brace_due = False
        self.is_started = False
        self.is_root_closed = False

    def read(self, line: str, number: int) -> None:
        """Read one line."""
        words = line.replace("{", " { ").replace("}", " } ").split()
        while words:
            word = words.pop(0)
            key = word.upper()
            if key == "{":
                self._brace(number)
                continue
            if self.is_brace_due:
                raise FormatError(f"line {number}: '{{' is expected after '{self.names[-1]}', found '{shorten(word)}'")
            if key == "}":
                self._close(number)
            elif key == "HIERARCHY":
                if self.is_started:
                    raise FormatError(f"line {number}: a second HIERARCHY; a file holds one person")
                self.is_started = True
            elif not self.is_started:
                raise FormatError(f"line {number}: a BVH file starts with HIERARCHY, found '{shorten(word)}'")
            elif key in {"ROOT", "JOINT"}:
                stop = words.index("{") if "{" in words else len(words)
                self._joint(key, " ".join(words[:stop]), number)
                del words[:stop]
            elif key == "END":
                if not words or words.pop(0).upper() != "SITE":
                    raise FormatError(f"line {number}: 'End Site' is expected, found '{shorten(line.strip())}'")
                self._end_site(number)
            elif key == "OFFSET":
                self._offset(words[:3], number)
                del words[:3]
            elif key == "CHANNELS":
                del words[: self._channels(words, number)]
            else:
                raise FormatError(
                    f"line {number}: '{shorten(word)}' is not known here; "
                    "allowed: ROOT, JOINT, End Site, OFFSET, CHANNELS, braces, MOTION"
                )

    def _brace(self, number: int) -> None:
        if not self.is_brace_due:
            raise FormatError(f"line {number}: a '{{' that opens nothing")
        self.is_brace_due = False
        self.open.append(len(self.names) - 1)

    def _close(self, number: int) -> None:
        if not self.open:
            raise FormatError(f"line {number}: a '}}' that closes nothing")
        joint = self.open.pop()
        if self.offsets[joint] is None:
            raise FormatError(f"line {number}: '{self.names[joint]}' has no OFFSET")
        self.is_root_closed = not self.open

    def _joint(self, key: str, name: str, number: int) -> None:
        if not name:
            raise FormatError(f"line {number}: {key} without a name")
        if key == "ROOT" and self.names:
            raise FormatError(f"line {number}: a second ROOT '{shorten(name)}'; a file holds one person")
        if key == "JOINT" and not self.open:
            raise FormatError(f"line {number}: JOINT '{shorten(name)}' is outside of the ROOT")
        self._add(name, number, is_end=False)

    def _end_site(self, number: int) -> None:
        if not self.open:
            raise FormatError(f"line {number}: an End Site outside of the ROOT")
        base = f"{self.names[self.open[-1]]}_end"
        name, copy = base, 1
        while name in self.names:
            copy += 1
            name = f"{base}{copy}"
        self._add(name, number, is_end=True)

    def _add(self, name: str, number: int, *, is_end: bool) -> None:
        if self.open and self.is_end[self.open[-1]]:
            raise FormatError(f"line {number}: an End Site cannot hold '{shorten(name)}'")
        if name in self.names:
            raise FormatError(f"line {number}: a second joint with the name '{shorten(name)}'")
        if len(self.names) >= MAX_JOINTS:
            raise FormatError(f"line {number}: more than {MAX_JOINTS} joints")
        self.names.append(name)
        self.parents.append(self.open[-1] if self.open else -1)
        self.offsets.append(None)
        self.channels.append(() if is_end else None)
        self.is_end.append(is_end)
        self.is_brace_due = True

    def _offset(self, words: list[str], number: int) -> None:
        if not self.open:
            raise FormatError(f"line {number}: OFFSET outside of a joint")
        joint = self.open[-1]
        if len(words) != 3:
            raise FormatError(f"line {number}: OFFSET of '{self.names[joint]}' needs 3 numbers, found {len(words)}")
        if self.offsets[joint] is not None:
            raise FormatError(f"line {number}: a second OFFSET for '{self.names[joint]}'")
        self.offsets[joint] = [parse_number(word, f"line {number}: OFFSET of '{self.names[joint]}'") for word in words]

    def _channels(self, words: list[str], number: int) -> int:
        if not self.open or self.is_end[self.open[-1]]:
            raise FormatError(f"line {number}: CHANNELS outside of a joint")
        joint = self.open[-1]
        name = self.names[joint]
        if self.channels[joint] is not None:
            raise FormatError(f"line {number}: a second CHANNELS for '{name}'")
        if not words:
            raise FormatError(f"line {number}: CHANNELS of '{name}' without a number")
        count = parse_integer(words[0], f"line {number}: CHANNELS of '{name}'")
        listed = words[1 : count + 1] if 0 <= count <= 6 else []
        if not 0 <= count <= 6 or len(listed) != count:
            raise FormatError(f"line {number}: CHANNELS of '{name}' states {count} channels but lists {len(words) - 1}")
        channels = tuple(word[:1].upper() + word[1:].lower() for word in listed)
        for channel in channels:
            if channel[:1] not in {"X", "Y", "Z"} or channel[1:] not in {"position", "rotation"}:
                raise FormatError(
                    f"line {number}: channel '{shorten(channel)}' of '{name}' is not known; "
                    "allowed: X, Y or Z followed by position or rotation"
                )
        if len(set(channels)) != len(channels):
            raise FormatError(f"line {number}: a channel of '{name}' is listed twice")
        self.channels[joint] = channels
        return count + 1


def _parse_hierarchy(lines: list[str]) -> tuple[BvhHierarchy, int]:
    """Return the hierarchy and the number of lines up to MOTION, or all of them when there is none."""
    parser = _HierarchyParser()
    num_lines = len(lines)
    for index, line in enumerate(lines):
        if line.strip().upper() == "MOTION":
            num_lines = index
            break
        parser.read(line, index + 1)
    if not parser.is_root_closed or parser.is_brace_due:
        what = f"'{parser.names[parser.open[-1]]}' is not closed" if parser.open else "there is no complete ROOT"
        raise FormatError(f"line {min(num_lines + 1, len(lines))}: the hierarchy ends but {what}")
    kept = [
        joint
        for joint in range(len(parser.names))
        if not (parser.is_end[joint] and not any(parser.offsets[joint] or [0.0]))
    ]
    place = {joint: index for index, joint in enumerate(kept)}
    try:
        skeleton = Skeleton(
            name="bvh",
            joint_names=tuple(parser.names[joint] for joint in kept),
            parents=tuple(place.get(parser.parents[joint], -1) for joint in kept),
        )
    except InputError as error:
        raise FormatError(str(error)) from None
    hierarchy = BvhHierarchy(
        skeleton=skeleton,
        rest_offsets=np.array([parser.offsets[joint] for joint in kept], dtype=np.float64),
        channels=tuple(parser.channels[joint] or () for joint in kept),
        end_sites=frozenset(parser.names[joint] for joint in kept if parser.is_end[joint]),
    )
    if hierarchy.num_channels == 0:
        raise FormatError("no joint of this BVH file has channels")
    return hierarchy, num_lines


def _parse_header(lines: list[str]) -> BvhHeader:
    hierarchy, motion = _parse_hierarchy(lines)
    if motion == len(lines):
        raise FormatError(f"line {len(lines)}: the file ends without MOTION")
    frames_line, frames_text = _next_line(lines, motion + 1, "Frames:")
    num_frames = parse_integer(frames_text, f"line {frames_line}: Frames")
    if num_frames < 1:
        raise FormatError(f"line {frames_line}: the file states {num_frames} frames; at least 1 is needed")
    time_line, time_text = _next_line(lines, frames_line, "Frame Time:")
    frame_time = parse_number(time_text, f"line {time_line}: Frame Time")
    if not MIN_FRAME_TIME_S <= frame_time <= MAX_FRAME_TIME_S:
        raise FormatError(
            f"line {time_line}: the frame time is {frame_time:g} s; "
            f"allowed: {MIN_FRAME_TIME_S:g} to {MAX_FRAME_TIME_S:g}"
        )
    return BvhHeader(
        **vars(hierarchy), num_frames=num_frames, rate_hz=rate_from_frame_time(time_text), first_line=time_line + 1
    )


def _next_line(lines: list[str], index: int, label: str) -> tuple[int, str]:
    """Return the line number and the text after `label` of the next line that is not empty."""
    while index < len(lines) and not lines[index].strip():
        index += 1
    text = " ".join(lines[index].split()) if index < len(lines) else ""
    if not text.upper().startswith(label.upper()):
        raise FormatError(f"line {index + 1}: '{label}' is expected, found '{shorten(text)}'")
    return index + 1, text[len(label) :].strip()


def _check_rows(header: BvhHeader, rows: list[str]) -> None:
    """Refuse a motion block with the wrong number of frames or values, with words or absurd powers of ten in it."""
    count = 0
    for index, row in enumerate(rows):
        num_values = len(row.split())
        if num_values == 0:
            continue
        number = header.first_line + index
        if _NOT_A_DECIMAL.search(row):
            for column, token in enumerate(row.split()):
                parse_number(token, f"line {number}, {_channel_name(header, column)}")
        if num_values != header.num_channels:
            raise FormatError(
                f"line {number}: frame {count} has {num_values} values, "
                f"but the hierarchy has {header.num_channels} channels"
            )
        count += 1
        if count > header.num_frames:
            raise FormatError(f"line {number}: more frames than the {header.num_frames} that 'Frames:' states")
    if count < header.num_frames:
        raise FormatError(
            f"line {header.first_line + len(rows) - 1}: the file ends after {count} of {header.num_frames} frames"
        )


def _parse_rows(header: BvhHeader, rows: list[str]) -> Array:
    try:
        values = np.array(" ".join(rows).split(), dtype=np.float64)
        is_fine = bool(np.all(np.abs(values) <= MAX_MAGNITUDE))
    except ValueError:
        is_fine = False
    if not is_fine:
        for index, row in enumerate(rows):
            for column, token in enumerate(row.split()):
                parse_number(token, f"line {header.first_line + index}, {_channel_name(header, column)}")
        raise FormatError("the motion block holds values that are not numbers")
    return values.reshape(header.num_frames, header.num_channels)


def _channel_name(header: BvhHeader, column: int) -> str:
    for name, channels in zip(header.skeleton.joint_names, header.channels, strict=True):
        if column < len(channels):
            return f"{channels[column]} of '{name}'"
        column -= len(channels)
    return "a value beyond the last channel"


def _still_offset(name: str, place: Array, first_line: int) -> Array:
    """Return the mean of a joint's own positions, or refuse a joint that moves against its parent."""
    mean = place.mean(axis=0)
    slide = np.linalg.norm(place - mean, axis=1)
    worst = int(np.argmax(slide))
    if slide[worst] > MAX_JOINT_SLIDE * max(float(np.linalg.norm(mean)), 1e-9):
        raise FormatError(
            f"line {first_line + worst}: joint '{name}' moves by {slide[worst]:.3g} units against its parent in "
            f"frame {worst}; bones must keep their length"
        )
    return mean
