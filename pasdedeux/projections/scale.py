"""Scale and place of a track of 2D keypoints: metres per pixel, and the image of the mid-hip.

Eq. 1 compares images in metres about the mid-hip, so a track needs both.  The paper scales every frame's bounding box
to one height, which a raised arm or a missing foot changes.  Here, they follow from bone lengths of the reference body
over the track, and then from the matched poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, interpolate
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.skeletons import OP14

_PARENT = np.array([parent for parent, _ in OP14.bones])
_CHILD = np.array([child for _, child in OP14.bones])
_QUANTILE = 0.75
_MIN_BONES = 3
_PATH_ORDER = 2


@dataclass(frozen=True)
class ScaleReference:
    """Statistics of a database for the scale estimate.

    Args:
        typical_ratio: Median over projections of the upper quartile over bones of image length over bone length.
        mean_m: Mean image position of each joint about the mid-hip (14, 2), metres.
        variance_m2: Variance of each joint's image position (14,), square metres.
    """

    typical_ratio: float
    mean_m: Array
    variance_m2: Array

    @classmethod
    def of(cls, database: Database) -> ScaleReference:
        """Return the statistics of up to 2,000 evenly spaced poses of a database."""
        rows = np.unique(np.linspace(0, database.num_rows - 1, 2000).astype(int))
        sample = Database(
            poses_m=database.poses_m[rows],
            is_sequence_start=np.ones(len(rows), dtype=bool),
            num_yaws=database.num_yaws,
            camera=database.camera,
        )
        projections = sample.project().reshape(-1, OP14.num_joints, 2).astype(np.float64)
        return cls(
            typical_ratio=float(np.median(_upper_ratio(projections, np.ones(projections.shape[:-1])))),
            mean_m=projections.mean(axis=0),
            variance_m2=projections.var(axis=0).sum(axis=-1) + 1e-4,
        )


@dataclass(frozen=True)
class Placement:
    """Scale and place of every frame of a track.

    Args:
        metres_per_pixel: (frame,); NaN where unknown.
        mid_hip_px: Image of the mid-hip (frame, 2), x right, y up; NaN where unknown.
    """

    metres_per_pixel: Array
    mid_hip_px: Array

    def to_metres(self, keypoints_px: Array) -> Array:
        """Return keypoints (frame, 14, 2), pixels with y up, in metres about the mid-hip."""
        return (keypoints_px - self.mid_hip_px[:, None]) * self.metres_per_pixel[:, None, None]


def place_track(
    keypoints_px: Array,
    weights: Array,
    reference: ScaleReference,
    *,
    window: int = 31,
    metres_per_pixel: float | None = None,
) -> Placement:
    """Return the initial scale and place of a track, from bone lengths and mean joint positions.

    The image of a bone is never longer than the bone, and some bones of a frame show nearly their full length.  So the
    upper quartile over bones of image length over reference length, divided by the same in the database, gives pixels
    per metre.  The running median over the track removes noise and follows people who come nearer.

    Args:
        keypoints_px: Keypoints (frame, 14, 2), pixels, x right, y up; NaN where not seen.
        weights: Weights (frame, 14); 0 where not seen.
        reference: Statistics of the database.
        window: Frames of the running median.
        metres_per_pixel: The scale, if known; then only the place is estimated.

    Returns:
        The placement; frames with fewer than three bones get the scale of nearby frames.

    Raises:
        InputError: No frame of the track shows three bones.
    """
    pixels_per_metre = _upper_ratio(keypoints_px, weights) / reference.typical_ratio
    if not np.isfinite(pixels_per_metre).any():
        raise InputError("no frame of the track shows three bones of a person; its size is not determined")
    scale = 1.0 / running_median(pixels_per_metre, window)
    if metres_per_pixel is not None:
        scale = np.full(len(scale), metres_per_pixel)
    joint_weight = np.where(weights > 0, weights, 0.0) / reference.variance_m2
    has_any = joint_weight.sum(axis=1) > 0
    joint_weight[~has_any] = 1.0
    off_mean = np.nan_to_num(keypoints_px) - reference.mean_m / scale[:, None, None]
    place = np.einsum("fj,fjd->fd", joint_weight, off_mean) / joint_weight.sum(axis=1)[:, None]
    left, right = OP14.index("left_hip"), OP14.index("right_hip")
    both_hips = (weights[:, left] > 0) & (weights[:, right] > 0)
    place = np.where(both_hips[:, None], 0.5 * (keypoints_px[:, left] + keypoints_px[:, right]), place)
    place[~has_any] = np.nan
    return Placement(_soften(scale, window), _smooth_path(place, window))


def refine_placement(
    keypoints_px: Array,
    weights: Array,
    matched_m: Array,
    *,
    window: int = 31,
    previous: Placement,
    metres_per_pixel: float | None = None,
) -> Placement:
    """Return refined scale and place, from the projections (frame, 14, 2) that were matched with the previous ones.

    The scale of a frame is that of least squares about the weighted means of query and match; its running median is
    taken over the track.  The place then aligns the seen joints with the matched ones.  A frame with fewer than three
    matched joints gets the scale of nearby frames.
    """
    weight = np.where(weights > 0, weights, 0.0) * np.isfinite(matched_m).all(axis=-1)
    is_usable = (weight > 0).sum(axis=1) >= _MIN_BONES
    fits = [match_scale(*frame) for frame in zip(keypoints_px, weight, matched_m, strict=True)]
    ratio, mean_px, mean_m = np.split(np.array(fits), [1, 3], axis=1)
    ratio = ratio[:, 0]
    ratio[~np.isfinite(ratio) | (ratio <= 0)] = np.nan
    scale = running_median(ratio, window) if np.isfinite(ratio).any() else previous.metres_per_pixel
    scale = _soften(scale, window) if metres_per_pixel is None else np.full(len(scale), metres_per_pixel)
    place = np.where(is_usable[:, None], mean_px - mean_m / scale[:, None], previous.mid_hip_px)
    return Placement(scale, _smooth_path(place, window))


@compiled()
def match_scale(points: Array, weight: Array, match: Array) -> Array:
    """Return the scale of a frame by its match, and the weighted means of both images.

    Args:
        points: Joints (14, 2), pixels, y up.
        weight: Weights (14,); 0 where not seen.
        match: Image of the match (14, 2), metres.

    Returns:
        Metres per pixel, mean of the points, mean of the match (5,); the scale is NaN for fewer than three joints, or
        joints in one place.
    """
    out = np.zeros(5)
    total, count = 0.0, 0
    for joint in range(points.shape[0]):
        if weight[joint] > 0:
            total += weight[joint]
            count += 1
    for joint in range(points.shape[0]):
        if weight[joint] > 0:
            for axis in range(2):
                out[1 + axis] += weight[joint] / total * points[joint, axis]
                out[3 + axis] += weight[joint] / total * match[joint, axis]
    spread_px, spread_m = 0.0, 0.0
    for joint in range(points.shape[0]):
        if weight[joint] > 0:
            for axis in range(2):
                spread_px += weight[joint] * (points[joint, axis] - out[1 + axis]) ** 2
                spread_m += weight[joint] * (match[joint, axis] - out[3 + axis]) ** 2
    is_known = count >= _MIN_BONES and spread_px > 0 and spread_m > 0
    out[0] = np.sqrt(spread_m / spread_px) if is_known else np.nan
    return out


def _soften(scale: Array, window: int) -> Array:
    """Smooth the steps of a running median (frame,) by a mean over half its window; ends repeat."""
    length = max(1, min(window // 2, len(scale)) | 1)
    padded = np.pad(scale, length // 2, mode="edge")
    return np.convolve(padded, np.full(length, 1.0 / length), mode="valid")


def _smooth_path(place: Array, window: int) -> Array:
    """Smooth the path of a mid-hip (frame, 2) over a fifth of the window; NaN stays NaN.

    Where hips are hidden, the place is estimated separately in every frame, and its jumps would be taken for motion.
    """
    is_known = np.asarray(np.isfinite(place).all(axis=-1))
    frames = np.arange(len(place))
    length = min(max(5, window // 5) | 1, len(place) - (len(place) + 1) % 2)
    if not is_known.any() or length < _PATH_ORDER + 2:
        return place
    path = interpolate(frames, frames[is_known], place[is_known])
    from scipy.signal import savgol_filter  # here: 0.3 s that planning does not need

    smooth = savgol_filter(path, length, _PATH_ORDER, axis=0, mode="interp")
    return np.where(is_known[:, None], smooth, np.nan)


def running_median(values: Array, window: int) -> Array:
    """Return the median of the finite values (frame,) within half a window of each frame, else the nearest value.

    Raises:
        InputError: No value is finite.
    """
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) == 0:
        raise InputError("no finite value to take a median of")
    half = window // 2
    result = np.empty(len(values))
    first = np.searchsorted(finite, np.arange(len(values)) - half, side="left")
    last = np.searchsorted(finite, np.arange(len(values)) + half, side="right")
    for frame in range(len(values)):
        near = finite[first[frame] : last[frame]]
        if len(near) == 0:
            near = finite[[np.argmin(np.abs(finite - frame))]]
        result[frame] = np.median(values[near])
    return result


def _upper_ratio(points: Array, weights: Array) -> Array:
    """Return upper quartile over seen bones of image length over reference length (frame,); NaN below three bones."""
    length = np.linalg.norm(points[..., _CHILD, :] - points[..., _PARENT, :], axis=-1)
    is_seen = (weights[..., _CHILD] > 0) & (weights[..., _PARENT] > 0) & np.isfinite(length)
    ratio = np.sort(np.where(is_seen, length / REFERENCE_LENGTHS_M[_CHILD], np.inf), axis=-1)
    count = is_seen.sum(axis=-1)
    # Linear between order statistics, as in np.nanquantile, which takes 100 times as long for short rows.
    at = _QUANTILE * np.maximum(count - 1, 0)
    below = np.floor(at).astype(int)
    above = np.minimum(below + 1, np.maximum(count - 1, 0))
    low, high = (np.take_along_axis(ratio, index[..., None], axis=-1)[..., 0] for index in (below, above))
    enough = count >= _MIN_BONES
    with np.errstate(invalid="ignore"):
        upper = low + (at - below) * (high - low)
    return np.where(enough & (upper > 0), upper, np.nan)
