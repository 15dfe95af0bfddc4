"""Layouts: how the joints of known kinds of motion files and the keypoints of known detectors become ours."""

from __future__ import annotations

from collections.abc import Sequence

from pasdedeux.skeletons.layouts.joint_names import is_joint
from pasdedeux.skeletons.layouts.keypoints import (
    FEET4,
    KEYPOINT_LAYOUTS,
    LAYOUTS_OF_COUNT,
    USUAL_LAYOUTS,
    KeypointLayout,
    layout_of_names,
)
from pasdedeux.skeletons.layouts.layout import Layout
from pasdedeux.skeletons.layouts.motion_files import LAYOUTS

__all__ = [
    "FEET4",
    "KEYPOINT_LAYOUTS",
    "LAYOUTS",
    "LAYOUTS_OF_COUNT",
    "USUAL_LAYOUTS",
    "KeypointLayout",
    "Layout",
    "find_layout",
    "is_joint",
    "joints_missing",
    "layout_of_names",
]


def find_layout(joint_names: Sequence[str]) -> Layout | None:
    """Return the layout that these joint names belong to, None when no known one fits.

    Where several fit, the one with the longest signature wins.  A namespace that all joints share ('mixamorig:Hips')
    is part of the layout that is given.
    """
    namespaces = {name.rpartition(":")[0] for name in joint_names if ":" in name}
    for prefix in ("", *(f"{one}:" for one in namespaces if len(namespaces) == 1)):
        bare = {name.removeprefix(prefix) for name in joint_names}
        fitting = [layout for layout in LAYOUTS.values() if layout.signature <= bare]
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
