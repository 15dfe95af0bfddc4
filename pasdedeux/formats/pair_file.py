"""One 3D pair as a file that a person can edit: JSON with named joints, or BVH with one frame per person.

JSON keeps all digits: `read_pair_json` returns the exact values.  BVH keeps positions to 1e-6 m.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, named
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.formats.text import MAX_MAGNITUDE, check_range, parse_json
from pasdedeux.kinematics import bone_lengths
from pasdedeux.settings import Settings, first_problem
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import find_layout

_PERSONS = ("A", "B")
_POSE_RATE_HZ = 30.0
"""Rate in the BVH file of a single pose."""

_NUMBER = r"\s*(-?[\d.]+(?:e[-+]?\d+)?)\s*"
_TRIPLE = re.compile(rf"\[{_NUMBER},{_NUMBER},{_NUMBER}\]")
"""Three numbers, to be written on one line."""

BONE_M = (1e-3, 2.0)
"""Allowed lengths of bones, metres; others are mostly in another unit."""


@dataclass(frozen=True)
class PairSource:
    """Licence and credit of a source of a pair."""

    name: str
    licence: str
    credit: str


@dataclass(frozen=True)
class PairFile:
    """A pair and its origin.

    Args:
        pair_m: Positions (person=2, joint=17, 3), metres, Y up.
        made_from: Its origin, such as a reference to a draw; empty if unknown.
        takes: Takes that it shows or was learned from, which must not be evaluated with it.
        sources: Inherited licences and credits.
    """

    pair_m: Array
    made_from: str = ""
    takes: tuple[str, ...] = ()
    sources: tuple[PairSource, ...] = ()


_Metres = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
_Joints = dict[str, tuple[_Metres, _Metres, _Metres] | None]


class _Persons(Settings):
    A: _Joints
    B: _Joints


class _Tree(Settings):
    """Content of the JSON of a pair."""

    format: Literal["pasdedeux pair"]
    version: Literal[1]
    skeleton: Literal["pair17"]
    unit: Literal["m"]
    made_from: str = ""
    takes: tuple[str, ...] = ()
    sources: tuple[PairSource, ...] = ()
    persons: _Persons


def write_pair_json(pair: PairFile) -> str:
    """Return a pair as JSON text."""
    positions = np.asarray(pair.pair_m, dtype=np.float64).tolist()
    tree = {
        "format": "pasdedeux pair",
        "version": 1,
        "skeleton": PAIR17.name,
        "unit": "m",
        "made_from": pair.made_from,
        "takes": list(pair.takes),
        "sources": [asdict(source) for source in pair.sources],
        "persons": {
            name: dict(zip(PAIR17.joint_names, points, strict=True))
            for name, points in zip(_PERSONS, positions, strict=True)
        },
    }
    text = json.dumps(tree, indent=1, ensure_ascii=False)
    return _TRIPLE.sub(lambda match: f"[{', '.join(match.groups())}]", text) + "\n"


def read_pair_json(data: bytes | str, *, is_partial: bool = False) -> PairFile:
    """Read a file of `write_pair_json`, edited or not.

    `made_from`, `takes` and `sources` are optional; with `is_partial` also joints, NaN if missing or null.
    """
    try:
        tree = _Tree.model_validate(parse_json(data, "pair"))
    except ValidationError as error:
        raise FormatError(f"this is no pair: {first_problem(error)}") from None
    pair = np.full((len(_PERSONS), PAIR17.num_joints, 3), np.nan)
    for name, positions, joints in zip(_PERSONS, pair, (tree.persons.A, tree.persons.B), strict=True):
        with named(f"person {name}"):
            for joint in (*PAIR17.joint_names, *joints):
                if joint not in PAIR17.joint_names:
                    raise FormatError(f"joint '{joint}' is not in {PAIR17.name}")
                point = joints.get(joint)
                if point is not None:
                    positions[PAIR17.index(joint)] = point
                elif not is_partial:
                    raise FormatError(f"joint '{joint}' is missing")
    _check_bones(pair)
    return PairFile(pair, tree.made_from, tree.takes, tree.sources)


def pair_from_bvh(
    first: bytes | str, second: bytes | str, *, frame: int = 0, metres_per_unit: float = 0.01
) -> PairFile:
    """Read one frame of the BVH files of person A and person B as a pair.

    If the file has all joints of `pair17`, as files written here, they are taken; else it needs a known layout.
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
    layout = find_layout(motion.skeleton, motion.rest_offsets_m)
    if layout is None:
        missing = ", ".join(joint for joint in PAIR17.joint_names if joint not in names)
        raise FormatError(f"person {name}: its joints fit no known layout, and of {PAIR17.name} it lacks {missing}")
    return derive_working_poses(motion, layout).pair17_m[0]


def _check_bones(pair: Array) -> None:
    for name, lengths in zip(_PERSONS, bone_lengths(PAIR17, pair), strict=True):
        for joint, length_m in zip(PAIR17.joint_names[1:], lengths[1:].tolist(), strict=True):
            if not np.isnan(length_m):  # NaN if a joint is missing
                check_range(length_m, f"person {name}: the length of the bone to '{joint}' in metres", *BONE_M)
