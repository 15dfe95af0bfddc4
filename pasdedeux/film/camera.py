"""The motion of a hand-held camera, found from the background while the images of a shot pass by.

Corners outside the people are followed from a reference image by pyramidal Lucas-Kanade flow, and a similarity is
fitted to them by RANSAC.  Every image is compared with the reference itself, so that errors do not add up; where too
few of its corners are left, the image before becomes the next reference.  A camera that also changes its place is not
supported: near and far things then move differently, and few corners fit one similarity.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.tracking import Image
from pasdedeux.formats.camera_motion import CameraMotion

_LARGEST_PX = 640
"""Longer side of the images in which corners are followed."""
_NUM_CORNERS, _MIN_CORNERS = 300, 12
_WINDOW_PX, _NUM_LEVELS = 15, 3
_MAX_MISFIT_PX = 1.0
"""Distance within which a corner fits a similarity."""
_MIN_FITTING, _MIN_KEPT = 0.3, 0.25
"""Share of the followed corners that fit a similarity that is believed; share of a reference's corners that fit the
image, below which another reference is taken."""
_PADDING = 0.15
"""People are so much larger than the box of their keypoints, on each side, a share of its longer side."""
_STILL_SHARE = 0.004
"""A camera that moves the image by less, a share of its diagonal, is still: tracking errs as much."""
_MAX_LOST = 0.1
"""Share of the images without a similarity up to which the motion is known."""

_IDENTITY = np.eye(2, 3)

LOST = "the camera's motion is not known: too little of the background is seen, or the camera changes its place"


class CameraFollower:
    """Finds the motion of the camera while the grey images of a shot pass by; two of them are kept.

    Args:
        boxes_px: Low and high corners of the people (frame, person, 2, 2) in pixels of these images, NaN for nobody.
    """

    def __init__(self, boxes_px: Array) -> None:
        self._boxes_px = boxes_px
        self._matrices: list[Array] = []
        self._num_lost = 0
        self._scale = 1.0
        self._small_px = (1, 1)
        self._last: Any = None
        self._reference: Any = None

    def add(self, grey: Image) -> None:
        """Take the next image."""
        import cv2  # here: a quarter of a second that others need not wait for

        self._scale = min(1.0, _LARGEST_PX / max(grey.shape))
        if self._scale < 1.0:
            grey = np.asarray(cv2.resize(grey, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA))
        self._small_px = (grey.shape[1], grey.shape[0])
        is_free = self._outside_people(grey.shape[:2])
        matrix = _IDENTITY if self._last is None else self._follow(grey, is_free)
        if matrix is None and self._reference is not None:
            self._refer(*self._last)
            matrix = self._follow(grey, is_free)
        if matrix is None:
            self._num_lost += 1
            matrix, self._reference = self._matrices[-1], None
        self._matrices.append(matrix)
        self._last = (grey, is_free, matrix)
        if self._reference is None:
            self._refer(*self._last)

    def motion(self, first_frame: int) -> tuple[CameraMotion | None, bool]:
        """Return the motion in pixels of the images that were added, and whether too many gave none.

        There is no motion where the camera is still, or where it is not known.
        """
        matrices = np.array(self._matrices).reshape(-1, 2, 3)
        size = np.array(self._small_px, dtype=np.float64)
        if self._num_lost > _MAX_LOST * len(matrices):
            return None, True
        middle = 0.5 * size
        turn = matrices[:, 0, 0] + 1j * matrices[:, 1, 0]
        away = (matrices[:, :, :2] @ middle + matrices[:, :, 2]) - middle
        typical = np.exp(np.median(np.log(np.abs(turn))) + 1j * np.median(np.unwrap(np.angle(turn))))
        linear = np.array([[typical.real, -typical.imag], [typical.imag, typical.real]])
        back = np.linalg.inv(linear)
        offset = middle - back @ (middle + np.median(away, axis=0))
        matrices = np.concatenate([back @ matrices[:, :, :2], back @ matrices[:, :, 2:] + offset[:, None]], axis=-1)
        motion = CameraMotion(first_frame, matrices, self._small_px)
        corners = np.array([(0.0, 0.0), (size[0], 0.0), (0.0, size[1]), tuple(size)])
        moved = motion.steady_px(motion.frames, np.broadcast_to(corners, (len(matrices), 4, 2))) - corners
        is_still = np.linalg.norm(moved, axis=-1).mean(axis=1).max() < _STILL_SHARE * np.linalg.norm(size)
        return (None if is_still else motion.resized(1.0 / self._scale)), False

    def _outside_people(self, shape: tuple[int, ...]) -> Image:
        mask = np.full(shape, 255, dtype=np.uint8)
        for low, high in self._scale * self._boxes_px[len(self._matrices)]:
            if np.isfinite(low).all():
                pad = _PADDING * float((high - low).max()) + 2.0
                x0, y0 = np.clip(low - pad, 0, shape[::-1]).astype(int)
                x1, y1 = np.clip(high + pad, 0, shape[::-1]).astype(int)
                mask[y0:y1, x0:x1] = 0
        return mask

    def _refer(self, grey: Image, is_free: Image, matrix: Array) -> None:
        """Make an image the reference."""
        import cv2

        strong = cv2.goodFeaturesToTrack(grey, _NUM_CORNERS, 0.003, 5.0, mask=is_free)
        corners = np.zeros((0, 2), np.float32) if strong is None else strong.reshape(-1, 2)
        self._reference = (grey, corners, matrix, corners.copy()) if len(corners) >= _MIN_CORNERS else None

    def _follow(self, grey: Image, is_free: Image) -> Array | None:
        """Return the similarity that takes the image to the first one; None where it cannot be told."""
        import cv2

        if self._reference is None:
            return None
        image, corners, matrix, places = self._reference
        moved, was_found, _ = cv2.calcOpticalFlowPyrLK(
            image,
            grey,
            corners[:, None],
            places[:, None].copy(),
            winSize=(_WINDOW_PX, _WINDOW_PX),
            maxLevel=_NUM_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        moved = moved.reshape(-1, 2)
        height, width = grey.shape
        is_inside = (moved >= 0).all(axis=1) & (moved[:, 0] < width - 0.5) & (moved[:, 1] < height - 0.5)
        at = np.where(is_inside[:, None], moved, 0.0).round().astype(int).clip(0, [width - 1, height - 1])
        chosen = np.flatnonzero((was_found.reshape(-1) > 0) & is_inside & (is_free[at[:, 1], at[:, 0]] > 0))
        if len(chosen) < _MIN_CORNERS:
            return None
        similarity, fits = cv2.estimateAffinePartial2D(
            moved[chosen], corners[chosen], method=cv2.RANSAC, ransacReprojThreshold=_MAX_MISFIT_PX
        )
        num_fitting = 0 if fits is None else int(np.count_nonzero(fits))
        enough = max(_MIN_CORNERS, _MIN_FITTING * len(chosen), _MIN_KEPT * len(corners))
        if similarity is None or num_fitting < enough:
            return None
        # Corners that people hide, or that were lost, are looked for where the image now has them.
        back = cv2.invertAffineTransform(similarity)
        places = corners @ back[:, :2].T.astype(np.float32) + back[:, 2].astype(np.float32)
        self._reference = (image, corners, matrix, places)
        both = matrix[:, :2] @ similarity
        both[:, 2] += matrix[:, 2]
        return np.asarray(both)
