"""Points of film followed from where they are known, forward and backward, by pyramidal Lucas-Kanade flow.

A joint is followed by five points: itself and four round it.  Each step goes back to the image before, and the three
points that come back nearest to where they were move the joint, by their median (forward-backward check).  A track is
lost where they do not come back.  Film is streamed: a block of images is held at a time, whose last image is the first
of the next one.
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
"""People are tracked in images in which they are about so tall; larger ones are made smaller."""
MAX_BLOCK = 48
"""Images held at a time; of a longer gap only so much is tracked backward."""
_WINDOW_PX, _NUM_LEVELS = 17, 3
_AROUND = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)], dtype=np.float64)
_AROUND_SHARE, _NUM_BEST = 0.02, 3
"""Distance of the points round a joint, a share of the person's size; how many of the five move it."""
_MAX_RETURN_SHARE = 0.02
"""A step that comes back farther than this from where it began, a share of the person's size, has lost the point."""


@dataclass(frozen=True)
class Tracks:
    """Where points are that were followed from the known place before, and from the one after.

    Args:
        forward: (frame, point, 2), NaN where lost or where nothing was known before; at the next known place it says
            where the track has come to, which tells how good it is.
        backward: The same, back in time.
    """

    forward: Array
    backward: Array


def track_points(
    images: Iterable[Image], known_px: Array, is_start: Flags, size_px: Array, *, is_checked: bool = False
) -> Tracks:
    """Follow points from where they are known.

    Args:
        images: Grey images, one for each frame, in which people are not taller than some `TRACKED_SIZE_PX`.
        known_px: Known places (frame, point, 2) in these images; NaN where not known.
        is_start: Known places (frame, point) that are seen in the image, so that tracks begin there.
        size_px: Size of the person of each point (point,).
        is_checked: Also from one known place to the next, if they are in successive frames: a detector's may be wrong.
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
                # A known place that ends a track is reached once more.
                is_wanted = is_start[here] & (is_checked | ~is_known[there])
                is_moved = np.where(is_known[here], is_wanted, np.isfinite(place[:, 0]))
                chosen = np.flatnonzero(is_moved)
                if len(chosen):
                    reached[there, chosen] = _step(block[before], block[after], place[chosen], size_px[chosen])
        block.clear()  # or these images would be held until the next block is full
    return Tracks(forward, backward)


def _blocks(images: Iterable[Image], begins: set[int]) -> Iterator[tuple[int, list[Image]]]:
    """Yield blocks of images with the number of their first; they end where one may begin, or are full."""
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
    """Return where points (point, 2) of an image are in another one; NaN where they are lost."""
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
