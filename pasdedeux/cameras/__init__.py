"""Cameras: pinhole and weak-perspective projection, virtual video, views of a pair and their density."""

from pasdedeux.cameras.frames import (
    LocalFrame,
    angle_between_directions,
    angles_of_direction,
    local_frame,
    pair_frame,
    project_pair,
    true_direction,
)
from pasdedeux.cameras.orthographic import metres_from_pixels, project_orthographic, view_rotmat
from pasdedeux.cameras.pinhole import PinholeCamera, Projection
from pasdedeux.cameras.torso import (
    MIN_TORSO_JOINTS,
    TORSO_INDICES,
    TORSO_JOINTS,
    LiftedTorsos,
    TorsoBasis,
    learn_torso_basis,
    lift_torsos,
)
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.cameras.view_density import VIEW_DEVIATION_RAD, ViewDensity
from pasdedeux.cameras.views import (
    DEPTH_RULES,
    ViewEstimates,
    ViewOptions,
    estimate_views,
    pair_in_metres,
)
from pasdedeux.cameras.virtual_video import (
    Annotated,
    ViewAngles,
    ViewDistribution,
    VirtualView,
    annotate,
    frame_take,
    look_at_camera,
    sample_views,
)

__all__ = [
    "DEPTH_RULES",
    "MIN_TORSO_JOINTS",
    "TORSO_INDICES",
    "TORSO_JOINTS",
    "VIEW_DEVIATION_RAD",
    "Annotated",
    "LiftedTorsos",
    "LocalFrame",
    "PinholeCamera",
    "Projection",
    "TorsoBasis",
    "ViewAngles",
    "ViewDensity",
    "ViewDistribution",
    "ViewEstimates",
    "ViewOptions",
    "VirtualView",
    "angle_between_directions",
    "angles_of_direction",
    "annotate",
    "estimate_views",
    "frame_take",
    "learn_torso_basis",
    "lift_torsos",
    "local_frame",
    "look_at_camera",
    "metres_from_pixels",
    "pair_frame",
    "pair_in_metres",
    "project_orthographic",
    "project_pair",
    "proportions_torso_basis",
    "sample_views",
    "true_direction",
    "view_rotmat",
]
