"""The local frame of a pair, views in that frame, and projections of a pair under a view.

Lift eq. 3 (Yin et al. 2018): i points from root 1 to root 2, j along both backbones, k = i x j.  A view is the
direction to the camera as coordinates (a, b, c) in that frame, scaled to length 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.orthographic import project_orthographic, view_rotmat
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.kinematics.rotation_kernels import Vector, cross, dot, length, row_of, subtract, weighted_sum
from pasdedeux.kinematics.rotation_kernels import normalise as unit
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import PAIR17

MIN_SINE = 0.2
"""Smallest sine of the angle between i and j (12 degrees); if they are more parallel, i is turned away from j."""

_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))


@dataclass(frozen=True)
class LocalFrame:
    """Local frames of pairs.

    Args:
        axes: Columns i, j, k in world axes, (*batch, 3, 3).  i and j are unit but not square to each other, k is not
            unit; the columns are always independent.
    """

    axes: Array

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

    If i is within 12 degrees of j (one person above the other), the published frame loses a dimension.  Then i is
    turned away from j, in their common plane, to 12 degrees, so that coordinates stay bounded.  Opposite backbones have
    no mean, so person A's alone is used.  Coinciding roots have no i, so it is taken square to j.
    """
    axes = _frames(*(np.ascontiguousarray(m, dtype=np.float64).reshape(-1, 2, 3) for m in (roots, backbones)))
    return LocalFrame(axes.reshape(*np.shape(roots)[:-2], 3, 3))


@compiled()
def _frames(roots: Array, backbones: Array) -> Array:
    axes = np.empty((len(roots), 3, 3))
    for row in range(len(roots)):
        between = subtract(row_of(roots[row], 1), row_of(roots[row], 0))
        columns = frame_columns(between, row_of(backbones[row], 0), row_of(backbones[row], 1))
        for column in range(3):
            for axis in range(3):
                axes[row, axis, column] = columns[column][axis]
    return axes


@inner_kernel()
def frame_columns(between: Vector, backbone_a: Vector, backbone_b: Vector) -> tuple[Vector, Vector, Vector]:
    """Return i, j, k of one pair, from the vector between its roots and its backbones."""
    a, b = unit(backbone_a), unit(backbone_b)
    both = weighted_sum(1.0, a, 1.0, b)
    j = unit(both if length(both) >= 1e-6 else a)
    if dot(j, j) == 0.0:
        j = (0.0, 1.0, 0.0)
    i = unit(between)
    cosine = dot(i, j)
    across = weighted_sum(1.0, i, -cosine, j)
    sine, is_zero = length(across), length(between) < 1e-9
    if sine < MIN_SINE or is_zero:
        if sine <= 1e-9:
            # Exactly parallel: "across" is the lean of person A against j, else some axis square to j.
            across = weighted_sum(1.0, a, -dot(a, j), j)
            if length(across) <= 1e-6:
                across = most_square_axis(j)
        across = unit(across)
        kept = math.sqrt(1.0 - MIN_SINE * MIN_SINE)
        i = across if is_zero else weighted_sum(np.sign(cosine) * kept, j, MIN_SINE, across)
    return i, j, cross(i, j)


@inner_kernel()
def most_square_axis(axis: Vector) -> Vector:
    """Return the part, square to a unit vector, of the world axis that is most nearly square to it."""
    x, y, z = abs(axis[0]), abs(axis[1]), abs(axis[2])
    if x <= y and x <= z:
        helper = (1.0, 0.0, 0.0)
    elif y <= z:
        helper = (0.0, 1.0, 0.0)
    else:
        helper = (0.0, 0.0, 1.0)
    return weighted_sum(1.0, helper, -dot(helper, axis), axis)


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
        Image points (*batch, person=2, joint=17, 2), metres, x right, y up: j points up in the image where possible,
        and the middle of the two roots is at (0, 0).  The same pair moved rigidly gives the same image.
    """
    frame = pair_frame(pair17_m)
    world = frame.direction(np.asarray(direction, dtype=np.float64))
    j = np.broadcast_to(frame.axes[..., :, 1], world.shape)
    centred = pair17_m - pair17_m[..., _PELVIS, :].mean(axis=-2)[..., None, None, :]
    flat = merge_axes(centred, -3, -1)
    image = project_orthographic(flat, view_rotmat(world, j))
    return image.reshape(*image.shape[:-2], *pair17_m.shape[-3:-1], 2)


def true_direction(pair17_m: Array, camera: PinholeCamera) -> Array:
    """Return the true views (*batch, 3) of pairs (*batch, person=2, joint=17, 3) seen by a camera.

    The view of a pinhole is the direction from the middle of the two roots to the camera, not its optical axis.
    """
    middle = pair17_m[..., _PELVIS, :].mean(axis=-2)
    return pair_frame(pair17_m).coordinates(normalise(camera.position_m - middle))


def angles_of_direction(direction: Array) -> tuple[Array, Array]:
    """Return (psi, phi) of views (*batch, 3), radians: lift eq. 4 with atan2, so psi covers the full circle.

    psi is the azimuth in the plane of i and k, from i, in (-pi, pi]; phi the polar angle from j, in [0, pi].  Along j,
    psi is 0.
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
