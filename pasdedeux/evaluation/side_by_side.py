"""A reconstruction beside what it was made from, as a short clip: the image, then 3D from front and side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.overlay import overlay_clip
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14

__all__ = ["side_by_side_clip"]

Array = npt.NDArray[np.float64]

_PANEL_PX = 240
_PERSON_SHARE = 0.8
"""Part of a panel's height that the person takes."""


def side_by_side_clip(
    keypoints_px: Array, found_m: Array, *, rate_hz: float, truth_m: Array | None = None, most_frames: int = 60
) -> bytes:
    """Draw a track as given (left), what was found as the camera sees it (middle) and from its side (right).

    The middle of the person stays in the middle of each panel.  Given and true figures have the first person's colour,
    found ones the second's.

    Args:
        keypoints_px: The track (frame, 14, 2), pixels, y down; NaN where not seen.
        found_m: The reconstruction (frame, 14, 3), camera axes, metres.
        rate_hz: Frames per second.
        truth_m: The true motion (frame, 14, 3), camera axes, drawn behind where it is known.
        most_frames: Longer tracks are cut.

    Returns:
        An animated WebP.
    """
    keypoints, found = keypoints_px[:most_frames], found_m[:most_frames]
    size_m = float(np.median(np.ptp(found[..., 1], axis=1)))
    per_metre = _PERSON_SHARE * _PANEL_PX / size_m
    is_whole = np.isfinite(keypoints).all(axis=(1, 2))
    tall = keypoints[is_whole, :, 1] if is_whole.any() else keypoints[..., 1].reshape(1, -1)
    heights = np.nanmax(tall, axis=1) - np.nanmin(tall, axis=1)
    given = (keypoints - _middle_of(keypoints)) * (_PERSON_SHARE * _PANEL_PX / max(float(np.median(heights)), 1.0))
    # Hips are not half way up: what stands about them would run out of the panel.
    centred = _image(found, (0, 1))[..., 1]
    down = [0.0, -0.5 * per_metre * float(np.median(centred.max(axis=1) + centred.min(axis=1)))]
    figures = [_panel(given, 0), _panel(_image(found, (0, 1)) * per_metre + down, 1)]
    side = _panel(_image(found, (2, 1)) * [-1.0, 1.0] * per_metre + down, 2)
    if truth_m is None:
        figures += [np.full(side.shape, np.nan), side]
    else:
        truth = truth_m[:most_frames]
        figures += [_panel(_image(truth, (2, 1)) * [-1.0, 1.0] * per_metre + down, 2), side]
        figures += [_panel(_image(truth, (0, 1)) * per_metre + down, 1)]
    return overlay_clip(OP14, np.stack(figures, axis=1), image_size_px=(3 * _PANEL_PX, _PANEL_PX), rate_hz=rate_hz)


def _middle_of(seen: Array) -> Array:
    """Give the middle of the seen joints (frame, 1, 2); frames that show nobody have the frame's before."""
    middle = np.zeros((len(seen), 1, 2))
    for frame, points in enumerate(seen):
        known = points[np.isfinite(points).all(axis=-1)]
        middle[frame, 0] = 0.5 * (known.min(axis=0) + known.max(axis=0)) if len(known) else middle[max(frame - 1, 0), 0]
    return middle


def _image(positions_m: Array, axes: tuple[int, int]) -> Array:
    """Give positions about the mid-hip on two axes, y down."""
    centred = positions_m - mid_hip(positions_m)[:, None]
    return np.asarray(centred[..., list(axes)] * [1.0, -1.0])


def _panel(points: Array, number: int) -> Array:
    return np.asarray(points + np.array([number + 0.5, 0.5]) * _PANEL_PX)
