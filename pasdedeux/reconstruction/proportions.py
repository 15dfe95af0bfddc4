"""A person's own proportions against the reference body, estimated once per track; images moved between the two.

Bone directions are what a pose is; lengths are the person.  A bone's image is its length times the part of its
direction that lies in the image, so an image is retargeted like a pose: bone by bone.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.skeletons import OP14

_ORDER, _PARENTS = np.array(OP14.order[1:]), np.array(OP14.parents)
_LENGTHS_M = REFERENCE_LENGTHS_M
_NECK, _LEFT_HIP, _RIGHT_HIP = OP14.root, OP14.index("left_hip"), OP14.index("right_hip")
_IS_HIP = np.isin(np.arange(OP14.num_joints), (_LEFT_HIP, _RIGHT_HIP))
_LEFT_SHOULDER, _RIGHT_SHOULDER = OP14.index("left_shoulder"), OP14.index("right_shoulder")

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
        seen_length = np.linalg.norm(observed_m[seen, child] - observed_m[seen, parent], axis=-1)
        match = np.linalg.norm(matched_m[seen, child] - matched_m[seen, parent], axis=-1)
        is_flat = (match > _MIN_IN_IMAGE * REFERENCE_LENGTHS_M[child]) & (seen_length > 0)
        count[child] = is_flat.sum()
        if count[child] >= _MIN_FRAMES:
            log_ratio[child] = np.median(np.log(seen_length[is_flat] / match[is_flat]))
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

    A joint whose parent was not seen hangs on its nearest seen ancestor, divided by the mean ratio of the bones between
    by their lengths.  A neck that was not seen is taken to be between the shoulders; without those the joints below it
    hang on the mid-hip, which is where both hips are, else at the origin of `points`.  NaN stays NaN.
    """
    flat = np.array(points, dtype=np.float64, order="C").reshape(-1, OP14.num_joints, 2)
    return _retarget_images(flat, ratio).reshape(points.shape)


@compiled()
def _retarget_images(images: Array, ratio: Array) -> Array:
    """Do `retarget_image` for images (n, 14, 2)."""
    moved = images.copy()
    for at in range(images.shape[0]):
        _retarget(images[at], ratio, moved[at])
    return moved


@inner_kernel()
def _is_seen(point: Array) -> bool:
    return np.isfinite(point[0]) and np.isfinite(point[1])


@inner_kernel()
def _retarget(points: Array, ratio: Array, moved: Array) -> None:
    neck = points[_NECK].copy()
    if not _is_seen(neck):
        for axis in range(2):
            neck[axis] = 0.5 * (points[_LEFT_SHOULDER, axis] + points[_RIGHT_SHOULDER, axis])
    has_neck = _is_seen(neck)
    for joint in _ORDER:
        length, own = _LENGTHS_M[joint], _LENGTHS_M[joint] * ratio[joint]
        ancestor, top = _PARENTS[joint], joint
        while ancestor != _NECK and not _is_seen(points[ancestor]):
            length += _LENGTHS_M[ancestor]
            own += _LENGTHS_M[ancestor] * ratio[ancestor]
            ancestor, top = _PARENTS[ancestor], ancestor
        is_of_leg = _IS_HIP[top]
        if ancestor == _NECK and not has_neck and not (is_of_leg and top == joint):
            # From the mid-hip legs are nearer than from the neck, and all else is farther, by the torso.
            sign = -1.0 if is_of_leg else 1.0
            length += sign * _LENGTHS_M[_LEFT_HIP]
            own += sign * _LENGTHS_M[_LEFT_HIP] * ratio[_LEFT_HIP]
        for axis in range(2):
            old, new = points[ancestor, axis], moved[ancestor, axis]
            if ancestor == _NECK:
                old = new = neck[axis] if has_neck else 0.0
            moved[joint, axis] = new + (points[joint, axis] - old) / (own / length)
    for axis in range(2):
        shift = 0.5 * (moved[_LEFT_HIP, axis] + moved[_RIGHT_HIP, axis])
        if not np.isfinite(shift):
            shift = neck[axis] * (1.0 - 1.0 / ratio[_LEFT_HIP]) if has_neck else 0.0
        for joint in range(points.shape[0]):
            moved[joint, axis] -= shift
