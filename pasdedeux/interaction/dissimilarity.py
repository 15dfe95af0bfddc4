"""Dissimilarities between pairs: interaction coordinates d_I in 2D, D_I in 3D, and the Cartesian D_C, in plain numpy.

These are the definitions and the oracle; `kernels` has the fast forms.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.interaction.graph import Edges, delaunay_edges
from pasdedeux.kinematics import align_rigid

__all__ = [
    "BETA_M",
    "align_plane",
    "cartesian_dissimilarity",
    "edge_vectors",
    "edge_weights",
    "interaction_dissimilarity",
    "plane_residual",
]

Array = npt.NDArray[np.float64]

BETA_M = 0.05
"""Edge length below which weights stop growing, metres (Yin et al. 2018, eq. 8: beta)."""


def edge_vectors(points: Array, edges: Edges) -> Array:
    """Return the interaction coordinates (*batch, edge, d): the vector along each edge of points (*batch, n, d)."""
    return np.asarray(points[..., edges[:, 1], :] - points[..., edges[:, 0], :])


def edge_weights(points: Array, edges: Edges, *, beta_m: float = BETA_M) -> Array:
    """Return the weights (edge,) of eq. 8 over the edges of points (n, d): 1 / max(beta, length), scaled to sum to 1.

    Without edges the result is empty.
    """
    weight = 1.0 / np.maximum(beta_m, np.linalg.norm(edge_vectors(points, edges), axis=-1))
    return np.asarray(weight / weight.sum()) if len(weight) else weight


def plane_residual(moving: Array, fixed: Array) -> Array:
    """Return the squared distance (*batch,), square metres, left by the best rotation in the plane.

    Args:
        moving: Points (*batch, n, 2).
        fixed: Points (*batch, n, 2); batch axes broadcast.

    Closed form on centred points: |s|^2 + |p|^2 - 2 sqrt(a^2 + b^2) with a = sum s . p and b = sum s x p.  It is
    rigid: there is no scale, and it cannot reflect.
    """
    s = moving - moving.mean(axis=-2, keepdims=True)
    p = fixed - fixed.mean(axis=-2, keepdims=True)
    a = np.sum(s * p, axis=(-1, -2))
    b = np.sum(s[..., 0] * p[..., 1] - s[..., 1] * p[..., 0], axis=-1)
    squares = np.sum(s * s, axis=(-1, -2)) + np.sum(p * p, axis=(-1, -2))
    return np.asarray(np.maximum(squares - 2.0 * np.hypot(a, b), 0.0))


def align_plane(moving: Array, fixed: Array) -> Array:
    """Return points `moving` (*batch, n, 2) turned and shifted, least squares, onto `fixed` (*batch, n, 2).

    Points that all coincide are only shifted.
    """
    centre = fixed.mean(axis=-2, keepdims=True)
    s = moving - moving.mean(axis=-2, keepdims=True)
    p = fixed - centre
    a = np.sum(s * p, axis=(-1, -2))
    b = np.sum(s[..., 0] * p[..., 1] - s[..., 1] * p[..., 0], axis=-1)
    length = np.hypot(a, b)
    is_free = length <= 1e-300
    cosine = np.where(is_free, 1.0, a / np.where(is_free, 1.0, length))[..., None]
    sine = np.where(is_free, 0.0, b / np.where(is_free, 1.0, length))[..., None]
    turned = np.stack([cosine * s[..., 0] - sine * s[..., 1], sine * s[..., 0] + cosine * s[..., 1]], axis=-1)
    return np.asarray(turned + centre)


def interaction_dissimilarity(first: Array, second: Array, *, beta_m: float = BETA_M) -> float:
    """Return d_I of eq. 8 (Yin et al. 2018) between two point sets (n, d), metres: D_I when d is 3.

    `first` is brought onto `second` by the best proper rigid motion; then the edge vectors of both are compared over
    the Delaunay graph of each, weighted by 1 / max(beta, own edge length), each side divided by its sum of weights.  It
    is symmetric and 0 for the same shape, but no metric: edges change with the points.

    Raises:
        InputError: A coordinate is not finite.
    """
    first_edges, second_edges = delaunay_edges(first), delaunay_edges(second)
    moved = align_plane(first, second) if first.shape[-1] == 2 else align_rigid(first, second).apply(first)
    difference = moved - second
    total = 0.0
    for points, edges in ((first, first_edges), (second, second_edges)):
        lengths = np.linalg.norm(edge_vectors(difference, edges), axis=-1)
        total += float(np.sum(edge_weights(points, edges, beta_m=beta_m) * lengths))
    return total


def cartesian_dissimilarity(first: Array, second: Array) -> Array:
    """Return D_C: the mean joint distance (*batch,), metres, after the best proper rigid motion of the whole pair.

    Both are (*batch, n, 3) with the joints of both people along n.
    """
    moved = align_rigid(first, second).apply(first)
    return np.asarray(np.linalg.norm(moved - second, axis=-1).mean(axis=-1))
