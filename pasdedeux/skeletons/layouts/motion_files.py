"""Layouts of motion files from `motion_files.toml`, which has the joint names of programs and data sets."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from pasdedeux.skeletons.layouts.layout import AddedPoint, Entry, Layout, working_tables
from pasdedeux.skeletons.skeleton import ARM, LEG

_LIMB_JOINTS = (*ARM, *LEG, "toe")
_TRUNK_JOINTS = ("pelvis", "spine1", "spine2", "spine3", "neck")
_ALL = {*_TRUNK_JOINTS, "spine", "chest", "head", "nose", *(f"{side}_collar" for side in ("left", "right"))}


def _layout(name: str, table: Mapping[str, Any]) -> Layout:
    """Build a layout from its table."""
    limbs, trunk = zip(_LIMB_JOINTS, table["limbs"], strict=True), table["trunk"]
    per_side = dict(limbs) | ({"collar": table["collar"]} if "collar" in table else {})
    parts = {
        f"{ours}_{joint}": _on_side(entry, theirs)
        for ours, theirs in zip(("left", "right"), table.get("sides", ("Left", "Right")), strict=True)
        for joint, entry in per_side.items()
        if entry
    }
    parts |= zip(_TRUNK_JOINTS if len(trunk) > 2 else ("pelvis", "neck"), trunk, strict=True)
    parts |= {part: table[part] for part in ("spine", "chest", "head", "skull", "nose") if part in table}
    head = parts.get("head")
    if isinstance(head, Mapping):
        parts.setdefault("skull", max(head, key=lambda joint: head[joint]))
    points = dict(table.get("points", {}))
    if isinstance(parts.get("nose"), Mapping):
        points = {"nose": parts["nose"], **points}
        parts["nose"] = "nose"
    added = (AddedPoint(at, point["joint"], tuple(point["offset"]), point["unit_bone"]) for at, point in points.items())
    return Layout(
        name,
        table["meaning"],
        working_tables({part: _first(entry) for part, entry in parts.items()}) if parts.keys() >= _ALL else {},
        tuple(added),
        parts,
        keeps_axes=table.get("keeps_axes", False),
        is_whole=table.get("is_whole", False),
    )


def _first(entry: Entry) -> Entry:
    return entry.partition("|")[0] if isinstance(entry, str) else entry


def _on_side(entry: Entry, side: str) -> Entry:
    if isinstance(entry, str):
        return entry.replace("{}", side)
    return {source.replace("{}", side): weight for source, weight in entry.items()}


_TABLES = tomllib.loads(resources.files(__package__).joinpath("motion_files.toml").read_text(encoding="utf-8"))
LAYOUTS: dict[str, Layout] = {name: _layout(name, table) for name, table in _TABLES.items()}
"""All layouts of motion files by name; add one as a table of that file."""
