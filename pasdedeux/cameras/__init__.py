"""Cameras: pinhole and weak-perspective projection, virtual video, views of a pair and their density."""

from pasdedeux.cameras.frames import (
    LocalFrame,
    angle_between_directions,
    angles_of_direction,
    direction_of_angles,
    local_frame,
    pair_frame,
    project_pair,
    swap_people,
    true_direction,
)
from pasdedeux.cameras.orthographic import metres_from_pixels, pixels_from_metres, project_orthographic, view_rotmat
from pasdedeux.cameras.pinhole import PinholeCamera, Projection
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
    "Annotated",
    "LocalFrame",
    "PinholeCamera",
    "Projection",
    "ViewAngles",
    "ViewDistribution",
    "VirtualView",
    "angle_between_directions",
    "angles_of_direction",
    "annotate",
    "direction_of_angles",
    "frame_take",
    "local_frame",
    "look_at_camera",
    "metres_from_pixels",
    "pair_frame",
    "pixels_from_metres",
    "project_orthographic",
    "project_pair",
    "sample_views",
    "swap_people",
    "true_direction",
    "view_rotmat",
]
