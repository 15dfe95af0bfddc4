"""Shape contexts of pairs: histograms of the directions and distances of all other joints, seen from each joint.

After Belongie, Malik and Puzicha (2002), "Shape matching and object recognition using shape contexts": five shells
whose radii double, twelve sectors, chi-squared cost; the sectors turn about the vertical of the pair's local frame and
are cut into six bands of equal area.  We differ in this: joints have names, so each is compared with itself without an
assignment; shells are in metres, because people have a known size, and the outermost one is unbounded.  Yin et al.
(2018) compare with "the matching error in 3D shape contexts" and say no more.

The dissimilarity is the mean cost over the joints: 0 for the same histograms, 1 for histograms that share nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.frames import pair_frame
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import align_plane
from pasdedeux.kinematics.rotations import normalise

Bins = npt.NDArray[np.int16]

NUM_SHELLS, NUM_SECTORS, NUM_BANDS = 5, 12, 6
INNER_RADIUS_M = 0.1
"""Radius of the innermost shell, metres; an eighth of the mean distance between joints of a pair, about 0.8 m."""
NUM_PLANE_BINS = NUM_SHELLS * NUM_SECTORS
_NUM_PAIR_BINS = NUM_PLANE_BINS * NUM_BANDS
_ESTIMATE_SLACK = 1e-9
"""Largest difference of sums in another order; a thousand terms differ by 1e-13."""


def plane_polar(points_m: Array) -> tuple[Bins, Array]:
    """Return the first bin of the shell, and the angle in turns, of all others seen from points (*batch, n, 2), metres.

    Both are (*batch, n, n - 1); the sector of an angle is added to the bin.
    """
    towards = _others(points_m)
    return _shell(np.linalg.norm(towards, axis=-1)) * NUM_SECTORS, _turn(towards[..., 0], towards[..., 1])


def plane_bins(points_m: Array) -> Bins:
    """Return the bin (*batch, n, n - 1) of every other one of points (*batch, n, 2), metres, seen from each."""
    first, turns = plane_polar(points_m)
    return np.asarray(first + _sector(turns))


def plane_shape_dissimilarity(moving_m: Array, fixed_m: Array) -> Array:
    """Return the 2D shape-context dissimilarity (*batch,) of points (*batch, n, 2), metres, after the best turn."""
    costs = []
    for points in np.broadcast_arrays(align_plane(moving_m, fixed_m), fixed_m):
        costs.append((plane_bins(points)[..., None] == np.arange(NUM_PLANE_BINS)).mean(axis=-2))
    first, other = costs
    total = first + other
    cost = 0.5 * np.sum((first - other) ** 2 / np.where(total > 0.0, total, 1.0), axis=-1)
    return np.asarray(cost.mean(axis=-1))


def shared_gains(num_seen: int) -> Array:
    """Return the gain of one more joint in a bin, (num_seen + 1, num_seen + 1), see `lower_shape_minima`.

    Indices are the numbers of joints that were in the bin before, and of the other shape's, out of `num_seen`.
    """
    a, b = np.meshgrid(np.arange(num_seen + 2), np.arange(num_seen + 1), indexing="ij")
    return np.diff(2.0 * a * b / np.maximum(a + b, 1) / num_seen, axis=0)


def shape_bins(pairs_m: Array) -> Bins:
    """Return the bin (*batch, joint=34, other=33) that each other joint falls into, seen from each joint.

    Args:
        pairs_m: Pairs (*batch, person=2, joint=17, 3), metres.

    Raises:
        InputError: A coordinate is not finite.
    """
    pairs = np.asarray(pairs_m, dtype=np.float64)
    if not np.isfinite(pairs).all():
        raise InputError("shape contexts need finite joints, found one that is not")
    axes = pair_frame(pairs).axes
    up = axes[..., 1]
    ahead = normalise(axes[..., 0] - np.sum(axes[..., 0] * up, axis=-1, keepdims=True) * up)
    frame = np.stack([ahead, up, np.cross(ahead, up)], axis=-2)
    points = np.einsum("...ij,...nj->...ni", frame, merge_axes(pairs, -3, -1))
    towards = _others(points)
    radius = np.linalg.norm(towards, axis=-1)
    height = towards[..., 1] / np.maximum(radius, 1e-12)
    band = np.minimum((0.5 * (height + 1.0) * NUM_BANDS).astype(np.int16), NUM_BANDS - 1)
    return np.asarray(
        (_shell(radius) * NUM_SECTORS + _sector(_turn(towards[..., 0], towards[..., 2]))) * NUM_BANDS + band
    )


class ShapeCoverage:
    """Smallest D_S of real pairs to pairs that arrive in batches: memory does not grow with their number.

    Args:
        real_m: Real pairs (real, person=2, joint=17, 3), metres; at least one.

    Raises:
        InputError: There is no real pair, or a coordinate is not finite.
    """

    def __init__(self, real_m: Array) -> None:
        if len(real_m) == 0:
            raise InputError("coverage needs at least one real pair")
        bins = shape_bins(real_m)
        self._counts = np.zeros((*bins.shape[:2], _NUM_PAIR_BINS), dtype=np.uint8)
        rows = np.arange(bins.shape[0])[:, None, None]
        np.add.at(self._counts, (rows, np.arange(bins.shape[1])[:, None], bins), 1)
        self._best = np.full(len(bins), np.inf)

    def add(self, bins: Bins) -> None:
        """Take more pairs into account, of which `shape_bins` gave these."""
        gains = shared_gains(self._counts.shape[1] - 1)
        sums = np.insert(gains.cumsum(axis=0), 0, 0.0, axis=0)
        lower_shape_minima(self._counts, np.ascontiguousarray(bins, dtype=np.uint16), gains, sums, self._best)

    @property
    def shape(self) -> Array:
        """Smallest D_S of each real pair to any pair so far, (real,); inf before the first."""
        return self._best.copy()


@compiled()
def lower_shape_minima(counts, bins, gains, sums, best):  # type: ignore[no-untyped-def]
    """Lower the running minima of D_S of each real pair to those of others.

    With shares a and b, half the sum of (a - b)^2 / (a + b) is 1 - 2 sum of a b / (a + b): only shared bins count. Few
    of the others come near. This is first estimated, each bin taken once, joint by joint until one is known not to.

    Args:
        counts: Joints in each bin, (real, joint, bin), uint8.
        bins: Bins of the others, (other, joint, joint - 1), uint16.
        gains: Reduction of the cost by one more joint in a bin, see `shared_gains`.
        sums: Reduction of the cost by the first joints in a bin together, (joint, joint).
        best: Running minima (real,); changed in place.
    """
    num_others, num_joints, num_seen = bins.shape
    distinct, numbers = np.empty(bins.shape, np.uint16), np.empty(bins.shape, np.uint8)
    before, num_distinct = np.empty(bins.shape, np.uint8), np.empty((num_others, num_joints), np.int64)
    in_bin = np.zeros(counts.shape[2], dtype=np.uint8)
    for column in range(num_others):
        for joint in range(num_joints):
            for k in range(num_seen):
                at = bins[column, joint, k]
                before[column, joint, k] = in_bin[at]
                in_bin[at] += 1
            count = 0
            for k in range(num_seen):
                at = bins[column, joint, k]
                if in_bin[at] > 0:
                    distinct[column, joint, count], numbers[column, joint, count] = at, in_bin[at]
                    in_bin[at] = 0
                    count += 1
            num_distinct[column, joint] = count
    for row in range(counts.shape[0]):
        for column in range(num_others):
            limit = best[row] * num_joints
            cost = 0.0
            for joint in range(num_joints):
                shared = 0.0
                for k in range(num_distinct[column, joint]):
                    shared += sums[numbers[column, joint, k], counts[row, joint, distinct[column, joint, k]]]
                cost += 1.0 - shared
                if cost >= limit + _ESTIMATE_SLACK:
                    break
            if cost >= limit + _ESTIMATE_SLACK:
                continue
            cost = 0.0
            for joint in range(num_joints):
                cost += 1.0
                for k in range(num_seen):
                    at = bins[column, joint, k]
                    cost -= gains[before[column, joint, k], counts[row, joint, at]]
            if cost < limit:
                best[row] = cost / num_joints


def _others(points: Array) -> Array:
    """Return the vectors (*batch, n, n - 1, d) from each of points (*batch, n, d) to all others."""
    count = points.shape[-2]
    towards = points[..., None, :, :] - points[..., :, None, :]
    is_other = ~np.eye(count, dtype=bool)
    return np.asarray(towards[..., is_other, :].reshape(*points.shape[:-2], count, count - 1, points.shape[-1]))


def _shell(radius: Array) -> Bins:
    shell = np.floor(np.log2(np.maximum(radius, 1e-12) / INNER_RADIUS_M)) + 1
    return np.asarray(np.clip(shell, 0, NUM_SHELLS - 1), dtype=np.int16)


def _turn(x: Array, y: Array) -> Array:
    """Return the angle from x towards y, in turns, from 0 to 1."""
    return np.asarray(np.arctan2(y, x) / (2.0 * np.pi) % 1.0)


def _sector(turns: Array) -> Bins:
    return np.asarray(np.minimum((turns * NUM_SECTORS).astype(np.int16), NUM_SECTORS - 1))
