"""The pair's local frame, views given in it, and projections of a pair under such a view.

Lift eq. 3 (Yin et al. 2018): i points from root 1 to root 2, j along both backbones, k = i x j.  A view is the
direction to the camera as coordinates (a, b, c) in that frame, scaled to length 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.cameras.orthographic import project_orthographic, view_rotmat
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import PAIR17

MIN_SINE = 0.2
"""Least sine of the angle between i and j (12 degrees); where they are more parallel, i is turned away from j."""

_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))


@dataclass(frozen=True)
class LocalFrame:
    """Local frames of pairs.

    Args:
        axes: Columns i, j, k in world axes, (*batch, 3, 3).  i and j are unit but not square to each other, k is not
            unit; the columns are always independent.
        is_degenerate: Where lift eq. 3 gives no good frame, (*batch,): i was parallel to j, or a vector was zero.
    """

    axes: Array
    is_degenerate: npt.NDArray[np.bool_]

    def coordinates(self, direction: Array) -> Array:
        """Return world directions (*batch, 3) as unit coordinates (a, b, c): the 3x3 system of Yin et al., scaled."""
        return normalise(
            np.asarray(np.linalg.solve(self.axes, np.asarray(direction)[..., None])[..., 0], dtype=np.float64)
        )

    def direction(self, coordinates: Array) -> Array:
        """Return the unit world directions (*batch, 3) of coordinates (a, b, c) of any length."""
        return normalise(np.einsum("...ij,...j->...i", self.axes, coordinates))


def local_frame(roots: Array, backbones: Array) -> LocalFrame:
    """Return the local frames of pairs, lift eq. 3 with its degenerate cases.

    Args:
        roots: Roots of the two people, (*batch, person=2, 3), metres.
        backbones: Vectors from pelvis to neck, (*batch, person=2, 3), of any length.

    Where i is within 12 degrees of j (one person above the other) the published frame loses a dimension; there i is
    turned away from j, in their common plane, to 12 degrees, so that coordinates stay bounded.  Opposite backbones
    have no mean: person A's alone is used.  Coinciding roots have no i: it is taken square to j.
    """
    unit = normalise(backbones)
    total = unit[..., 0, :] + unit[..., 1, :]
    is_opposite = np.linalg.norm(total, axis=-1, keepdims=True) < 1e-6
    j = normalise(np.where(is_opposite, unit[..., 0, :], total), fallback=np.array([0.0, 1.0, 0.0]))
    between = roots[..., 1, :] - roots[..., 0, :]
    i = normalise(between)
    cosine = np.sum(i * j, axis=-1, keepdims=True)
    across = i - cosine * j
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    # Exactly parallel: the lean of person A against j says where "across" is, else the world axis most square to j.
    lean = unit[..., 0, :] - np.sum(unit[..., 0, :] * j, axis=-1, keepdims=True) * j
    spare = np.eye(3)[np.argmin(np.abs(j), axis=-1)]
    spare = spare - np.sum(spare * j, axis=-1, keepdims=True) * j
    helper = np.where(np.linalg.norm(lean, axis=-1, keepdims=True) > 1e-6, lean, spare)
    across = normalise(np.where(sine > 1e-9, across, helper))
    kept_cosine = np.sign(cosine) * np.sqrt(np.clip(1.0 - np.maximum(sine, MIN_SINE) ** 2, 0.0, 1.0))
    i = np.where(sine < MIN_SINE, kept_cosine * j + MIN_SINE * across, i)
    is_zero = np.linalg.norm(between, axis=-1) < 1e-9
    i = np.where(is_zero[..., None], across, i)
    return LocalFrame(
        axes=np.stack([i, j, np.cross(i, j)], axis=-1),
        is_degenerate=np.asarray((sine[..., 0] < MIN_SINE) | is_opposite[..., 0] | is_zero),
    )


def pair_frame(pair17_m: Array) -> LocalFrame:
    """Return the local frames of 3D pairs (*batch, person=2, joint=17, 3), metres."""
    roots = pair17_m[..., _PELVIS, :]
    return local_frame(roots, pair17_m[..., _NECK, :] - roots)


def project_pair(pair17_m: Array, direction: Array) -> Array:
    """Project pairs orthographically under views given in their own local frames.

    Args:
        pair17_m: 3D pairs, (*batch, person=2, joint=17, 3), metres.
        direction: Views as coordinates (a, b, c), (*batch, 3); batch axes broadcast against those of the pairs, so one
            pair under m views is `project_pair(pair, views)` with shapes (2, 17, 3) and (m, 3).

    Returns:
        Image points (*batch, person=2, joint=17, 2), metres, x right, y up: j points up in the image as far as it can,
        and the middle of the two roots is at (0, 0).  The same pair moved rigidly gives the same image.
    """
    frame = pair_frame(pair17_m)
    world = frame.direction(np.asarray(direction, dtype=np.float64))
    j = np.broadcast_to(frame.axes[..., :, 1], world.shape)
    centred = pair17_m - pair17_m[..., _PELVIS, :].mean(axis=-2)[..., None, None, :]
    flat = centred.reshape(*centred.shape[:-3], -1, 3)
    image = project_orthographic(flat, view_rotmat(world, j))
    return image.reshape(*image.shape[:-2], *pair17_m.shape[-3:-1], 2)


def true_direction(pair17_m: Array, camera: PinholeCamera) -> Array:
    """Return the true views (*batch, 3) of pairs (*batch, person=2, joint=17, 3) seen by a camera.

    A pinhole sees the pair along the line from the middle of the two roots to the camera, not along its optical axis.
    """
    middle = pair17_m[..., _PELVIS, :].mean(axis=-2)
    return pair_frame(pair17_m).coordinates(normalise(camera.position_m - middle))


def angles_of_direction(direction: Array) -> tuple[Array, Array]:
    """Return (psi, phi) of views (*batch, 3), radians: lift eq. 4 with atan2, so psi covers the full circle.

    psi is the azimuth in the plane of i and k, from i, in (-pi, pi]; phi the polar angle from j, in [0, pi].  Straight
    along j psi is 0.
    """
    unit = normalise(np.asarray(direction, dtype=np.float64))
    psi = np.arctan2(unit[..., 2], unit[..., 0])
    phi = np.arctan2(np.hypot(unit[..., 0], unit[..., 2]), unit[..., 1])
    return psi, phi


def angle_between_directions(left: Array, right: Array) -> Array:
    """Return the angle (*batch,) in radians between directions (*batch, 3), accurate near 0 and pi."""
    a, b = normalise(left), normalise(right)
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(a * b, axis=-1)))
