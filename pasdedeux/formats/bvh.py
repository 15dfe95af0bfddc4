"""Reading BVH motion files, and bare rows of joint angles over a BVH template.

The package pybvh 0.9 is not used: it reads from a path only, gives no line numbers for faults in the motion block, and
refuses joints with position channels or without three rotation channels.  The tests use it as an independent oracle.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from itertools import count

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.bvh_body import BvhHierarchy
from pasdedeux.formats.file_format import FileStart, MotionFormat, MotionHead
from pasdedeux.formats.poses2d.yolo import YOLO
from pasdedeux.formats.rates import rate_from_frame_time
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import Lines, compare_count, decode, parse_integer, parse_number, parse_numbers, shorten
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import Skeleton

MAX_JOINTS = 1000
"""A file with more joints is damaged: the largest rigs in use have a few hundred."""
MIN_FRAME_TIME_S, MAX_FRAME_TIME_S = 1e-5, 10.0

_COMMENT = ("#", "//", ";")

_BEGINNING = re.compile(r"^[ \t]*HIERARCHY(?!\w)", re.IGNORECASE | re.MULTILINE)
"""Beginning of the hierarchy; lines that some programs write before it are skipped."""
_MOTION = re.compile(r"^[ \t]*MOTION[ \t]*$", re.IGNORECASE)
_MOTION_AND_MORE = re.compile(r"\bMOTION[ \t]+\S", re.IGNORECASE)
_MOTION_BYTES = re.compile(rb"\}\s*\n[ \t]*MOTION[ \t\r]*$", re.IGNORECASE | re.MULTILINE)
"""End of the hierarchy, on a line of its own."""
_FRAME_TIME = re.compile(rb"Frame\s*Time\s*:\s*\S+", re.IGNORECASE)
_NUMBERS = b"0123456789+-.eE \t\r\n"
_LARGE_BYTES, _NUM_SAMPLED = 2_000_000, 2000
"""Minimum size of a file whose head is read from a sample of its frames, and the approximate size of the sample."""
_SCALES = {"Xscale": "1", "Yscale": "2", "Zscale": "3"}
_CHANNELS = {f"{axis}position": axis.lower() for axis in "XYZ"} | {f"{axis}rotation": axis for axis in "XYZ"} | _SCALES
"""Letter of each channel."""
_MAX_SCALED = 1e-3
"""Largest difference of a scale from 1 that counts as rounding."""
_COMMAS, _POINTS = (re.compile(rf"(?<!\S)[-+]?\d+{mark}\d+(?:[eE][-+]?\d+)?(?!\S)") for mark in (",", r"\."))


@dataclass(frozen=True)
class _BvhFile:
    """Content of a BVH file: joints, values (frame, sum of channels), rate, and notes for the user."""

    hierarchy: BvhHierarchy
    values: Array
    rate_hz: float
    notes: tuple[str, ...]

    def motion(self, person: int, *, is_head: bool = False) -> SourceMotion:
        hierarchy, values = self.hierarchy, self.values
        return hierarchy.motion(values, person=person, rate_hz=self.rate_hz, notes=self.notes, is_head=is_head)


def read_bvh(data: bytes | str, person: int = 0) -> SourceMotion:
    """Read one person of a BVH file.  End Sites without an offset are dropped."""
    return _read(data).motion(person)


def read_bvh_joints(data: bytes | str) -> tuple[float | None, list[tuple[Skeleton, Array]]]:
    """Read the frame rate of a BVH file, and for each ROOT its joints and their positions (frame, J, 3), file units."""
    file, trees = _read(data), []
    skeleton, places = file.hierarchy.skeleton, file.hierarchy.positions(file.values)
    is_several = skeleton.joint_names[skeleton.root] == _SEVERAL
    for root in skeleton.children(skeleton.root) if is_several else (skeleton.root,):
        kept = skeleton.branch(root)
        parents = tuple(kept.index(skeleton.parents[joint]) if joint != root else -1 for joint in kept)
        names = tuple(skeleton.joint_names[joint] for joint in kept)
        trees.append((Skeleton(skeleton.name, names, parents), places[:, kept]))
    return file.rate_hz, trees


def read_bvh_head(data: bytes | str, person: int = 0) -> MotionHead:
    """Read a BVH file without converting its rotations, which takes most of the time.

    Of a file larger than 2 MB about 2000 frames are read; only `read_bvh` finds faults in the others.

    Raises:
        FormatError: As `read_bvh`.
    """
    if isinstance(data, bytes) and len(data) > _LARGE_BYTES and (sampled := _sample(data, person)):
        return sampled
    file = _read(data)
    return MotionHead(file.motion(person, is_head=True), len(file.values))


def _sample(data: bytes, person: int) -> MotionHead | None:
    """Read the head of a large file from some of its frames, evenly spread.

    Returns None if the file must be read as a whole: if there is anything but numbers among the frames, a line is not a
    frame, or there is a fault.
    """
    frame_time = _FRAME_TIME.search(data, 0, _LARGE_BYTES)
    if frame_time is None:
        return None
    lines, step = BytesIO(data), data.count(b"\n", frame_time.end()) // _NUM_SAMPLED + 1
    lines.seek(frame_time.end())
    kept: list[bytes] = []
    last, num_frames = b"", 0
    for line in lines:
        if line.translate(None, _NUMBERS):
            return None
        if not line.isspace():
            kept += [line] if num_frames % step == 0 else []
            last, num_frames = line, num_frames + 1
    kept += [last] if num_frames % step != 1 % step else []  # may be cut off
    try:
        file = _read(b"\n".join([data[: frame_time.end()], *kept]), num_frames)
        is_whole = len(file.values) == len(kept)
        return MotionHead(file.motion(person, is_head=True), num_frames) if is_whole else None
    except FormatError:  # its line number is of the sample
        return None


def read_rotation_rows(data: bytes | str, template: bytes | str) -> SourceMotion:
    """Read rows of angles over a BVH template, as the projection database of Yiannakides et al. (2019) ships.

    Each line is a frame.  It has three Euler angles in degrees for every joint, in the order of the template and of the
    joint's rotation channels.  The root stays at the template's OFFSET.
    """
    hierarchy = _read_template(template)
    with Lines(data, "file of rotation rows") as lines:
        return hierarchy.motion(_read_rows(hierarchy, lines))


def _hierarchy(data: bytes) -> BvhHierarchy:
    """Read the joints of a file, but not its frames."""
    end = _MOTION_BYTES.search(data)
    with Lines(_with_points(decode(data[: end.end() if end else None], "BVH file")), "BVH file") as lines:
        return _read_hierarchy(lines)


def _read_template(template: bytes | str) -> BvhHierarchy:
    with Lines(template, "BVH template") as lines:
        hierarchy = _read_hierarchy(lines)
    turns = tuple("".join(letter for letter in letters if letter in "XYZ") for letters in hierarchy.channels)
    if any(letters and len(angles) != 3 for letters, angles in zip(hierarchy.channels, turns, strict=True)):
        raise FormatError("the template of rotation rows needs three rotation channels for every joint")
    return replace(hierarchy, channels=turns)


def _read_rows(hierarchy: BvhHierarchy, lines: Lines) -> Array:
    """Return the values (frame, sum of channels) in the remaining lines."""
    names = {letter: channel for channel, letter in _CHANNELS.items()}
    joints = zip(hierarchy.skeleton.joint_names, hierarchy.channels, strict=True)
    columns = [f"{names[letter]} of '{joint}'" for joint, letters in joints for letter in letters]
    return lines.numbers(columns, _COMMENT)


BVH = MotionFormat(
    name="bvh",
    suffixes=(".bvh",),
    recognises=lambda start: _BEGINNING.search(start.text) is not None,
    read=lambda data, companion: read_bvh(data),
    head=lambda data, companion: read_bvh_head(data),
    read_other=lambda data, companion, person: read_bvh(data, person),
    count_people=lambda data: _hierarchy(data).num_people,
)
"""A hierarchy and Euler angles.  It states its rate, rounded, but neither unit nor up axis."""


def _is_rows(start: FileStart) -> bool:
    """Return whether the first line has at least three triples of numbers."""
    words = start.first_row.split()
    is_numbers = len(words) >= 9 and len(words) % 3 == 0 and all(re.fullmatch(r"[-+0-9.eE]+", word) for word in words)
    return is_numbers and not YOLO.recognises(start)


ROTATION_ROWS = MotionFormat(
    name="rotation_rows",
    suffixes=(),
    recognises=_is_rows,
    read=read_rotation_rows,
    companion="BVH template",
    check_companion=_read_template,
    companion_names=lambda name: ("template.bvh", "../template.bvh"),
)
"""Rows of angles over a BVH template; they state neither rate, unit nor up axis."""


_SEVERAL = "(file)"
"""Name of the joint that is added above several roots."""


@dataclass
class _Joint:
    """A joint while it is read."""

    name: str
    parent: str
    is_end: bool
    offset: list[float] | None = None
    channels: str | None = None

    def allowed(self) -> list[str]:
        """Return the tokens allowed next in the block."""
        words = ["OFFSET" if self.offset is None else "}"]
        if self.channels is None and not self.is_end:
            words.append("CHANNELS")
        return words if self.is_end else [*words, "JOINT", "END"]


def _read_hierarchy(lines: Lines) -> BvhHierarchy:
    """Read up to the line MOTION, or all lines of a template; cached, because many files of one rig are read."""
    head = lines.up_to(_MOTION)
    if _MOTION_AND_MORE.search(head):  # the cache would lose the rest of that line
        return _parse_hierarchy(lines)
    try:
        hierarchy, lines.number = _known_hierarchy(head, lines.number)
    except FormatError:  # parse again for the line number
        hierarchy = _parse_hierarchy(lines)
    return hierarchy


@lru_cache(maxsize=64)
def _known_hierarchy(head: str, number: int) -> tuple[BvhHierarchy, int]:
    """Return the joints in some lines, the first of which is `number` + 1, and the number of the last line."""
    lines = Lines(head, "BVH file")
    hierarchy = _parse_hierarchy(lines)
    return hierarchy, number + lines.number


def _parse_hierarchy(lines: Lines) -> BvhHierarchy:
    joints: dict[str, _Joint] = {}
    blocks: list[_Joint] = []
    lines.skip_to(_BEGINNING)
    allowed = ["HIERARCHY"]
    num_roots = 0
    for line in lines.words():
        words = _tokens(line)
        while words:
            key = words[0].upper()
            if words[0].startswith(_COMMENT):
                break
            if key not in allowed:
                where = f" in '{blocks[-1].name}'" if blocks else ""
                shown = shorten(" ".join(words))
                raise FormatError(f"'{shown}' is not expected{where}; allowed: {', '.join(allowed)}")
            del words[0]
            match key:
                case "HIERARCHY":
                    allowed = ["ROOT"]
                    continue
                case "ROOT" | "JOINT" | "END":
                    num_roots += key == "ROOT"
                    _continue(lines, words, 1, lambda word: word not in "{}")
                    marks = ("{", "#", "//", ";")
                    stop = next((at for at, word in enumerate(words) if word in marks), len(words))
                    name = " ".join(words[:stop]) if key != "END" else _end_name(blocks[-1].name, joints)
                    if num_roots > 1 and name in joints:  # another person of the same rig
                        name = f"{num_roots}:{name}"
                    if not name or name in joints or len(joints) == MAX_JOINTS:
                        why = "has no name" if not name else f"'{shorten(name)}' is the second or one too many"
                        raise FormatError(f"this {key} {why}; allowed: {MAX_JOINTS} joints with names of their own")
                    joints[name] = _Joint(name, blocks[-1].name if blocks else "", key == "END")
                    blocks.append(joints[name])
                    del words[:stop]
                    allowed = ["{"]
                    continue
                case "OFFSET":
                    _continue(lines, words, 3, lambda word: word[0] in "+-.0123456789")
                    blocks[-1].offset = parse_numbers(words[:3], f"OFFSET of '{blocks[-1].name}'", 3)
                    del words[:3]
                case "CHANNELS":
                    _continue(lines, words, 1, str.isdigit)
                    num_words = 1 + int(words[0]) if words and words[0].isdigit() else 1
                    _continue(lines, words, num_words, lambda word: word.capitalize() in _CHANNELS)
                    blocks[-1].channels = _pop_channels(words, blocks[-1].name)
                case "}":
                    blocks.pop()
                case "MOTION":
                    if words:
                        lines.put_back(" ".join(words))
                    return _hierarchy_of(joints)
            allowed = blocks[-1].allowed() if blocks else ["MOTION", "ROOT"]
    if allowed != ["MOTION", "ROOT"]:
        raise FormatError(f"the file ends where {' or '.join(allowed)} is needed")
    return _hierarchy_of(joints)


def _tokens(words: list[str]) -> list[str]:
    return " ".join(words).replace("{", " { ").replace("}", " } ").split()


def _continue(lines: Lines, words: list[str], count: int, fits: Callable[[str], bool]) -> None:
    """Append words of the next lines, up to a count, while each line begins with a word that fits."""
    while len(words) < count and (line := next(lines.words(), [])):
        more = _tokens(line)
        if not fits(more[0]):
            lines.put_back(" ".join(more))
            break
        words += more


def _end_name(parent: str, joints: Collection[str]) -> str:
    """Return an unused name for an End Site."""
    names = (f"{parent}_end{copy if copy > 1 else ''}" for copy in count(1))
    return next(name for name in names if name not in joints)


def _pop_channels(words: list[str], joint: str) -> str:
    """Remove the count and list of channels from the words, and return the letters of the channels."""
    what = f"CHANNELS of '{joint}'"
    num_channels = parse_integer(words[0] if words else "", what, 0, len(_CHANNELS))
    listed = [word.capitalize() for word in words[1 : num_channels + 1]]
    if len(listed) != num_channels:
        raise FormatError(f"{what} states {counted(num_channels, 'channel')} but lists {len(listed)}")
    for channel in listed:
        if channel not in _CHANNELS or listed.count(channel) > 1:
            known = ", ".join(_CHANNELS)
            raise FormatError(f"channel '{shorten(channel)}' of '{joint}' is not known or there twice; known: {known}")
    del words[: num_channels + 1]
    return "".join(_CHANNELS[channel] for channel in listed)


def _hierarchy_of(joints: Mapping[str, _Joint]) -> BvhHierarchy:
    kept = [joint for joint in joints.values() if not joint.is_end or any(joint.offset or ())]
    if not any(joint.channels for joint in kept):
        raise FormatError("no joint of this BVH file has channels")
    if sum(not joint.parent for joint in kept) > 1:
        first = _Joint(_SEVERAL, "", is_end=False, offset=[0.0, 0.0, 0.0])
        kept = [first, *(replace(joint, parent=joint.parent or _SEVERAL) for joint in kept)]
    names = [joint.name for joint in kept]
    parents = tuple(names.index(joint.parent) if joint.parent else -1 for joint in kept)
    return BvhHierarchy(
        skeleton=Skeleton(name="bvh", joint_names=tuple(names), parents=parents),
        rest_offsets=np.array([joint.offset for joint in kept]),
        channels=tuple(joint.channels or "" for joint in kept),
        end_sites=frozenset(joint.name for joint in kept if joint.is_end),
    )


def _read(data: bytes | str, num_held: int | None = None) -> _BvhFile:
    """Read a file, or a sample of one with `num_held` frames; the last few small files are cached."""
    return _read_small(data) if num_held is None and len(data) <= _LARGE_BYTES else _read_all(data, num_held)


@lru_cache(maxsize=4)
def _read_small(data: bytes | str) -> _BvhFile:
    return _read_all(data, None)


def _read_all(data: bytes | str, num_held: int | None) -> _BvhFile:
    decoded = decode(data, "BVH file")
    text = _with_points(decoded)
    with Lines(text, "BVH file") as lines:
        hierarchy = _read_hierarchy(lines)
        num_frames = parse_integer(_stated(lines, "Frames:"), "the number of frames")
        frame_time = _stated(lines, "Frame Time:")
        parse_number(frame_time, "the frame time in seconds", MIN_FRAME_TIME_S, MAX_FRAME_TIME_S)
        values = _read_rows(hierarchy, lines)
        counted = compare_count(num_frames, num_held or len(values))
    hierarchy, values = _without_scales(hierarchy, values)
    rate_hz, note = rate_from_frame_time(frame_time)
    notes = counted, note, "its decimal commas are read as points" if text != decoded else ""
    return _BvhFile(hierarchy, values, rate_hz, tuple(filter(None, notes)))


def _with_points(text: str) -> str:
    """Replace decimal commas by points if the text has no decimal point."""
    if "," in text and _COMMAS.search(text) and not _POINTS.search(text):
        return _COMMAS.sub(lambda number: number[0].replace(",", "."), text)
    return text


def _without_scales(hierarchy: BvhHierarchy, values: Array) -> tuple[BvhHierarchy, Array]:
    """Remove the scale channels from joints and values; all scales must be 1."""
    joints = zip(hierarchy.skeleton.joint_names, hierarchy.channels, strict=True)
    columns = [(joint, letter) for joint, letters in joints for letter in letters]
    is_scale = np.array([letter in _SCALES.values() for _, letter in columns])
    if not is_scale.any():
        return hierarchy, values
    for frame, column in np.argwhere((np.abs(values - 1.0) > _MAX_SCALED) & is_scale)[:1]:
        raise FormatError(
            f"frame {frame}: joint '{columns[column][0]}' is scaled by {values[frame, column]:g}; bones keep their "
            "size here: export the motion without scales"
        )
    turns = tuple("".join(letter for letter in letters if letter.isalpha()) for letters in hierarchy.channels)
    return replace(hierarchy, channels=turns), values[:, ~is_scale]


def _stated(lines: Lines, label: str) -> str:
    """Return the word after a label at the start of the next line; put the rest of the line back."""
    pattern = label.replace(" ", r"\s*").replace(":", r"\s*:\s*") + r"(\S+)"
    text, stated = "", None
    for words in lines.words():
        if not words[0].startswith(_COMMENT):
            text = f"{text} {' '.join(words)}".strip()
            stated = re.match(pattern, text, re.IGNORECASE)
        if stated or len(text) > len(label):
            break
    if not stated:
        raise FormatError(f"'{label}' is expected, found '{shorten(text)}'")
    if rest := text[stated.end() :].strip():
        lines.put_back(rest)
    return stated[1]
