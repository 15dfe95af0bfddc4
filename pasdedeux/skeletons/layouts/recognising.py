"""The layout of a file: the known one that its joints belong to, in the names of the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.skeletons.layouts.fitting import LayoutFit, fit_parts
from pasdedeux.skeletons.layouts.layout import Entry, Layout, Table
from pasdedeux.skeletons.layouts.motion_files import LAYOUTS
from pasdedeux.skeletons.layouts.names import SIDES, by_normal_name, normal_names
from pasdedeux.skeletons.skeleton import ARM, LEG, Skeleton, by_side

NEEDED = by_side("left", *ARM, *LEG)
"""Required parts of a file; it also needs neck or head."""
SEVERAL_PEOPLE = "its joints are those of several people; give each person a file, or a mapping"
_LAST = list(LAYOUTS.values())[-1]
"""The layout with words of several programs, for files that fit no other."""


def find_layout(skeleton: Skeleton, rest_offsets: Array) -> Layout | None:
    """Return the known layout that a file's joints belong to, fitted to them; None if none fits.

    Args:
        skeleton: The joints of the file.
        rest_offsets: Offset of each joint from its parent, (J, 3), any unit.
    """
    name = _fitting_name(skeleton)
    return None if name is None else _fitted(name, skeleton, rest_offsets)


@lru_cache(maxsize=256)
def _fitting_name(skeleton: Skeleton) -> str | None:
    """Return the name of that layout; cached, because thousands of files may have the same joints."""
    joints = by_normal_name(skeleton.joint_names)
    if _are_several(skeleton):
        return None
    fitting = [
        layout
        for layout in LAYOUTS.values()
        if not _lacking(layout, joints) and _hang_together(_in_file(layout, joints), skeleton)
    ]
    if not fitting:
        return None
    fitting = [layout for layout in fitting if layout is not _LAST] or fitting
    # Present parts count for a layout, missing ones against it.
    return max(fitting, key=lambda layout: 2 * len(_in_file(layout, joints)) - len(layout.parts)).name


def fit_layout(name: str, skeleton: Skeleton, rest_offsets: Array) -> Layout:
    """Return the known layout of this name, fitted to a file's joints in any namespace.

    Raises:
        InputError: The layout is not known, or the file lacks joints that it needs.
    """
    if name not in LAYOUTS:
        raise InputError(f"layout '{name}' is not known; known: {', '.join(LAYOUTS)}")
    lacking = _lacking(LAYOUTS[name], by_normal_name(skeleton.joint_names))
    if lacking:
        raise InputError(f"layout '{name}' needs {', '.join(lacking)}; joints: {', '.join(skeleton.joint_names[:30])}")
    return _fitted(name, skeleton, rest_offsets)


def resolve_layout(
    name: str, skeleton: Skeleton, rest_offsets: Array, mappings: Mapping[str, Mapping[Any, Table]] | None = None
) -> Layout:
    """Return the layout of this name for a file's joints; "auto" detects it.

    Args:
        name: A known layout, a mapping, or "auto".
        skeleton: The joints of the file.
        rest_offsets: Offset of each joint from its parent, (J, 3), any unit.
        mappings: Changes of known layouts, and further layouts: for each working skeleton entries of its table, and
            under `parts` the joints of the file for parts of a body, from which the tables follow.

    Raises:
        InputError: No known layout fits, the name is neither a known layout nor a mapping, or joints are missing.
    """
    mappings = mappings or {}
    if _are_several(skeleton) and name not in mappings:
        raise InputError(SEVERAL_PEOPLE)
    if name == "auto":
        known = find_layout(skeleton, rest_offsets)
        if known is None:
            raise InputError(_fits_none(skeleton.joint_names))
        layout = known
    elif name in mappings and name not in LAYOUTS:
        parts = mappings[name].get("parts")
        layout = Layout(name, "of the study", {})
        if parts is not None:
            lacking = [part for part in NEEDED if part not in parts]
            lacking += [] if {"neck", "skull", "head"} & parts.keys() else ["neck or skull"]
            if lacking:
                raise InputError(f"mapping '{name}': its parts lack {', '.join(lacking)}")
            layout = fit_parts(name, "of the study", parts, skeleton, rest_offsets)
    elif name in LAYOUTS:
        layout = fit_layout(name, skeleton, rest_offsets)
    else:
        raise InputError(f"layout '{name}' is not known; known: {', '.join([*LAYOUTS, *mappings])}")
    tables = {key: table for key, table in mappings.get(layout.name, {}).items() if key != "parts"}
    return layout.with_tables(_in_words_of(skeleton, layout.name, tables)) if tables else layout


def _in_words_of(skeleton: Skeleton, layout_name: str, tables: Mapping[str, Table]) -> dict[str, Table]:
    """Convert names of the layout in tables to those of the file, which may have a namespace."""
    joints, normal = by_normal_name(skeleton.joint_names), NORMAL_NAMES.get(layout_name, {})

    def name_of(name: str) -> str:
        return name if name in skeleton.joint_names else joints.get(normal.get(name, ""), name)

    return {
        key: {
            joint: name_of(entry) if isinstance(entry, str) else {name_of(name): entry[name] for name in entry}
            for joint, entry in table.items()
        }
        for key, table in tables.items()
    }


def _are_several(skeleton: Skeleton) -> bool:
    """Return whether all limbs that a known layout needs are there twice, in different namespaces."""
    counts = Counter(normal_names(skeleton.joint_names))
    twice = {name: name for name, count in counts.items() if count > 1}
    return len(twice) >= len(NEEDED) and any(
        _in_file(layout, twice).keys() >= set(NEEDED) for layout in LAYOUTS.values()
    )


def _fits_none(joint_names: Sequence[str]) -> str:
    shown = ", ".join(joint_names[:12]) + (", ..." if len(joint_names) > 12 else "")
    near = joints_missing(joint_names)
    hint = f"; the nearest is {near[0].name}, which also needs {', '.join(near[1])}" if near else ""
    return (
        f"its joints fit none of the known layouts ({', '.join(LAYOUTS)}){hint}; joints: {shown}; "
        "name a layout, or write one under [ingest.mappings]"
    )


def joints_missing(joint_names: Sequence[str]) -> tuple[Layout, list[str]] | None:
    """Return the nearest layout for these joint names, and its missing joints; None if over half are missing."""
    joints = by_normal_name(joint_names)
    lacking = {name: _lacking(layout, joints) for name, layout in LAYOUTS.items()}
    nearest = min(LAYOUTS.values(), key=lambda layout: len(lacking[layout.name]))
    return (nearest, lacking[nearest.name]) if 2 * len(lacking[nearest.name]) <= len(NEEDED) + 1 else None


def _known_names(layout: Layout) -> dict[str, str]:
    """Return the normal form of each name in a layout."""
    entries = [*layout.parts.values(), *({point.joint: 1.0, point.unit_bone: 1.0} for point in layout.points)]
    names = sorted({name for entry in entries for name in _names_of(entry)} - {point.name for point in layout.points})
    return dict(zip(names, normal_names(names), strict=True))


def _names_of(entry: Entry) -> list[str]:
    return entry.split("|") if isinstance(entry, str) else list(entry)


NORMAL_NAMES = {name: _known_names(layout) for name, layout in LAYOUTS.items()}
"""Normal forms of the names in each layout."""


def _in_file(layout: Layout, joints: Mapping[str, str]) -> dict[str, Entry]:
    """Return the parts of a layout for which a file has joints, in the file's names."""
    normal, points = NORMAL_NAMES[layout.name], {point.name: point for point in layout.points}
    parts: dict[str, Entry] = {}
    taken: set[str] = set()

    def there(name: str) -> str | None:
        if name in points:
            return name if {normal[points[name].joint], normal[points[name].unit_bone]} <= joints.keys() else None
        return joints.get(normal[name])

    for part, entry in layout.parts.items():
        if isinstance(entry, str):
            is_limb = part.startswith(SIDES)
            names = [name for name in map(there, entry.split("|")) if name and not (is_limb and name in taken)]
            if names:
                parts[part] = names[0]
                taken |= {names[0]} if is_limb else set()
        elif all(there(name) for name in entry):
            parts[part] = {str(there(name)): weight for name, weight in entry.items()}
    return parts


def _lacking(layout: Layout, joints: Mapping[str, str]) -> list[str]:
    """Return the needed joints of a layout that a file lacks, in the layout's names."""
    parts = _in_file(layout, joints)
    lacking = [layout.parts[part] for part in (layout.parts if layout.is_whole else NEEDED) if part not in parts]
    if not layout.is_whole and not parts.keys() & {"neck", "head", "skull"}:
        lacking.append(layout.parts["neck"])
    return [" or ".join(_names_of(entry)) for entry in lacking]


def _hang_together(parts: Mapping[str, Entry], skeleton: Skeleton) -> bool:
    """Return whether each limb is a path in the tree: a name may mean different joints in different programs."""

    def joint(part: str) -> int:
        entry = parts[part]
        return skeleton.index(entry if isinstance(entry, str) else max(entry, key=lambda name: entry[name]))

    for side in SIDES:
        for limb in (ARM, LEG):
            joints = [joint(f"{side}_{part}") for part in limb]
            if not all(above in skeleton.path(below) for above, below in pairwise(joints)):
                return False
    return True


def _fitted(name: str, skeleton: Skeleton, rest_offsets: Array) -> Layout:
    """Return a layout in the names of a file, which has the needed joints."""
    return _fitted_once(name, skeleton, np.asarray(rest_offsets, np.float64).tobytes())


@lru_cache(maxsize=64)
def _fitted_once(name: str, skeleton: Skeleton, rest_offsets: bytes) -> Layout:
    """Return the same; cached, because thousands of files of one rig may have the same joints and bones."""
    layout, offsets = LAYOUTS[name], np.frombuffer(rest_offsets).reshape(-1, 3)
    joints, normal = by_normal_name(skeleton.joint_names), NORMAL_NAMES[layout.name]
    points = tuple(
        replace(point, joint=joints[normal[point.joint]], unit_bone=joints[normal[point.unit_bone]])
        for point in layout.points
        if {normal[point.joint], normal[point.unit_bone]} <= joints.keys()
    )
    given = replace(layout, parts=_in_file(layout, joints), points=points)
    return LayoutFit(given, skeleton, offsets).layout()
