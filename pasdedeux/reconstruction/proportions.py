"""Proportions of a person over the reference body, estimated once per track, and images retargeted between the two.

A pose consists of bone directions; lengths belong to the person.  The image of a bone is its length times the part of
its direction in the image plane, so images are retargeted like poses, bone by bone.
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
"""Smallest part of a bone's length in the image, by the match, of frames in which it is measured."""

_MIN_FRAMES = 5
_PRIOR_FRAMES = 10.0
"""Weight of the reference proportions, in frames: short tracks stay near them."""

_RANGE = (0.6, 1.6)
"""Range of proportions of people; values beyond follow from a wrong match or scale."""


def estimate_proportions(observed_m: Array, weights: Array, matched_m: Array) -> Array:
    """Return the length of each bone (14,) as a multiple of the reference body's: mean 1, left and right tied.

    Args:
        observed_m: Joints of a track (frame, 14, 2), metres by the track's scale; NaN where not seen.
        weights: (frame, 14), 0 where not seen.
        matched_m: Images of the matched poses (frame, 14, 2), reference proportions; NaN where there is none.

    The ratio of image lengths is taken in frames in which the bone lies mostly in the image plane.  Its median over the
    track is drawn towards 1 with the weight of some frames.  The overall size, which one camera does not show, is
    removed.
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

    A joint whose parent was not seen is placed from its nearest seen ancestor; the ratio is the mean over the bones
    between, weighted by length.  A neck that was not seen is assumed between the shoulders.  Without shoulders, joints
    are placed from the mid-hip, or from the origin of `points` if a hip was not seen.  NaN stays NaN.
    """
    flat = np.array(points, dtype=np.float64, order="C").reshape(-1, OP14.num_joints, 2)
    return _retarget_images(flat, ratio).reshape(points.shape)


@compiled()
def _retarget_images(images: Array, ratio: Array) -> Array:
    """Return retargeted images (n, 14, 2); see `retarget_image`."""
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
        length, own_length = _LENGTHS_M[joint], _LENGTHS_M[joint] * ratio[joint]
        ancestor, top = _PARENTS[joint], joint
        while ancestor != _NECK and not _is_seen(points[ancestor]):
            length += _LENGTHS_M[ancestor]
            own_length += _LENGTHS_M[ancestor] * ratio[ancestor]
            ancestor, top = _PARENTS[ancestor], ancestor
        is_of_leg = _IS_HIP[top]
        if ancestor == _NECK and not has_neck and not (is_of_leg and top == joint):
            # Seen from the mid-hip, not the neck, legs are nearer by the length of the torso, all else farther.
            sign = -1.0 if is_of_leg else 1.0
            length += sign * _LENGTHS_M[_LEFT_HIP]
            own_length += sign * _LENGTHS_M[_LEFT_HIP] * ratio[_LEFT_HIP]
        for axis in range(2):
            old, new = points[ancestor, axis], moved[ancestor, axis]
            if ancestor == _NECK:
                old = new = neck[axis] if has_neck else 0.0
            moved[joint, axis] = new + (points[joint, axis] - old) / (own_length / length)
    for axis in range(2):
        shift = 0.5 * (moved[_LEFT_HIP, axis] + moved[_RIGHT_HIP, axis])
        if not np.isfinite(shift):
            shift = neck[axis] * (1.0 - 1.0 / ratio[_LEFT_HIP]) if has_neck else 0.0
        for joint in range(points.shape[0]):
            moved[joint, axis] -= shift
