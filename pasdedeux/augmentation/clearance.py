"""Clearance: bones near each other in the source, of both people or of one, that may not come deeper into each other.

Bodies are capsules round the bones (`plausibility`).  For every two bones that come near each other the source gives
the two nearest points on their axes and the direction between them; a variant's distance of the same two points along
that direction may not fall below the source's less the gap there was.  So the term is a one-sided square of something
linear in the positions: convex, without switching, and a source that penetrates already is no worse off.  Nearest
points and directions are averaged over a moment, as they jump where bones are parallel; pairs fade in with distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from pasdedeux.augmentation.contacts import fade
from pasdedeux.augmentation.source import NUM_POINTS, Source
from pasdedeux.augmentation.spans import packer
from pasdedeux.kinematics.rotation_kernels import closest_on_segments
from pasdedeux.plausibility import body_height_m, capsule_model
from pasdedeux.skeletons import BODY22

__all__ = ["Clearance", "clearance_limits", "find_clearance", "separations"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_SMALLEST_WEIGHT = 1e-2
"""Pairs that weigh less than this share of the full weight are left out."""


_NEAR_M = (0.02, 0.06)
"""Distance of the surfaces of two bones: full weight up to the first, none from the second on."""
_SMOOTHING_S = 0.1
"""Standard deviation of the averaging of nearest points and directions over time."""


@dataclass(frozen=True)
class Clearance:
    """Pairs of bones near each other in each frame, up to M of them, filled up with pairs of no weight.

    Args:
        points: Both ends of the first bone and of the second (T, M, 4), as points 0 to 43.
        shares: What the ends contribute to the vector w between the nearest points (T, M, 4).
        normals: Unit direction of w in the source (T, M, 3).
        limits_m: Smallest distance n . w allowed (T, M), metres.
        weights: (T, M).
        is_within: Both bones are of one person (T, M).
    """

    points: Indices
    shares: Array
    normals: Array
    limits_m: Array
    weights: Array
    is_within: npt.NDArray[np.bool_]


def find_clearance(
    source: Source,
    weight_between: float,
    weight_within: float,
    girth: tuple[float, float] = (1.0, 1.0),
) -> Clearance:
    """Find the pairs of bones that are near each other in the source, or would be with the new girth of A and B."""
    model = capsule_model(BODY22)
    radii = model.radii_m(body_height_m(BODY22, source.lengths_m)).reshape(-1)
    parents = np.concatenate([model.parents, model.parents + BODY22.num_joints])
    half = BODY22.num_joints
    pairs = np.concatenate([model.between + np.array([0, half]), model.within, model.within + half])
    weight = np.full(len(pairs), weight_between)
    weight[len(model.between) :] = weight_within
    pairs, weight = pairs[weight > 0], weight[weight > 0]
    points = np.ascontiguousarray(source.positions_m.reshape(-1, NUM_POINTS, 3))
    along, gaps = _nearest(points, pairs, parents, radii)
    grown = radii * (np.repeat(girth, half) - 1.0)
    # One's own thicker limbs come nearer whatever the motion does: only the partner has to keep away from them.
    added = np.where((pairs[:, 0] < half) & (pairs[:, 1] >= half), grown[pairs].sum(axis=1), 0.0)
    nearest = gaps - np.maximum(added, 0.0)
    is_near = nearest.min(axis=0, initial=np.inf) < _NEAR_M[1]
    pairs, weight, added, along = pairs[is_near], weight[is_near], added[is_near], along[:, is_near]
    gaps, nearness = gaps[:, is_near], fade(nearest[:, is_near], *_NEAR_M)
    sigma = _SMOOTHING_S * source.rate_hz
    if len(points) > 1:
        nearness, along = (
            gaussian_filter1d(values, sigma, axis=0, mode="nearest", truncate=3.0) for values in (nearness, along)
        )
    ends = np.stack([parents[pairs[:, 0]], pairs[:, 0], parents[pairs[:, 1]], pairs[:, 1]], axis=-1)
    s, t = along[..., 0], along[..., 1]
    shares = np.stack([1.0 - s, s, t - 1.0, -t], axis=-1)
    vectors = np.einsum("tmk,tmka->tma", shares, points[:, ends])
    normals = vectors
    if len(points) > 1:
        normals = gaussian_filter1d(vectors, sigma, axis=0, mode="nearest", truncate=3.0)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    limits = (normals * vectors).sum(axis=-1) - np.maximum(gaps, 0.0) + added
    is_used = nearness > _SMALLEST_WEIGHT
    frame, column = np.nonzero(is_used)
    packed = packer(frame, len(points))
    return Clearance(
        points=packed(ends[column]),
        shares=packed(shares[is_used]),
        normals=packed(normals[is_used]),
        limits_m=packed(limits[is_used]),
        weights=packed((nearness * weight)[is_used]),
        is_within=packed(((pairs < half).all(axis=1) | (pairs >= half).all(axis=1))[column]),
    )


def separations(clearance: Clearance, points_m: Array) -> Array:
    """Return n . w (*batch, T, M), metres, of points (*batch, T, 44, 3)."""
    batch = points_m.shape[:-3]
    flat = np.ascontiguousarray(points_m).reshape(-1, *points_m.shape[-3:])
    return np.asarray(
        _separate(flat, clearance.points, clearance.shares, clearance.normals).reshape(*batch, *clearance.weights.shape)
    )


def clearance_limits(clearance: Clearance, reference_m: Array) -> Array:
    """Return the smallest n . B x (variant, T, M), metres, of x = p - r for references r (variant, T, 44, 3).

    Bones of one person are allowed what the new proportions do by themselves: limbs that shrink keep their girth.
    """
    apart = separations(clearance, reference_m)
    limits = clearance.limits_m - apart
    return np.asarray(np.where(clearance.is_within, np.minimum(limits, 0.0), limits))


@numba.njit(cache=True, nogil=True)
def _nearest(points: Array, pairs: Indices, parents: Indices, radii: Array) -> tuple[Array, Array]:
    """Return where on their bones (T, pair, 2; 0 at the parent) the nearest points are, and the gap of the surfaces."""
    frames, count = len(points), len(pairs)
    along, gaps = np.empty((frames, count, 2)), np.empty((frames, count))
    for f in range(frames):
        for row in range(count):
            one, other = pairs[row, 0], pairs[row, 1]
            a, b = points[f, parents[one]], points[f, parents[other]]
            aa = bb = ab = ag = bg = 0.0
            for i in range(3):
                u, w, g = points[f, one, i] - a[i], points[f, other, i] - b[i], a[i] - b[i]
                aa, bb, ab, ag, bg = aa + u * u, bb + w * w, ab + u * w, ag + u * g, bg + w * g
            # Parallel bones: half way is as good as any, and does not jump.
            s, inside = closest_on_segments(aa, bb, ab, ag, bg, 0.5)
            squared = 0.0
            for i in range(3):
                u, w, g = points[f, one, i] - a[i], points[f, other, i] - b[i], a[i] - b[i]
                squared += (g + s * u - inside * w) ** 2
            along[f, row, 0], along[f, row, 1] = s, inside
            gaps[f, row] = np.sqrt(squared) - radii[one] - radii[other]
    return along, gaps


@numba.njit(cache=True, nogil=True)
def _separate(points_m: Array, points: Indices, shares: Array, normals: Array) -> Array:
    count, frames, pairs = len(points_m), points.shape[0], points.shape[1]
    apart = np.zeros((count, frames, pairs))
    for v in range(count):
        for t in range(frames):
            for e in range(pairs):
                total = 0.0
                for k in range(4):
                    point, share = points[t, e, k], shares[t, e, k]
                    for i in range(3):
                        total += share * normals[t, e, i] * points_m[v, t, point, i]
                apart[v, t, e] = total
    return apart
