"""Clearance: bones near each other in the source, of two people or one, must not penetrate each other more deeply.

Bodies are capsules round the bones (`plausibility`).  For every two bones that come near each other the source gives
the two nearest points on their axes and the direction between them; a variant's distance of the same two points along
that direction may not fall below the source's less the gap there was.  So the term is a one-sided square of something
linear in the positions: convex, without switching, and harmless for a source that already penetrates.  Nearest points
and directions are averaged over a moment, as they jump where bones are parallel; pairs fade in with distance. Pairs
that only follow what a next bone does (`standing_out`) weigh little: a shorter shank on a back brings the knee nearer
to it, which must not lift the shank.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.augmentation.source import Source, points_of
from pasdedeux.interaction.contacts import averaged, packer, stencil_vectors
from pasdedeux.interaction.surfaces import fade, nearest_on_bones, parents_of, standing_out
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import BODY22

_SMALLEST_WEIGHT = 1e-2
"""Pairs that weigh less than this share of the full weight are dropped."""


_NEAR_M = (0.03, 0.1)
"""Distance of the surfaces of two bones in the source: full weight up to the first, none from the second on.  Wide,
because other bodies may come nearer than the source's; bones that stay apart cost nothing."""
_FOLLOWING = 0.1
"""Share of its weight that a pair of two people's bones keeps if a next bone is much closer."""
_SMOOTHING_S = 0.1
"""Standard deviation of the averaging of nearest points and directions over time."""


@dataclass(frozen=True)
class Clearance:
    """Pairs of bones near each other in each frame, up to M of them, filled up with pairs of no weight.

    Args:
        points: Both ends of the first bone and of the second (T, M, 4), as points 0 to n - 1.
        shares: What the ends contribute to the vector w between the nearest points (T, M, 4).
        normals: Unit direction of w in the source (T, M, 3).
        limits_m: Smallest distance n . w allowed (T, M), metres.
        weights: (T, M).
        is_within: Both bones are of one person (T, M).
    """

    points: Integers
    shares: Array
    normals: Array
    limits_m: Array
    weights: Array
    is_within: Flags


def find_clearance(source: Source, weight_between: float, weight_within: float) -> Clearance:
    """Find the pairs of bones that are near each other in the source."""
    model = capsule_model(BODY22)
    radii = source.radii_m.reshape(-1)
    parents = parents_of(BODY22, source.num_people)
    joints = BODY22.num_joints
    first = np.arange(source.num_people) * joints
    between = [model.between + np.array(ends) for ends in combinations(first, 2)]
    pairs = np.concatenate([*between, *(model.within + offset for offset in first)])
    is_within = pairs[:, 0] // joints == pairs[:, 1] // joints
    weight = np.where(is_within, weight_within, weight_between)
    pairs, weight, is_within = (values[weight > 0] for values in (pairs, weight, is_within))
    points = np.ascontiguousarray(points_of(source.positions_m))
    along, gaps = nearest_on_bones(points, pairs, parents, radii)
    follows = np.maximum(standing_out(pairs, along, gaps, BODY22), _FOLLOWING)
    nearness = fade(gaps, *_NEAR_M) * np.where(is_within, 1.0, follows)
    is_near = gaps.min(axis=0, initial=np.inf) < _NEAR_M[1]
    pairs, weight, is_within = (values[is_near] for values in (pairs, weight, is_within))
    along, gaps, nearness = (values[:, is_near] for values in (along, gaps, nearness))
    sigma = _SMOOTHING_S * source.rate_hz
    nearness, along = averaged(nearness, sigma), averaged(along, sigma)
    ends = np.stack([parents[pairs[:, 0]], pairs[:, 0], parents[pairs[:, 1]], pairs[:, 1]], axis=-1)
    s, t = along[..., 0], along[..., 1]
    shares = np.stack([1.0 - s, s, t - 1.0, -t], axis=-1)
    vectors = stencil_vectors(np.broadcast_to(ends, shares.shape), shares, points)
    normals = averaged(vectors, sigma)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    limits = (normals * vectors).sum(axis=-1) - np.maximum(gaps, 0.0)
    is_used = nearness > _SMALLEST_WEIGHT
    frame, column = np.nonzero(is_used)
    packed = packer(frame, len(points))
    return Clearance(
        points=packed(ends[column]),
        shares=packed(shares[is_used]),
        normals=packed(normals[is_used]),
        limits_m=packed(limits[is_used]),
        weights=packed((nearness * weight)[is_used]),
        is_within=packed(is_within[column]),
    )


def separations(clearance: Clearance, points_m: Array) -> Array:
    """Return n . w (*batch, T, M), metres, of points (*batch, T, n, 3)."""
    vectors = stencil_vectors(clearance.points, clearance.shares, points_m)
    return np.asarray((vectors * clearance.normals).sum(axis=-1))


def clearance_limits(clearance: Clearance, reference_m: Array) -> Array:
    """Return the smallest n . B x (variant, T, M), metres, of x = p - r for references r (variant, T, n, 3).

    Within a person, penetration by the new proportions alone is allowed: shorter limbs keep their thickness.
    """
    allowed = np.where(clearance.is_within, clearance.limits_m, np.maximum(clearance.limits_m, 0.0))
    limits = allowed - separations(clearance, reference_m)
    return np.asarray(np.where(clearance.is_within, np.minimum(limits, 0.0), limits))
