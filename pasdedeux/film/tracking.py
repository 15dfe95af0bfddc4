"""Tracking of points in film from known places, forward and backward, by pyramidal Lucas-Kanade flow.

A joint is followed by five points: itself and four around it.  Every step is checked by tracking back to the image
before: the median displacement of the three points that return nearest to their origin moves the joint
(forward-backward check), and the track is lost if they do not return.  Film is streamed: one block of images is held at
a time, whose last image is the first of the next block.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags

Image = npt.NDArray[np.uint8]

TRACKED_SIZE_PX = 240.0
"""Approximate height of people in the images for tracking; larger images are reduced."""
MAX_BLOCK = 48
"""Number of images held at a time, and so the longest part of a gap that is tracked backward."""
_WINDOW_PX, _NUM_LEVELS = 17, 3
_AROUND = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)], dtype=np.float64)
_AROUND_SHARE, _NUM_BEST = 0.02, 3
"""Distance of the points around a joint, a share of the person's size; number of the five that move it."""
_MAX_RETURN_SHARE = 0.02
"""Maximum forward-backward error of a step, a share of the person's size; beyond it the point is lost."""


@dataclass(frozen=True)
class Tracks:
    """Places of points that were followed from the known place before, and from the one after.

    Args:
        forward: (frame, point, 2), NaN where lost or before the first known place; at the next known frame it has the
            end of the track, which shows its quality.
        backward: The same, back in time.
    """

    forward: Array
    backward: Array


def track_points(
    images: Iterable[Image], known_px: Array, is_start: Flags, size_px: Array, *, is_checked: bool = False
) -> Tracks:
    """Follow points from where they are known.

    Args:
        images: Grey images, one for each frame, in which people have about `TRACKED_SIZE_PX` or less.
        known_px: Known places (frame, point, 2) in these images; NaN where not known.
        is_start: Known places (frame, point) that are visible, so that tracks begin there.
        size_px: Size of the person of each point (point,).
        is_checked: Also track between known places of successive frames, because those of a detector may be wrong.
    """
    forward, backward = np.full((2, *known_px.shape), np.nan)
    is_known = np.asarray(np.isfinite(known_px).all(axis=-1))
    begins = np.flatnonzero(is_known.sum(axis=1) * 2 > is_known.shape[1])  # key frames
    for first, block in _blocks(images, set(begins.tolist())):
        for reached, order in ((forward, 1), (backward, -1)):
            numbers = range(len(block))[::order]
            for before, after in pairwise(numbers):
                here, there = first + before, first + after
                place = np.where(is_known[here, :, None], known_px[here], reached[here])
                # The known place that ends a track is tracked to as well.
                is_wanted = is_start[here] & (is_checked | ~is_known[there])
                is_moved = np.where(is_known[here], is_wanted, np.isfinite(place[:, 0]))
                chosen = np.flatnonzero(is_moved)
                if len(chosen):
                    reached[there, chosen] = _step(block[before], block[after], place[chosen], size_px[chosen])
        block.clear()  # else these images would be held until the next block is full
    return Tracks(forward, backward)


def _blocks(images: Iterable[Image], begins: set[int]) -> Iterator[tuple[int, list[Image]]]:
    """Yield blocks of images with the number of their first; a block ends at a key frame or when it is full."""
    block: list[Image] = []
    first = number = 0
    for number, image in enumerate(images):
        block.append(image)
        if len(block) > 1 and (number in begins or len(block) > MAX_BLOCK):
            yield first, block
            first, block = number, [image]
    if len(block) > 1:
        yield first, block


def _step(before: Image, after: Image, place_px: Array, size_px: Array) -> Array:
    """Return the places of points (point, 2) of an image in another one; NaN for lost points."""
    import cv2  # here: a quarter of a second that others need not wait for

    options: dict[str, Any] = {
        "winSize": (_WINDOW_PX, _WINDOW_PX),
        "maxLevel": _NUM_LEVELS,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03),
    }
    around = place_px[:, None] + _AROUND_SHARE * size_px[:, None, None] * _AROUND
    start = around.reshape(-1, 2).astype(np.float32)
    flow: Any = partial(cv2.calcOpticalFlowPyrLK, **options)
    moved, was_found, _ = flow(before, after, start, None)
    back, was_found_back, _ = flow(after, before, moved, None)
    away = np.where((was_found & was_found_back)[:, 0] > 0, np.linalg.norm(back - start, axis=-1), np.inf)
    away = away.reshape(around.shape[:2])
    best = np.argsort(away, axis=1, kind="stable")[:, :_NUM_BEST]
    displacement = (moved - start).reshape(around.shape).astype(np.float64)
    middle = np.median(np.take_along_axis(displacement, best[..., None], axis=1), axis=1)
    height, width = after.shape
    place = place_px + middle
    is_inside = (place >= 0).all(axis=-1) & (place[:, 0] < width) & (place[:, 1] < height)
    is_back = np.take_along_axis(away, best, axis=1).max(axis=1) <= _MAX_RETURN_SHARE * size_px
    return np.where((is_inside & is_back)[:, None], place, np.nan)
