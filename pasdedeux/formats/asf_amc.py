"""Reading ASF (skeleton) and AMC (motion) files of the Acclaim format, as the CMU motion capture database uses them.

Meaning of the numbers (J. Lander, "Working with motion capture file formats", Game Developer, January 1998): a bone
turns at its start and reaches along `direction` for `length` in the rest pose's world axes.  With C the rotation of its
`axis` entry and M that of its AMC angles (first angle of `dof` applied first), it turns against its parent by C M C^-1.
We make one joint per bone, at the bone's start and with the bone's name, and a `<bone>_end` for each leaf.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.euler import identity_unitquat, unitquat_from_euler
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import decode, parse_integer, parse_number, shorten, split_lines
from pasdedeux.kinematics.rotations import conjugate, multiply
from pasdedeux.skeletons import Skeleton

METRES_PER_INCH = 0.0254
MAX_BONES = 500
_DOF = {"rx": "X", "ry": "Y", "rz": "Z"}
_ROOT_DOF = {**_DOF, "tx": "x", "ty": "y", "tz": "z"}


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
    """A bone while it is read."""

    line: int
    name: str = ""
    direction: Array | None = None
    length: float | None = None
    axis_angles: Array | None = None
    axis_order: str = "XYZ"
    dof: str = ""


def read_asf(data: bytes | str) -> AsfSkeleton:
    """Read an ASF file.

    Raises:
        FormatError: The file is mangled: a missing section, an unknown bone, one without parent, NaN (line named).
    """
    lines = split_lines(decode(data, "ASF file"))
    sections = _split_sections(lines)
    for needed in ("units", "root", "bonedata", "hierarchy"):
        if needed not in sections:
            raise FormatError(f"this ASF file has no section ':{needed}'")
    length_unit, is_degrees = _parse_units(sections["units"])
    angle_unit = np.pi / 180.0 if is_degrees else 1.0
    root = _parse_root(sections["root"])
    bones = _parse_bones(sections["bonedata"])
    parent_of = _parse_hierarchy(sections["hierarchy"], bones)

    names, parents, offsets, axes, dofs = [root.name], [-1], [np.zeros(3)], [root], [root.dof]
    vector = {"root": np.zeros(3)}
    vector |= {name: np.asarray(bone.direction) * float(bone.length or 0.0) for name, bone in bones.items()}
    children = {name: [child for child in bones if parent_of[child] == name] for name in vector}
    place = {"root": 0}
    for name in _outwards(children):
        bone = bones[name]
        place[name] = len(names)
        names.append(name)
        parents.append(place[parent_of[name]])
        offsets.append(vector[parent_of[name]])
        axes.append(bone)
        dofs.append(bone.dof)
        if not children[name]:
            names.append(f"{name}_end")
            parents.append(place[name])
            offsets.append(vector[name])
            axes.append(_Bone(line=bone.line))
            dofs.append("")
    if len(set(names)) != len(names):
        raise FormatError("this ASF file names a bone like the end of another ('<bone>_end')")
    axis_unitquat = np.array(
        [
            unitquat_from_euler(
                (np.zeros(3) if bone.axis_angles is None else bone.axis_angles)[::-1] * angle_unit,
                bone.axis_order[::-1],
            )
            for bone in axes
        ]
    )
    try:
        skeleton = Skeleton(name="asf", joint_names=tuple(names), parents=tuple(parents))
    except InputError as error:
        raise FormatError(str(error)) from None
    return AsfSkeleton(
        skeleton=skeleton,
        rest_offsets=np.array(offsets),
        axis_unitquat=axis_unitquat,
        dof=tuple(dofs),
        root_position=np.asarray(root.direction),
        metres_per_unit=METRES_PER_INCH / length_unit,
        is_degrees=is_degrees,
    )


def read_amc(data: bytes | str, asf: AsfSkeleton) -> SourceMotion:
    """Read an AMC file over its skeleton.  AMC states no frame rate: `rate_hz` is None (CMU: 120 Hz, salsa 60 Hz).

    Raises:
        FormatError: The file is mangled or belongs to another skeleton: an unknown bone, a bone missing in a frame, a
            wrong number of values, a frame number out of order, NaN.  The line is named.
    """
    values, is_degrees = _parse_amc(data, asf)
    unit = np.pi / 180.0 if is_degrees else 1.0
    num_frames, num_joints = len(values), asf.skeleton.num_joints
    local_unitquat = identity_unitquat(num_frames, num_joints)
    root_translation = np.tile(asf.root_position, (num_frames, 1))
    column = 0
    for joint, dof in enumerate(asf.dof):
        block = values[:, column : column + len(dof)]
        column += len(dof)
        turns = [i for i, axis in enumerate(dof) if axis in "XYZ"]
        for i, axis in enumerate(dof):
            if axis in "xyz":
                root_translation[:, "xyz".index(axis)] += block[:, i]
        # The first angle turns first, so it stands innermost (last) in the product.
        motion = unitquat_from_euler(block[:, turns[::-1]] * unit, "".join(dof[i] for i in turns[::-1]))
        frame_axes = np.broadcast_to(asf.axis_unitquat[joint], motion.shape)
        local_unitquat[:, joint] = multiply(frame_axes, multiply(motion, conjugate(frame_axes)))
    return SourceMotion(
        skeleton=asf.skeleton,
        rest_offsets=asf.rest_offsets,
        root_translation=root_translation,
        local_unitquat=local_unitquat,
        end_sites=frozenset(name for name in asf.skeleton.joint_names if name.endswith("_end")),
        metres_per_unit=asf.metres_per_unit,
    )


class AsfAmc(MotionFormat):
    """AMC over its ASF skeleton: it states its unit and that y is up, never its rate."""

    name = "asf_amc"
    recognised_by = "AMC with :FULLY-SPECIFIED or :DEGREES"
    suffixes = (".amc",)
    companion = "skeleton"

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file says how its angles are meant, as an AMC does, and has no bones."""
        return _has_section(start, "fully-specified|degrees|radians") and not self.is_companion(start)

    def is_companion(self, start: FileStart) -> bool:
        """Tell whether the file is an ASF: it has bones."""
        return _has_section(start, "bonedata")

    def companion_names(self, name: str) -> tuple[str, ...]:
        """Return the skeleton's name as the CMU database has it: 60.asf for 60_01.amc."""
        return (name.rpartition(".")[0].rpartition("_")[0] + ".asf",)

    def read(self, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read everything."""
        return read_amc(data, read_asf(companion))


def _has_section(start: FileStart, names: str) -> bool:
    return re.search(rf"^\s*:({names})\b", start.text, re.IGNORECASE | re.MULTILINE) is not None


def _split_sections(lines: list[str]) -> dict[str, list[tuple[int, list[str]]]]:
    """Return for each `:section` its lines as (line number, words), the words on the section's own line included."""
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    current: list[tuple[int, list[str]]] | None = None
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            name = words[0][1:].lower()
            if name in sections:
                raise FormatError(f"line {number}: a second section ':{shorten(name)}'")
            current = sections[name] = []
            words = words[1:]
        elif current is None:
            raise FormatError(
                f"line {number}: an ASF file starts with a section such as ':version', found '{shorten(words[0])}'"
            )
        if words:
            current.append((number, words))
    return sections


def _parse_units(rows: list[tuple[int, list[str]]]) -> tuple[float, bool]:
    """Return the length unit in inches' multiples and whether angles are in degrees."""
    length, is_degrees = 1.0, True
    for number, words in rows:
        key = words[0].lower()
        if len(words) != 2:
            raise FormatError(f"line {number}: a unit needs one value, found '{shorten(' '.join(words))}'")
        if key == "length":
            length = parse_number(words[1], f"line {number}: length unit")
            if not 1e-4 <= length <= 1e4:
                raise FormatError(f"line {number}: the length unit is {length:g}; allowed: 0.0001 to 10000")
        elif key == "angle":
            if words[1].lower() not in {"deg", "rad"}:
                raise FormatError(f"line {number}: the angle unit is '{shorten(words[1])}'; allowed: deg, rad")
            is_degrees = words[1].lower() == "deg"
    return length, is_degrees


def _parse_root(rows: list[tuple[int, list[str]]]) -> _Bone:
    """Return the root as a bone whose `direction` is its position and whose axis is its orientation."""
    root = _Bone(line=rows[0][0] if rows else 0, name="root", direction=np.zeros(3), axis_angles=np.zeros(3))
    for number, words in rows:
        key = words[0].lower()
        if key == "order":
            root.dof = _parse_dof(words[1:], _ROOT_DOF, number, "root")
        elif key == "axis":
            root.axis_order = _parse_axis_order(words[1:], number)
        elif key == "position":
            root.direction = _parse_vector(words[1:], number, "position of the root")
        elif key == "orientation":
            root.axis_angles = _parse_vector(words[1:], number, "orientation of the root")
    if not root.dof:
        raise FormatError("section ':root' of this ASF file has no 'order'")
    return root


def _parse_bones(rows: list[tuple[int, list[str]]]) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    bone: _Bone | None = None
    num_limits, is_in_limits = 0, False
    for number, words in rows:
        key = words[0].lower()
        if key == "begin":
            if bone is not None:
                raise FormatError(f"line {number}: 'begin' inside of bone '{bone.name}'")
            bone, num_limits, is_in_limits = _Bone(line=number), 0, False
            continue
        if bone is None:
            raise FormatError(f"line {number}: 'begin' is expected, found '{shorten(words[0])}'")
        where = f"line {number}: bone '{bone.name}'"
        if key == "end":
            _finish_bone(bone, num_limits, number)
            if bone.name in bones or bone.name == "root":
                raise FormatError(f"line {number}: a second bone with the name '{shorten(bone.name)}'")
            if len(bones) >= MAX_BONES:
                raise FormatError(f"line {number}: more than {MAX_BONES} bones")
            bones[bone.name] = bone
            bone = None
        elif key == "limits" or is_in_limits:
            is_in_limits = True  # of the joint, which nothing here uses
            text = " ".join(words[1:] if key == "limits" else words).replace("(", " ").replace(")", " ")
            num_limits += len(text.split())
        elif key == "name":
            bone.name = " ".join(words[1:])
        elif key == "direction":
            bone.direction = _parse_vector(words[1:], number, f"direction of '{bone.name}'")
        elif key == "length":
            if len(words) != 2:
                raise FormatError(f"{where}: length needs 1 number, found {len(words) - 1}")
            bone.length = parse_number(words[1], where)
        elif key == "axis":
            bone.axis_angles = _parse_vector(words[1:4], number, f"axis of '{bone.name}'")
            bone.axis_order = _parse_axis_order(words[4:], number)
        elif key == "dof":
            bone.dof = _parse_dof(words[1:], _DOF, number, bone.name)
        elif key not in {"id", "bodymass", "cofmass"}:
            raise FormatError(
                f"{where}: '{shorten(words[0])}' is not known; allowed: id, name, direction, length, axis, dof, limits"
            )
    if bone is not None:
        raise FormatError(f"line {bone.line}: bone '{bone.name}' has no 'end'")
    if not bones:
        raise FormatError("section ':bonedata' of this ASF file has no bones")
    return bones


def _finish_bone(bone: _Bone, num_limits: int, number: int) -> None:
    if not bone.name:
        raise FormatError(f"line {number}: a bone without a name")
    if bone.direction is None or bone.length is None or bone.axis_angles is None:
        raise FormatError(f"line {number}: bone '{shorten(bone.name)}' needs a direction, a length and an axis")
    if bone.length < 0:
        raise FormatError(
            f"line {number}: bone '{shorten(bone.name)}' has the length {bone.length:g}; at least 0 is needed"
        )
    norm = float(np.linalg.norm(bone.direction))
    if bone.length > 0 and not 0.5 < norm < 2.0:
        raise FormatError(f"line {number}: the direction of bone '{shorten(bone.name)}' has length {norm:g}, not 1")
    bone.direction = bone.direction / norm if norm > 0 else bone.direction
    if num_limits and num_limits != 2 * len(bone.dof):
        raise FormatError(
            f"line {number}: bone '{shorten(bone.name)}' has {len(bone.dof)} degrees of freedom "
            f"but {num_limits} numbers in its limits"
        )


def _parse_hierarchy(rows: list[tuple[int, list[str]]], bones: dict[str, _Bone]) -> dict[str, str]:
    parent_of: dict[str, str] = {}
    for number, words in rows:
        if words in (["begin"], ["end"]):
            continue
        for name in words:
            if name != "root" and name not in bones:
                raise FormatError(f"line {number}: bone '{shorten(name)}' is not in ':bonedata'")
        for child in words[1:]:
            if child in parent_of or child == "root":
                raise FormatError(f"line {number}: bone '{shorten(child)}' has a second parent '{words[0]}'")
            parent_of[child] = words[0]
    orphans = [name for name in bones if name not in parent_of]
    if orphans:
        raise FormatError(f"bone '{shorten(orphans[0])}' has no parent in ':hierarchy'")
    reached = set(_outwards({name: [c for c in bones if parent_of[c] == name] for name in ["root", *bones]}))
    lost = [name for name in bones if name not in reached]
    if lost:
        raise FormatError(f"bone '{shorten(lost[0])}' is not connected to the root in ':hierarchy'")
    return parent_of


def _outwards(children: dict[str, list[str]]) -> list[str]:
    """Return all bones reached from the root, depth first, every parent before its children."""
    order, stack = [], list(reversed(children["root"]))
    while stack:
        name = stack.pop()
        order.append(name)
        stack.extend(reversed(children[name]))
    return order


def _parse_vector(words: list[str], number: int, what: str) -> Array:
    if len(words) != 3:
        raise FormatError(f"line {number}: {what} needs 3 numbers, found {len(words)}")
    return np.array([parse_number(word, f"line {number}: {what}") for word in words])


def _parse_axis_order(words: list[str], number: int) -> str:
    order = "".join(words).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise FormatError(f"line {number}: the axis order is '{shorten(order)}'; it is a permutation of XYZ")
    return order


def _parse_dof(words: list[str], allowed: dict[str, str], number: int, name: str) -> str:
    for word in words:
        if word.lower() not in allowed:
            raise FormatError(
                f"line {number}: '{shorten(name)}' has the degree of freedom '{shorten(word)}'; "
                f"allowed: {', '.join(allowed)}"
            )
    dof = "".join(allowed[word.lower()] for word in words)
    if len(set(dof)) != len(dof):
        raise FormatError(f"line {number}: '{shorten(name)}' has a degree of freedom twice")
    return dof


def _parse_amc(data: bytes | str, asf: AsfSkeleton) -> tuple[Array, bool]:
    """Return the numbers of all frames (frame, sum of dof), joint after joint, and whether angles are degrees."""
    lines = split_lines(decode(data, "AMC file"))
    is_degrees = asf.is_degrees
    index = 0
    while index < len(lines):
        text = lines[index].strip()
        if text.isdigit():
            break
        if text.startswith(":"):
            if text.upper() in {":DEGREES", ":RADIANS"}:
                is_degrees = text.upper() == ":DEGREES"
        elif text and not text.startswith("#"):
            raise FormatError(f"line {index + 1}: a frame number is expected, found '{shorten(text)}'")
        index += 1
    else:
        raise FormatError(f"line {len(lines)}: the file ends without a frame")

    first_column, column = {}, 0
    for name, dof in zip(asf.skeleton.joint_names, asf.dof, strict=True):
        first_column[name] = (column, len(dof))
        column += len(dof)
    needed = {name for name, (_, count) in first_column.items() if count}

    rows: list[list[float]] = []
    row: list[float] = []
    seen: set[str] = set()
    frame_number, expected = "", 0

    def finish(number: int) -> None:
        missing = sorted(needed - seen)
        if missing:
            raise FormatError(f"line {number}: frame {frame_number} ends without bone '{missing[0]}'")
        rows.append(row)

    for number, line in enumerate(lines[index:], start=index + 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) == 1 and words[0] not in first_column:
            if frame_number:
                finish(number)
            current = parse_integer(words[0], f"line {number}: frame number")
            if frame_number and current != expected:
                raise FormatError(
                    f"line {number}: frame {current} follows frame {frame_number}; {expected} is expected"
                )
            frame_number, expected = words[0], current + 1
            row, seen = [0.0] * column, set()
            continue
        name = words[0]
        if name not in first_column:
            raise FormatError(f"line {number}: bone '{shorten(name)}' is not in the ASF skeleton")
        start, count = first_column[name]
        if len(words) - 1 != count:
            raise FormatError(
                f"line {number}: bone '{name}' has {len(words) - 1} values, the ASF skeleton says {count}"
            )
        if name in seen:
            raise FormatError(f"line {number}: bone '{name}' twice in frame {frame_number}")
        seen.add(name)
        try:
            numbers = [float(word) for word in words[1:]]
        except ValueError:
            numbers = [np.nan]
        if not all(-1e7 <= value <= 1e7 for value in numbers):
            numbers = [parse_number(word, f"line {number}: bone '{name}'") for word in words[1:]]
        row[start : start + count] = numbers
    finish(len(lines))
    return np.array(rows), is_degrees
