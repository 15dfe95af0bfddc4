"""One 3D pair as a file that a person can edit: JSON with named joints, or BVH with one frame per person.

JSON keeps every digit: what `read_pair_json` gives is what `write_pair_json` was given.  BVH keeps positions to 1e-6 m.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.positions_as_motion import exact_motion
from pasdedeux.formats.text import MAX_MAGNITUDE, parse_json
from pasdedeux.formats.working_poses import derive_working_poses
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import find_layout

_FORMAT, _VERSION = "pasdedeux pair", 1
_PERSONS = ("A", "B")
_KEYS = ("format", "version", "skeleton", "unit", "made_from", "takes", "sources", "persons")
_POSE_RATE_HZ = 30.0
"""A pose has no rate; BVH wants one."""

_NUMBER = r"\s*(-?[\d.]+(?:e[-+]?\d+)?)\s*"
_TRIPLE = re.compile(rf"\[{_NUMBER},{_NUMBER},{_NUMBER}\]")
"""Three numbers, which are written on one line."""

MIN_BONE_M = 1e-3
MAX_BONE_M = 2.0
"""Bones outside these lengths are no person's: mostly another unit, metres."""


@dataclass(frozen=True)
class PairSource:
    """Licence and credit of something that a pair was made from."""

    name: str
    licence: str
    credit: str


@dataclass(frozen=True)
class PairFile:
    """A pair and where it is from.

    Args:
        pair_m: Positions (person=2, joint=17, 3), metres, Y up.
        made_from: What it was made from, such as a reference to a draw; empty when nothing is said.
        takes: Takes that it shows or was learned from: it may not be used to judge them.
        sources: Licences and credits it inherits.
    """

    pair_m: Array
    made_from: str = ""
    takes: tuple[str, ...] = ()
    sources: tuple[PairSource, ...] = ()


def write_pair_json(pair: PairFile) -> str:
    """Return a pair as JSON text."""
    persons = {
        name: dict(zip(PAIR17.joint_names, positions, strict=True))
        for name, positions in zip(_PERSONS, np.asarray(pair.pair_m, dtype=np.float64).tolist(), strict=True)
    }
    sources = [{"name": one.name, "licence": one.licence, "credit": one.credit} for one in pair.sources]
    head = dict(zip(_KEYS, (_FORMAT, _VERSION, PAIR17.name, "m"), strict=False))
    body = {"made_from": pair.made_from, "takes": list(pair.takes), "sources": sources, "persons": persons}
    text = json.dumps({**head, **body}, indent=1, ensure_ascii=False)
    return _TRIPLE.sub(lambda found: f"[{', '.join(found.groups())}]", text) + "\n"


def read_pair_json(data: bytes | str, *, is_partial: bool = False) -> PairFile:
    """Read what `write_pair_json` wrote, edited or not.

    `made_from`, `takes` and `sources` may be left out; so may joints, or be null, where `is_partial`: they are NaN.

    Raises:
        FormatError: It is no such file, a joint is missing, unknown or not three finite numbers, or a bone has a length
            that no person's has; names the person and the joint.
    """
    tree = parse_json(data, "pair", has_nan=True)
    if not isinstance(tree, dict) or tree.get("format") != _FORMAT:
        raise FormatError(f"this is no pair: the key 'format' must be '{_FORMAT}'")
    unknown = sorted(set(tree) - set(_KEYS))
    if unknown:
        raise FormatError(f"the key '{unknown[0]}' is unknown; known: {', '.join(_KEYS)}")
    for key, expected in (("version", _VERSION), ("skeleton", PAIR17.name), ("unit", "m")):
        if tree.get(key) != expected:
            raise FormatError(f"the key '{key}' is {tree.get(key)!r}, it must be {expected!r}")
    persons = tree.get("persons")
    if not isinstance(persons, dict) or sorted(persons) != list(_PERSONS):
        raise FormatError("the key 'persons' must hold the two people 'A' and 'B'")
    pair = np.array([_joints(name, persons[name], is_partial=is_partial) for name in _PERSONS])
    _check_bones(pair)
    return PairFile(
        pair_m=pair,
        made_from=_text(tree.get("made_from", ""), "made_from"),
        takes=tuple(_text(take, "takes") for take in _list(tree.get("takes", []), "takes")),
        sources=tuple(_source(one) for one in _list(tree.get("sources", []), "sources")),
    )


def write_pair_bvh(pair_m: Array) -> tuple[str, str]:
    """Return a pair (2, 17, 3), metres, as the BVH texts of person A and person B, centimetres, one frame each."""
    first, second = (write_bvh(exact_motion(PAIR17, person[None], _POSE_RATE_HZ), decimals=8) for person in pair_m)
    return first, second


def pair_from_bvh(
    first: bytes | str, second: bytes | str, *, frame: int = 0, metres_per_unit: float = 0.01
) -> PairFile:
    """Read one frame of two BVH files, those of person A and person B, as a pair.

    Joints are those of `pair17` where the file has them all, as one that was written here; else a known layout.

    Raises:
        FormatError: A file is mangled, has no such frame, fits no known layout, or a bone has a length that no
            person's has; names the person.
    """
    pair = np.array(
        [_posed(name, data, frame, metres_per_unit) for name, data in zip(_PERSONS, (first, second), strict=True)]
    )
    _check_bones(pair)
    return PairFile(pair_m=pair)


def _posed(name: str, data: bytes | str, frame: int, metres_per_unit: float) -> Array:
    source = read_bvh(data)
    if not 0 <= frame < source.num_frames:
        raise FormatError(f"person {name}: there is no frame {frame}, the file has {source.num_frames}")
    motion = source.frames(frame, frame + 1).to_motion(metres_per_unit=metres_per_unit, rate_hz=_POSE_RATE_HZ)
    names = motion.skeleton.joint_names
    if set(PAIR17.joint_names) <= set(names):
        return np.asarray(motion.world()[0][0, [names.index(joint) for joint in PAIR17.joint_names]])
    layout = find_layout(names)
    if layout is None:
        missing = [joint for joint in PAIR17.joint_names if joint not in names]
        raise FormatError(
            f"person {name}: its joints fit no known layout, and of {PAIR17.name} it lacks {', '.join(missing[:5])}"
            + ("" if len(missing) <= 5 else f" and {len(missing) - 5} more")
        )
    return derive_working_poses(motion, layout).pair17_m[0]


def _joints(name: str, joints: Any, *, is_partial: bool) -> Array:
    if not isinstance(joints, dict):
        raise FormatError(f"person {name}: expected an object of joints, each [x, y, z]")
    missing = [joint for joint in PAIR17.joint_names if joint not in joints]
    if missing and not is_partial:
        raise FormatError(f"person {name}: joint '{missing[0]}' is missing")
    unknown = sorted(set(joints) - set(PAIR17.joint_names))
    if unknown:
        raise FormatError(f"person {name}: joint '{unknown[0]}' is not in {PAIR17.name}")
    positions = np.full((PAIR17.num_joints, 3), np.nan)
    for index, joint in enumerate(PAIR17.joint_names):
        if is_partial and joints.get(joint) is None:
            continue
        values = joints[joint]
        numbers = values if isinstance(values, list) else []
        if len(numbers) != 3 or not all(type(n) in (int, float) and abs(n) <= MAX_MAGNITUDE for n in numbers):
            raise FormatError(f"person {name}: joint '{joint}' is {values!r}, it must be three finite numbers, metres")
        positions[index] = values
    return positions


def _check_bones(pair: Array) -> None:
    lengths = bone_lengths(PAIR17, pair)[:, 1:]
    is_wrong = (lengths < MIN_BONE_M) | (lengths > MAX_BONE_M)
    if is_wrong.any():
        person, bone = (int(index) for index in np.argwhere(is_wrong)[0])
        raise FormatError(
            f"person {_PERSONS[person]}: the bone to '{PAIR17.joint_names[bone + 1]}' is {lengths[person, bone]:.3g} m "
            f"long; allowed are {MIN_BONE_M:g} to {MAX_BONE_M:g} m"
        )


def _text(value: Any, key: str) -> str:
    if not isinstance(value, str):
        raise FormatError(f"the key '{key}' holds {value!r}, where text is expected")
    return value


def _list(value: Any, key: str) -> list[Any]:
    if not isinstance(value, list):
        raise FormatError(f"the key '{key}' is {value!r}, it must be a list")
    return value


def _source(value: Any) -> PairSource:
    if not isinstance(value, dict) or sorted(value) != ["credit", "licence", "name"]:
        raise FormatError(f"the key 'sources' holds {value!r}; each needs name, licence and credit")
    return PairSource(*(_text(value[key], f"sources.{key}") for key in ("name", "licence", "credit")))
