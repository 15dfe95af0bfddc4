"""Reading ASF (skeleton) and AMC (motion) files of the Acclaim format, as the CMU motion capture database uses them.

Meaning of the numbers (J. Lander, "Working with motion capture file formats", Game Developer, January 1998): a bone
turns at its start and reaches along `direction` for `length` in the rest pose's world axes.  With C the rotation of its
`axis` entry and M that of its AMC angles (first angle of `dof` applied first), it turns against its parent by C M C^-1.
We make one joint per bone, at the bone's start and with the bone's name, and a `<bone>_end` for each leaf.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.euler import turn_joints, unitquat_from_euler
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import (
    MAX_MAGNITUDE,
    Lines,
    floats_of,
    parse_integer,
    parse_number,
    parse_numbers,
    shorten,
)
from pasdedeux.kinematics.rotations import conjugate, multiply
from pasdedeux.skeletons import Skeleton

METRES_PER_INCH = 0.0254
MAX_BONES = 500
_DOF = {"rx": "X", "ry": "Y", "rz": "Z", "tx": "x", "ty": "y", "tz": "z"}
"""Letter of each degree of freedom; only the root has translations."""


@dataclass(frozen=True)
class AsfSkeleton:
    """A skeleton read from an ASF file.

    Args:
        skeleton: One joint per bone at the bone's start, the root first, and an end joint per leaf.
        rest_offsets: Offset of each joint from its parent, (J, 3), file units.
        axis_unitquat: Rotation C of each joint's axis entry, (J, 4).
        dof: For each joint its degrees of freedom in the order of the AMC file: X, Y, Z turn; x, y, z move.
        root_position: Added to the root's translation, (3,), file units.
        metres_per_unit: 0.0254 m divided by the file's `length` unit.
        is_degrees: The file's angle unit; an AMC may state its own.
    """

    skeleton: Skeleton
    rest_offsets: Array
    axis_unitquat: Array
    dof: tuple[str, ...]
    root_position: Array
    metres_per_unit: float
    is_degrees: bool


@dataclass
class _Bone:
    """A bone while it is read; `direction` of the root is its position."""

    name: str = ""
    direction: Array = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    angles: Array = field(default_factory=lambda: np.zeros(3))
    order: str = "XYZ"
    dof: str = ""
    num_limits: int = 0
    keys: set[str] = field(default_factory=set)

    def read(self, key: str, values: list[str]) -> None:
        """Read one entry of the bone."""
        what = f"{key} of '{self.name}'"
        self.keys.add(key)
        match key:
            case "name":
                self.name = " ".join(values)
            case "direction" | "position":
                self.direction = np.array(parse_numbers(values, what, 3))
            case "length":
                (self.length,) = parse_numbers(values, what, 1)
            case "orientation":
                self.angles = np.array(parse_numbers(values, what, 3))
            case "axis":  # of a bone angles and their order, of the root the order alone
                if len(values) > 1:
                    self.angles = np.array(parse_numbers(values[:3], what, 3))
                self.order = "".join(values[3:] or values).upper()
                if sorted(self.order) != ["X", "Y", "Z"]:
                    raise FormatError(f"the axis order is '{shorten(self.order)}'; it is a permutation of XYZ")
            case "dof" | "order":
                allowed, listed = list(_DOF)[: 3 if key == "dof" else 6], [value.lower() for value in values]
                for value in listed:
                    if value not in allowed or listed.count(value) > 1:
                        fault = f"the degree of freedom '{shorten(value)}' of '{self.name}'"
                        raise FormatError(f"{fault} is not known or there twice; allowed: {', '.join(allowed)}")
                self.dof = "".join(_DOF[value] for value in listed)
            case "id" | "bodymass" | "cofmass":
                pass
            case _ if "limits" in self.keys:  # of the joint, over several lines; nothing here uses them
                numbers = " ".join([key, *values]).removeprefix("limits").replace("(", " ").replace(")", " ")
                self.num_limits += len(numbers.split())
            case _:
                raise FormatError(
                    f"bone '{self.name}': '{shorten(key)}' is not known; "
                    "allowed: id, name, direction, length, axis, dof, limits"
                )

    def check(self) -> None:
        """Refuse an incomplete bone, and normalise its direction."""
        what, norm = f"bone '{shorten(self.name)}'", float(np.linalg.norm(self.direction))
        if not self.name or not {"direction", "length", "axis"} <= self.keys:
            raise FormatError(f"{what} needs a name, a direction, a length and an axis")
        if self.length < 0 or (self.length > 0 and not 0.5 < norm < 2.0):
            wrong = f"length {self.length:g} along a direction of length {norm:g}"
            raise FormatError(f"{what} has {wrong}; allowed: 0 or more along one of length 1")
        self.direction = self.direction / norm if norm > 0 else self.direction
        if self.num_limits not in (0, 2 * len(self.dof)):
            raise FormatError(
                f"{what} has {len(self.dof)} degrees of freedom but {self.num_limits} numbers in its limits"
            )


def read_asf(data: bytes | str) -> AsfSkeleton:
    """Read an ASF file."""
    with Lines(data, "ASF file") as lines:
        return _read_asf(lines)


def _read_asf(lines: Lines) -> AsfSkeleton:
    root = _Bone("root")
    bones, parent_of = {"root": root}, {"root": ""}
    sections: list[str] = [""]
    bone: _Bone | None = None
    length_unit, is_degrees = 1.0, True
    for words in lines.words("#"):
        if words[0].startswith(":"):
            sections.append(words.pop(0)[1:].lower())
            if sections.count(sections[-1]) > 1:
                raise FormatError(f"a second section ':{shorten(sections[-1])}'")
        key, values = "".join(words[:1]).lower(), words[1:]
        match sections[-1], key:
            case "", _:
                raise FormatError(f"an ASF file starts with a section such as ':version', found '{shorten(key)}'")
            case _, "":
                pass
            case "units", "length":
                length_unit = parse_number(" ".join(values), "the length unit", 1e-4, 1e4)
            case "units", "angle":
                unit = " ".join(values).lower()
                if unit not in ("deg", "rad"):
                    raise FormatError(f"the angle unit is '{shorten(unit)}'; allowed: deg, rad")
                is_degrees = unit == "deg"
            case "root", _:
                root.read(key, values)
            case "bonedata", "begin" if bone is None:
                bone = _Bone()
            case "bonedata", "end" if bone is not None:
                bone.check()
                if bone.name in bones or len(bones) > MAX_BONES:
                    raise FormatError(f"bone '{shorten(bone.name)}' is the second of this name, or one too many")
                bones[bone.name], bone = bone, None
            case "bonedata", _ if bone is not None:
                bone.read(key, values)
            case "bonedata", _:
                raise FormatError(f"'begin' is expected, found '{shorten(key)}'")
            case "hierarchy", _ if words not in (["begin"], ["end"]):
                for name in words:
                    if name not in bones:
                        raise FormatError(f"bone '{shorten(name)}' is not in ':bonedata'")
                for child in values:
                    if child in parent_of:
                        raise FormatError(f"bone '{shorten(child)}' has a second parent '{words[0]}'")
                    parent_of[child] = words[0]
    for needed in ("units", "root", "bonedata", "hierarchy"):
        if needed not in sections:
            raise FormatError(f"this ASF file has no section ':{needed}'")
    if not root.dof or bone is not None:
        raise FormatError("this ASF file has a root without 'order' or a bone without 'end'")
    joints, stack = [], ["root"]
    while stack:
        name = stack.pop()
        children = [child for child in bones if parent_of.get(child) == name]
        joints.append((name, parent_of[name], bones[name]))
        if not children:
            joints.append((f"{name}_end", name, _Bone()))
        stack += children[::-1]
    names = [name for name, _, _ in joints]
    for name in bones:
        if name not in names:
            raise FormatError(f"bone '{shorten(name)}' has no parent in ':hierarchy' that leads to the root")
    angle_unit = np.pi / 180.0 if is_degrees else 1.0
    turns = [unitquat_from_euler(bone.angles[::-1] * angle_unit, bone.order[::-1]) for _, _, bone in joints]
    starts = [bones[parent] if parent not in ("", "root") else _Bone() for _, parent, _ in joints]
    return AsfSkeleton(
        skeleton=Skeleton("asf", tuple(names), tuple(names.index(parent) if parent else -1 for _, parent, _ in joints)),
        rest_offsets=np.array([bone.direction * bone.length for bone in starts]),
        axis_unitquat=np.array(turns),
        dof=tuple(bone.dof for _, _, bone in joints),
        root_position=root.direction,
        metres_per_unit=METRES_PER_INCH / length_unit,
        is_degrees=is_degrees,
    )


def read_amc(data: bytes | str, asf: AsfSkeleton) -> SourceMotion:
    """Read an AMC file over its skeleton.  AMC states no frame rate: `rate_hz` is None (CMU: 120 Hz, salsa 60 Hz)."""
    starts = np.cumsum([0, *map(len, asf.dof)]).tolist()
    values, is_degrees = _read_rows(data, dict(zip(asf.skeleton.joint_names, pairwise(starts), strict=True)))
    angle_unit = "degrees" if asf.is_degrees else "radians"
    unstated = f"it has no header with the unit of its angles: they are in {angle_unit}, as the skeleton says"
    notes = (unstated,) if is_degrees is None else ()
    is_degrees = asf.is_degrees if is_degrees is None else is_degrees
    root_translation = np.tile(asf.root_position, (len(values), 1))
    for column, axis in enumerate(asf.dof[asf.skeleton.root]):
        if axis in "xyz":
            root_translation[:, "xyz".index(axis)] += values[:, column]
    turns = turn_joints(values * (np.pi / 180.0 if is_degrees else 1.0), asf.dof, is_first_outermost=False)
    axes = np.broadcast_to(asf.axis_unitquat, turns.shape)
    return SourceMotion(
        skeleton=asf.skeleton,
        rest_offsets=asf.rest_offsets,
        root_translation=root_translation,
        local_unitquat=multiply(axes, multiply(turns, conjugate(axes))),
        end_sites=frozenset(name for name in asf.skeleton.joint_names if name.endswith("_end")),
        metres_per_unit=asf.metres_per_unit,
        notes=notes,
    )


def _read_rows(data: bytes | str, columns: Mapping[str, tuple[int, int]]) -> tuple[Array, bool | None]:
    """Return the values of all frames (frame, sum of dof), and whether angles are degrees (None if not stated).

    Args:
        data: The file.
        columns: First column of each joint, and the first one after its columns.
    """
    is_degrees = None
    rows: list[list[float]] = []
    following = 0
    with Lines(data, "AMC file") as lines:
        for words in lines.words("#"):
            name = words[0]
            if not rows and name.startswith(":"):
                if name.upper() in (":DEGREES", ":RADIANS"):
                    is_degrees = name.upper() == ":DEGREES"
                continue
            if not rows or (len(words) == 1 and name not in columns):
                number = parse_integer(" ".join(words), "a frame number is expected")
                if rows and number != following:
                    raise FormatError(f"frame {number} follows frame {following - 1}; {following} is expected")
                rows.append([np.nan] * max(stop for _, stop in columns.values()))
                following = number + 1
                continue
            if name not in columns:
                raise FormatError(f"bone '{shorten(name)}' is not in the ASF skeleton")
            start, stop = columns[name]
            numbers = floats_of(words[1:])
            if len(numbers) != stop - start or not sum(map(abs, numbers)) <= MAX_MAGNITUDE:
                numbers = parse_numbers(words[1:], f"bone '{name}'", stop - start)
            if numbers and rows[-1][start] == rows[-1][start]:  # not NaN: it has been there
                raise FormatError(f"bone '{name}' twice in frame {following - 1}")
            rows[-1][start:stop] = numbers
        if not rows:
            raise FormatError("the file ends without a frame")
    values = np.array(rows)
    for row, column in np.argwhere(np.isnan(values)):
        name = next(name for name, (start, stop) in columns.items() if start <= column < stop)
        raise FormatError(f"frame {following - len(rows) + row} ends without bone '{name}'")
    return values, is_degrees


_BARE_FRAME = re.compile(r"(?:#[^\n]*\n|\s)*\d+\s*\n\s*root(?:[ \t]+[-+.\deE]+)+\s*\n", re.IGNORECASE)
"""First frame of an AMC file without a header: the frame number, then the root and its values."""


def _skeleton_names(name: str) -> list[str]:
    """Return possible names of the skeleton file of a motion: the same stem, or a beginning of it.

    >>> _skeleton_names("60_01.amc"), _skeleton_names("HDM_bd_01-01.amc")[-2:]
    (['60_01.asf', '60.asf'], ['HDM_bd.asf', 'HDM.asf'])
    """
    stem, _, suffix = name.rpartition(".")
    ends = [len(stem), *(mark.start() for mark in reversed(list(re.finditer(r"[-_. ]", stem))))]
    return [stem[:end] + (".ASF" if suffix.isupper() else ".asf") for end in ends if end]


ASF_AMC = MotionFormat(
    name="asf_amc",
    suffixes=(".amc",),
    recognises=lambda start: (
        (_has(start, "fully-specified|degrees|radians") and not _has(start, "bonedata"))
        or _BARE_FRAME.match(start.text) is not None
    ),
    read=lambda data, companion: read_amc(data, read_asf(companion)),
    companion="skeleton",
    companion_names=_skeleton_names,
    check_companion=read_asf,
    is_companion=lambda start: _has(start, "bonedata"),
)
"""AMC with its ASF skeleton (60.asf for 60_01.amc in the CMU database), which states its unit, but no rate; y is up."""


def _has(start: FileStart, names: str) -> bool:
    """Return whether the file has one of these sections."""
    return re.search(rf"^\s*:({names})\b", start.text, re.IGNORECASE | re.MULTILINE) is not None
