"""Layouts: how the joints of known kinds of motion files and the keypoints of known detectors become ours."""

from __future__ import annotations

from collections.abc import Sequence

from pasdedeux.skeletons.layouts.cmu import CMU_ASF, CMU_CGSPEED, CMU_DAZ
from pasdedeux.skeletons.layouts.keypoints import FEET4, KEYPOINT_LAYOUTS, LAYOUT_OF_COUNT, KeypointLayout
from pasdedeux.skeletons.layouts.layout import AddedPoint, Layout
from pasdedeux.skeletons.layouts.others import BODY22_LAYOUT, LAFAN, MIXAMO, YIANNAKIDES

__all__ = [
    "FEET4",
    "KEYPOINT_LAYOUTS",
    "LAYOUTS",
    "LAYOUT_OF_COUNT",
    "AddedPoint",
    "KeypointLayout",
    "Layout",
    "find_layout",
    "joints_missing",
]

LAYOUTS: dict[str, Layout] = {
    layout.name: layout for layout in (BODY22_LAYOUT, CMU_ASF, CMU_CGSPEED, CMU_DAZ, LAFAN, MIXAMO, YIANNAKIDES)
}


def find_layout(joint_names: Sequence[str]) -> Layout | None:
    """Return the layout that these joint names belong to, None when no known one fits.

    Where several fit, the one with the longest signature wins.  A namespace that all joints share ('mixamorig:Hips')
    is part of the layout that is given.
    """
    fitting = [layout for layout in LAYOUTS.values() if layout.matches(joint_names)]
    if fitting:
        return max(fitting, key=lambda layout: len(layout.signature))
    prefixes = {name.rpartition(":")[0] for name in joint_names if ":" in name}
    if len(prefixes) == 1:
        prefix = prefixes.pop() + ":"
        bare = [name.removeprefix(prefix) for name in joint_names]
        fitting = [layout for layout in LAYOUTS.values() if layout.matches(bare)]
        if fitting:
            return max(fitting, key=lambda layout: len(layout.signature)).with_prefix(prefix)
    return None


def joints_missing(joint_names: Sequence[str]) -> tuple[Layout, list[str]] | None:
    """Return the layout that these joint names come nearest to, and what they lack of it; None when none comes near.

    Near is a layout of whose signature at least half is there.
    """
    lacking = {layout.name: sorted(layout.signature.difference(joint_names)) for layout in LAYOUTS.values()}
    nearest = min(LAYOUTS.values(), key=lambda layout: len(lacking[layout.name]) / len(layout.signature))
    missing = lacking[nearest.name]
    return (nearest, missing) if 2 * len(missing) <= len(nearest.signature) else None
