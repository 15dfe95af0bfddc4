"""Compiled inner loops of frontier growth."""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["keep_nearest", "place_bones"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_LEAST_DEPTH_M = 1e-4
"""Depth that a bone without any keeps: its side of the image plane, metres."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def place_bones(
    image: Array, depth: Array, lengths: Array, order: Indices, parents: Indices, tightness: float, out: Array
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
        tightness: Weight of the squared depth against the squared image distance; positive.
        out: Result (person, joint, 3), metres, camera axes.
    """
    least = min(1.0, tightness)
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
            if abs(z) < _LEAST_DEPTH_M:
                z = _LEAST_DEPTH_M if z >= 0.0 else -_LEAST_DEPTH_M
            z *= tightness
            flat = x * x + y * y
            squared = lengths[person, j] ** 2
            # The multiplier of the sphere: the length of the weighted mean falls as it grows.
            low, high = -least, 1.0
            while flat / (1.0 + high) ** 2 + (z / (tightness + high)) ** 2 > squared and high < 1e12:
                high *= 4.0
            for _ in range(50):
                middle = 0.5 * (low + high)
                if flat / (1.0 + middle) ** 2 + (z / (tightness + middle)) ** 2 > squared:
                    low = middle
                else:
                    high = middle
            x, y, z = x / (1.0 + high), y / (1.0 + high), z / (tightness + high)
            scale = lengths[person, j] / max(math.sqrt(x * x + y * y + z * z), 1e-300)
            out[person, j, 0] = out[person, p, 0] + scale * x
            out[person, j, 1] = out[person, p, 1] + scale * y
            out[person, j, 2] = out[person, p, 2] + scale * z


@numba.njit(cache=True, nogil=True)
def keep_nearest(residual: Array, index: int, best: Array, which: Indices) -> None:
    """Enter a lifted pair into the sorted lists of the nearest ones of every entry.

    Args:
        residual: Distance of pair `index` from every entry, (entry,).
        index: The pair.
        best: Least distances of each entry so far, rising, (entry, k); overwritten.
        which: The pairs that have them, (entry, k); overwritten.
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
