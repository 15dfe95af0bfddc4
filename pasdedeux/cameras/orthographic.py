"""Orthographic projection, and conversion from pixels to metres in the image plane."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.kinematics.rotations import normalise

_FLIP_Y = np.array([1.0, -1.0])


def view_rotmat(direction: Array, up: Array) -> Array:
    """Return the rotations (*batch, 3, 3) from world to the axes of a view: x right, y up, z towards the camera.

    Args:
        direction: World direction towards the camera, (*batch, 3), of any length.
        up: World direction (*batch, 3) that points up in the image if possible; where it is parallel to
            `direction`, or zero, the world axis most square to `direction` takes its place.
    """
    z = normalise(direction)
    in_plane = up - np.sum(up * z, axis=-1, keepdims=True) * z
    is_parallel = np.linalg.norm(in_plane, axis=-1, keepdims=True) < 1e-9
    spare = np.eye(3)[np.argmin(np.abs(z), axis=-1)]
    spare = spare - np.sum(spare * z, axis=-1, keepdims=True) * z
    y = normalise(np.where(is_parallel, spare, in_plane))
    return np.stack(np.broadcast_arrays(np.cross(y, z), y, z), axis=-2)


def project_orthographic(points: Array, rotmat: Array) -> Array:
    """Project points (*batch, n, 3) with view rotations (*batch, 3, 3) to (*batch, n, 2), metres, x right, y up."""
    return np.asarray(np.einsum("...ij,...nj->...ni", rotmat[..., :2, :], points))


def metres_from_pixels(px: Array, metres_per_pixel: Array | float, origin_px: Array | None = None) -> Array:
    """Return image points (*batch, n, 2) in metres, x right and y up, of pixels, x right and y down.

    Args:
        px: Pixels, (*batch, n, 2); NaN stays NaN.
        metres_per_pixel: Scale, (*batch,) or one number.
        origin_px: Pixel that becomes (0, 0), (*batch, 2); the image's origin when not given.
    """
    scale = np.asarray(metres_per_pixel, dtype=np.float64)[..., None, None]
    origin = np.zeros(2) if origin_px is None else np.asarray(origin_px, dtype=np.float64)
    return np.asarray((px - origin[..., None, :]) * scale * _FLIP_Y)
