"""Draw bodies on an image: shaded triangles, the farthest first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pasdedeux.arrays import Array

_LIGHT, _DARK = np.array([-0.36, 0.72, 0.6]), 0.35
"""Direction of the light (right, up, towards the viewer), and the brightness of shadows."""


def draw_faces(image: Any, corners_m: Array, colours: Array, to_px: Callable[[Array], Array]) -> None:
    """Draw triangles of closed surfaces onto an image, in place.

    Args:
        image: (height, width, 3), uint8.
        corners_m: Corners of each triangle (n, 3, 3), metres: x right, y up, z towards the viewer; counterclockwise
            from outside.
        colours: Colour of each triangle in full light (n, 3), 0 to 255, in the order of the image's channels.
        to_px: Projects points (*batch, 3) to the image (*batch, 2): x right, y down.
    """
    import cv2  # here: a quarter of a second that others need not wait for

    placed = to_px(corners_m)
    (ax, ay), (bx, by) = (placed[:, 1] - placed[:, 0]).T, (placed[:, 2] - placed[:, 0]).T
    is_seen = ax * by - ay * bx < 0.0
    corners, placed = corners_m[is_seen], placed[is_seen]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    shaded = (_DARK + (1.0 - _DARK) * 0.5 * (1.0 + normals @ _LIGHT))[:, None] * colours[is_seen]
    points = placed.round().astype(np.int32)
    for at in np.argsort(corners[..., 2].sum(axis=-1), kind="stable").tolist():
        cv2.fillConvexPoly(image, points[at], shaded[at].tolist())
