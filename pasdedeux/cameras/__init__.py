"""Cameras: pinhole and weak-perspective projection, virtual video, views of a pair and their density."""

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
    "PinholeCamera",
    "Projection",
    "ViewAngles",
    "ViewDistribution",
    "VirtualView",
    "annotate",
    "frame_take",
    "look_at_camera",
    "sample_views",
]
