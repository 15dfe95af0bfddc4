"""Compiled inner loops of frontier growth."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled, inner_kernel

LANES = 64
"""Entries side by side in memory; arithmetic is vectorised over them, so that sums keep their order."""
Indices = npt.NDArray[np.int64]

_MIN_DEPTH_M = 1e-4
"""Depth of a bone without any, which keeps its side of the image plane, metres."""


@compiled()
def place_near_image(
    image: Array, depth: Array, lengths: Array, order: Indices, parents: Indices, tightness: Array, out: Array
) -> None:
    """Place the joints of both people near an image and near given depths, with exact bone lengths, root outward.

    Each bone minimises |its image - the annotated one|^2 + tightness |its depth - the given one|^2 on its sphere, from
    where its parent was placed, so errors in the image do not add up along a limb.

    Args:
        image: Image points (person, joint, 2), metres.
        depth: Depths (person, joint), towards the camera, metres; differences along bones count.
        lengths: Bone lengths (person, joint), metres; a root's is unused.
        order: Joints from the root outward.
        parents: Parent of each joint, -1 for the root.
        tightness: Weight of the squared depth against the squared image distance, (person, joint); positive.
        out: Result (person, joint, 3), metres, camera axes.
    """
    for person in range(image.shape[0]):
        for at in range(order.shape[0]):
            j = order[at]
            p = parents[j]
            if p < 0:
                out[person, j, 0], out[person, j, 1] = image[person, j, 0], image[person, j, 1]
                out[person, j, 2] = depth[person, j]
                continue
            x = image[person, j, 0] - out[person, p, 0]
            y = image[person, j, 1] - out[person, p, 1]
            z = depth[person, j] - depth[person, p]
            if abs(z) < _MIN_DEPTH_M:
                z = _MIN_DEPTH_M if z >= 0.0 else -_MIN_DEPTH_M
            tight = tightness[person, j]
            z *= tight
            flat = x * x + y * y
            squared = lengths[person, j] ** 2
            # The multiplier of the sphere: the length of the weighted mean falls as it grows.
            low, high = -min(1.0, tight), 1.0
            while flat / (1.0 + high) ** 2 + (z / (tight + high)) ** 2 > squared and high < 1e12:
                high *= 4.0
            for _ in range(50):
                middle = 0.5 * (low + high)
                if flat / (1.0 + middle) ** 2 + (z / (tight + middle)) ** 2 > squared:
                    low = middle
                else:
                    high = middle
            x, y, z = x / (1.0 + high), y / (1.0 + high), z / (tight + high)
            scale = lengths[person, j] / max(math.sqrt(x * x + y * y + z * z), 1e-300)
            out[person, j, 0] = out[person, p, 0] + scale * x
            out[person, j, 1] = out[person, p, 1] + scale * y
            out[person, j, 2] = out[person, p, 2] + scale * z


@compiled()
def write_image_distances(
    points: Array,
    spread: Array,
    axes: Array,
    directions: Array,
    images: Array,
    squares: Array,
    missing: Indices,
    num_missing: Indices,
    residual: Array,
) -> None:
    """Write the distance of a pair under many views from their images (`growth.ViewedImages`), over the joints shown.

    Args:
        points: Centred joints of both people, coordinate before joint, (3, n), metres.
        spread: points points', (3, 3).
        axes: Columns i, j, k of the pair's local frame, (3, 3).
        directions: Views (entry, 3) in that frame.
        images: Centred images in blocks of entries, (block, 2, n, LANES), metres; 0 where a joint is not seen.
        squares: Sum of squares of each image, (entry,).
        missing: Joints that an image does not show, (entry, most).
        num_missing: Their number, (entry,).
        residual: Result (entry,), metres.
    """
    sums = np.empty((2, 3, LANES))
    for entry in range(residual.shape[0]):
        lane = entry % LANES
        if lane == 0:
            _covariances(points, images[entry // LANES], sums)
        # The pair's own spread, and its mean, over the joints that are seen.
        num_points = points.shape[1] - num_missing[entry]
        xx, yy, zz, xy, xz, yz = spread[0, 0], spread[1, 1], spread[2, 2], spread[0, 1], spread[0, 2], spread[1, 2]
        if num_missing[entry]:
            mx = my = mz = 0.0
            for k in missing[entry, : num_missing[entry]]:
                px, py, pz = points[0, k], points[1, k], points[2, k]
                mx, my, mz = mx + px, my + py, mz + pz
                xx, yy, zz = xx - px * px, yy - py * py, zz - pz * pz
                xy, xz, yz = xy - px * py, xz - px * pz, yz - py * pz
            xx, yy, zz = xx - mx * mx / num_points, yy - my * my / num_points, zz - mz * mz / num_points
            xy, xz, yz = xy - mx * my / num_points, xz - mx * mz / num_points, yz - my * mz / num_points
        a, b, c = directions[entry, 0], directions[entry, 1], directions[entry, 2]
        x = axes[0, 0] * a + axes[0, 1] * b + axes[0, 2] * c
        y = axes[1, 0] * a + axes[1, 1] * b + axes[1, 2] * c
        z = axes[2, 0] * a + axes[2, 1] * b + axes[2, 2] * c
        length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
        x, y, z = x / length, y / length, z / length
        ux, uy, uz = sums[0, 0, lane], sums[0, 1, lane], sums[0, 2, lane]
        vx, vy, vz = sums[1, 0, lane], sums[1, 1, lane], sums[1, 2, lane]
        best = ux * ux + uy * uy + uz * uz - (ux * x + uy * y + uz * z) ** 2
        best += vx * vx + vy * vy + vz * vz - (vx * x + vy * y + vz * z) ** 2
        best += 2.0 * (x * (uy * vz - uz * vy) + y * (uz * vx - ux * vz) + z * (ux * vy - uy * vx))
        sx, sy, sz = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
        squared = xx + yy + zz - (x * sx + y * sy + z * sz) + squares[entry] - 2.0 * math.sqrt(max(best, 0.0))
        residual[entry] = math.sqrt(max(squared, 0.0) / num_points)


@inner_kernel()
def _covariances(points: Array, images: Array, sums: Array) -> None:
    """Write the sums over the joints (2, 3, LANES) of the images (2, n, LANES) times the pair (3, n); n is even."""
    sums[:] = 0.0
    for axis in range(2):
        for other in range(3):
            total = sums[axis, other]
            for k in range(0, points.shape[1], 2):
                row, weight = images[axis, k], points[other, k]
                next_row, next_weight = images[axis, k + 1], points[other, k + 1]
                for lane in range(LANES):
                    total[lane] += row[lane] * weight + next_row[lane] * next_weight


@compiled()
def keep_nearest(residual: Array, index: int, best: Array, which: Indices) -> None:
    """Enter a lifted pair into the sorted lists of the nearest ones of every entry.

    Args:
        residual: Distance of pair `index` from every entry, (entry,).
        index: The pair.
        best: Smallest distances of each entry so far, rising, (entry, k); overwritten.
        which: The pairs with these distances, (entry, k); overwritten.
    """
    last = best.shape[1] - 1
    for entry in range(residual.shape[0]):
        value = residual[entry]
        if not value < best[entry, last]:
            continue
        at = last
        while at > 0 and best[entry, at - 1] > value:
            best[entry, at] = best[entry, at - 1]
            which[entry, at] = which[entry, at - 1]
            at -= 1
        best[entry, at] = value
        which[entry, at] = index
