"""Layouts: mappings from joints of motion files and keypoints of detectors to the working skeletons."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.drafting import Draft, DraftedPart, draft_mapping
from pasdedeux.skeletons.layouts.fitting import fit_parts
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
from pasdedeux.skeletons.layouts.recognising import find_layout, fit_layout, joints_missing, resolve_layout

__all__ = [
    "FEET4",
    "KEYPOINT_LAYOUTS",
    "LAYOUTS",
    "LAYOUTS_OF_COUNT",
    "USUAL_LAYOUTS",
    "Draft",
    "DraftedPart",
    "KeypointLayout",
    "Layout",
    "draft_mapping",
    "find_layout",
    "fit_layout",
    "fit_parts",
    "is_joint",
    "joints_missing",
    "layout_of_names",
    "resolve_layout",
]
