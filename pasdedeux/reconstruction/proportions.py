"""A person's own proportions against the reference body, estimated once per track; images moved between the two.

Bone directions are what a pose is; lengths are the person.  A bone's image is its length times the part of its
direction that lies in the image, so an image is retargeted like a pose: bone by bone.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.skeletons import OP14

__all__ = ["estimate_proportions", "retarget_image"]

Array = npt.NDArray[np.float64]

_LEAST_IN_IMAGE = 0.6
"""Bones are measured in frames where the match shows at least this part of their length."""

_LEAST_FRAMES = 5
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
        is_flat = (match > _LEAST_IN_IMAGE * REFERENCE_LENGTHS_M[child]) & (own > 0)
        count[child] = is_flat.sum()
        if count[child] >= _LEAST_FRAMES:
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
    moved = np.array(points)
    is_seen = np.asarray(np.isfinite(points).all(axis=-1))
    neck = OP14.root
    for joint in OP14.order[1:]:
        chain = []
        parent = OP14.parents[joint]
        while parent >= 0:
            chain.append(parent)
            parent = OP14.parents[parent]
        anchor_old, anchor_new = np.zeros(points[..., joint, :].shape), np.zeros(points[..., joint, :].shape)
        is_open = np.ones(is_seen.shape[:-1], dtype=bool)
        for ancestor in chain:
            is_used = np.asarray(is_open & is_seen[..., ancestor])[..., None]
            anchor_old = np.where(is_used, points[..., ancestor, :], anchor_old)
            anchor_new = np.where(is_used, moved[..., ancestor, :], anchor_new)
            is_open &= ~is_seen[..., ancestor]
        moved[..., joint, :] = anchor_new + (points[..., joint, :] - anchor_old) / ratio[joint]
    hips = mid_hip(moved)
    shift = np.where(np.isfinite(hips), hips, 0.0)
    torso = 1.0 / ratio[OP14.index("left_hip")]
    neck_shift = moved[..., neck, :] * (1.0 - torso)
    shift = np.where(np.isfinite(hips), shift, np.where(np.isfinite(neck_shift), neck_shift, 0.0))
    return np.asarray(moved - shift[..., None, :])
