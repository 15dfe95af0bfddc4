"""A person's own proportions against the reference body, estimated once per track; images moved between the two.

Bone directions are what a pose is; lengths are the person.  A bone's image is its length times the part of its
direction that lies in the image, so an image is retargeted like a pose: bone by bone.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.skeletons import OP14

__all__ = ["estimate_proportions", "retarget_image"]

Array = npt.NDArray[np.float64]

_ORDER, _PARENTS = np.array(OP14.order[1:]), np.array(OP14.parents)
_NECK, _LEFT_HIP, _RIGHT_HIP = OP14.root, OP14.index("left_hip"), OP14.index("right_hip")

_MIN_IN_IMAGE = 0.6
"""Bones are measured in frames where the match shows at least this part of their length."""

_MIN_FRAMES = 5
_PRIOR_FRAMES = 10.0
"""Weight of the reference proportions, in frames: short tracks stay near them."""

_RANGE = (0.6, 1.6)
"""Proportions of people; what lies beyond is a wrong match or a wrong scale."""


def estimate_proportions(observed_m: Array, weights: Array, matched_m: Array) -> Array:
    """Return the length of each bone (14,) as a multiple of the reference body's: mean 1, left and right tied.

    Args:
        observed_m: Joints of a track (frame, 14, 2), metres by the track's scale; NaN where not seen.
        weights: (frame, 14), 0 where not seen.
        matched_m: Images of the matched poses (frame, 14, 2), reference proportions; NaN where there is none.

    The ratio of the image lengths is taken in the frames in which the bone lies mostly in the image, its median over
    the track is drawn towards 1 by some frames' weight, and the overall size is taken out: one camera does not see it.
    """
    log_ratio, count = np.zeros(OP14.num_joints), np.zeros(OP14.num_joints)
    for parent, child in OP14.bones:
        seen = (weights[:, parent] > 0) & (weights[:, child] > 0) & np.isfinite(matched_m[:, child, 0])
        own = np.linalg.norm(observed_m[seen, child] - observed_m[seen, parent], axis=-1)
        match = np.linalg.norm(matched_m[seen, child] - matched_m[seen, parent], axis=-1)
        is_flat = (match > _MIN_IN_IMAGE * REFERENCE_LENGTHS_M[child]) & (own > 0)
        count[child] = is_flat.sum()
        if count[child] >= _MIN_FRAMES:
            log_ratio[child] = np.median(np.log(own[is_flat] / match[is_flat]))
        else:
            count[child] = 0.0
    mirror = np.array(OP14.mirror)
    both = count + count[mirror]
    tied = (count * log_ratio + count[mirror] * log_ratio[mirror]) / np.maximum(both, 1.0)
    ratio = np.clip(np.exp(tied * both / (both + _PRIOR_FRAMES)), *_RANGE)
    ratio[OP14.root] = 1.0
    return np.asarray(ratio * REFERENCE_LENGTHS_M.sum() / (ratio * REFERENCE_LENGTHS_M).sum())


def retarget_image(points: Array, ratio: Array) -> Array:
    """Return images (*batch, 14, 2) with every bone divided by its ratio (14,), centred on the mid-hip.

    A joint whose parent was not seen hangs on its nearest seen ancestor, divided by its own ratio.  Without both hips
    the image is kept where the neck, or failing that nothing, puts it.  NaN stays NaN.
    """
    flat = np.array(points, dtype=np.float64, order="C").reshape(-1, OP14.num_joints, 2)
    return _retarget_images(flat, ratio).reshape(points.shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _retarget_images(images: Array, ratio: Array) -> Array:
    """Do `retarget_image` for images (n, 14, 2)."""
    moved = images.copy()
    for at in range(images.shape[0]):
        _retarget(images[at], ratio, moved[at])
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _retarget(points: Array, ratio: Array, moved: Array) -> None:
    for joint in _ORDER:
        ancestor = _PARENTS[joint]
        while ancestor >= 0 and not (np.isfinite(points[ancestor, 0]) and np.isfinite(points[ancestor, 1])):
            ancestor = _PARENTS[ancestor]
        for axis in range(2):
            old = points[ancestor, axis] if ancestor >= 0 else 0.0
            new = moved[ancestor, axis] if ancestor >= 0 else 0.0
            moved[joint, axis] = new + (points[joint, axis] - old) / ratio[joint]
    for axis in range(2):
        shift = 0.5 * (moved[_LEFT_HIP, axis] + moved[_RIGHT_HIP, axis])
        if not np.isfinite(shift):
            shift = moved[_NECK, axis] * (1.0 - 1.0 / ratio[_LEFT_HIP])
            if not np.isfinite(shift):
                shift = 0.0
        for joint in range(points.shape[0]):
            moved[joint, axis] -= shift
