"""Layouts of motion files, as `motion_files.toml` describes them: CMU, the projection database, characters, ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from pasdedeux.skeletons.layouts.layout import AddedPoint, Entry, Layout
from pasdedeux.skeletons.skeleton import ARM, LEG, by_side

_LIMB_JOINTS = (*ARM, *LEG, "toe")
_TRUNK_JOINTS = ("pelvis", "spine1", "spine2", "spine3", "neck")


def _layout(name: str, told: Mapping[str, Any]) -> Layout:
    """Return a layout: its tables of the three working skeletons from what the source calls things."""
    limbs, trunk = dict(zip(_LIMB_JOINTS, told["limbs"], strict=True)), told["trunk"]
    both = {
        f"{ours}_{joint}": _on_side(entry, theirs)
        for ours, theirs in zip(("left", "right"), told["sides"], strict=True)
        for joint, entry in {**limbs, "collar": told["collar"]}.items()
    }
    shared = {joint: both[joint] for joint in by_side("left", *ARM, *LEG)}
    shoulders, hips = ({str(both[one]): 0.5 for one in by_side("left", joint)} for joint in ("shoulder", "hip"))
    neck: dict[str, float] = {}
    base = {trunk[-1]: 1.0} if isinstance(trunk[-1], str) else trunk[-1]
    for weight, part in ((0.4, base), *((0.3, {shoulder: 1.0}) for shoulder in shoulders)):
        for source, share in part.items():
            neck[source] = neck.get(source, 0.0) + weight * share
    points, nose = dict(told.get("points", {})), told["nose"]
    if not isinstance(nose, str):
        points, nose = {"nose": nose, **points}, "nose"
    pair17 = {"spine": told["spine"], "chest": told["chest"], "head": told["head"], "pelvis": hips, "neck": neck}
    body22 = {**dict(zip(_TRUNK_JOINTS, trunk, strict=True)), "head": told["head"]}
    return Layout(
        name,
        told["meaning"],
        frozenset(told["signature"]),
        {"pair17": shared | pair17, "op14": {**shared, "head": nose, "neck": shoulders}, "body22": both | body22},
        tuple(AddedPoint(at, one["joint"], tuple(one["offset"]), one["unit_bone"]) for at, one in points.items()),
    )


def _on_side(entry: Entry, side: str) -> Entry:
    if isinstance(entry, str):
        return entry.format(side)
    return {source.format(side): weight for source, weight in entry.items()}


_TOLD = tomllib.loads(resources.files(__package__).joinpath("motion_files.toml").read_text(encoding="utf-8"))
LAYOUTS: dict[str, Layout] = {name: _layout(name, told) for name, told in _TOLD.items()}
"""Every layout of motion files by its name: a new one is a table of that file."""
