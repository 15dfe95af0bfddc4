"""The motion of a hand-held camera, estimated from the background while the images of a shot are read.

Corners outside the people are followed from a reference image by pyramidal Lucas-Kanade flow.  RANSAC selects those
that fit one homography, and rotation and zoom of the camera are fitted to them.  Every image is compared with the
reference, so that errors do not accumulate; if too few of its corners are left, the previous image becomes the
reference.  A camera that changes its position is not supported: near and far things move differently, and few corners
fit one homography.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.tracking import Image
from pasdedeux.formats.poses2d.camera_motion import FOCAL_OVER_WIDTH, CameraMotion, apply, inverse
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec

_LARGEST_PX = 640
"""Longer side of the images in which corners are followed."""
_NUM_CORNERS, _MIN_CORNERS = 300, 12
_MIN_STRENGTH, _BLOCK_PX = 3e-4, 3
"""Minimum strength of corners, the smaller eigenvalue of their gradients: 2 grey levels a pixel.  On a plain backdrop
there are only corners of compression and shadows, which move with the people: 3e-5."""
_WINDOW_PX, _NUM_LEVELS = 15, 3
_MAX_MISFIT_PX = 1.0
"""Distance within which a corner fits a homography."""
_MIN_FITTING, _MIN_KEPT = 0.3, 0.25
"""Minimum shares of corners that fit a homography: of the followed ones, and of all in the reference, below which
another reference is taken."""
_PADDING = 0.15
"""Margin of people around the box of their keypoints, on each side, a share of its longer side."""
_STILL_SHARE = 0.004
"""Motion of the image below which a camera is still, a share of its diagonal: the error of tracking."""
_MAX_LOST = 0.1
"""Maximum share of images without a homography for the motion to be known."""

LOST = "the camera's motion is not known: too little of the background is seen, or the camera changes its place"


class CameraFollower:
    """Estimates the motion of the camera while the grey images of a shot are added; two of them are kept.

    Args:
        boxes_px: Low and high corners of the people (frame, person, 2, 2) in pixels of these images, NaN for nobody.
        focal_px: Focal length in pixels of these images; None for that of a common camera.
    """

    def __init__(self, boxes_px: Array, focal_px: float | None = None) -> None:
        self._boxes_px, self._focal_px = boxes_px, focal_px
        self._turns: list[Array] = []
        self._num_lost = 0
        self._scale = 1.0
        self._small_px = (1, 1)
        self._last: Any = None
        self._reference: Any = None

    def add(self, grey: Image) -> None:
        """Add the next image."""
        import cv2  # here: a quarter of a second that others need not wait for

        self._scale = min(1.0, _LARGEST_PX / max(grey.shape))
        if self._scale < 1.0:
            grey = np.asarray(cv2.resize(grey, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA))
        self._small_px = (grey.shape[1], grey.shape[0])
        is_free = self._outside_people(grey.shape[:2])
        turn = np.zeros(4) if self._last is None else self._follow(grey, is_free)
        if turn is None and self._reference is not None:
            self._refer(*self._last)
            turn = self._follow(grey, is_free)
        if turn is None:
            self._num_lost += 1
            turn, self._reference = self._turns[-1], None
        self._turns.append(turn)
        self._last = (grey, is_free, turn)
        if self._reference is None:
            self._refer(*self._last)

    def motion(self, first_frame: int) -> tuple[CameraMotion | None, bool]:
        """Return the motion in pixels of the added images, and whether it is unknown.

        The motion is None if the camera is still, or if it is unknown.
        """
        turns = np.array(self._turns).reshape(-1, 4)
        size = np.array(self._small_px, dtype=np.float64)
        if self._num_lost > _MAX_LOST * len(turns):
            return None, True
        steady = inverse(self._homography(np.median(turns, axis=0))) if len(turns) else np.eye(3)
        matrices = np.array([steady @ self._homography(turn) for turn in turns]).reshape(-1, 3, 3)
        motion = CameraMotion(first_frame, matrices / matrices[:, 2:, 2:], self._small_px)
        corners = np.array([(0.0, 0.0), (size[0], 0.0), (0.0, size[1]), tuple(size)])
        moved = motion.steady_px(motion.frames, np.broadcast_to(corners, (len(matrices), 4, 2))) - corners
        is_still = np.linalg.norm(moved, axis=-1).mean(axis=1).max(initial=0.0) < _STILL_SHARE * np.linalg.norm(size)
        return (None if is_still else motion.resized(1.0 / self._scale)), False

    def _outside_people(self, shape: tuple[int, ...]) -> Image:
        mask = np.full(shape, 255, dtype=np.uint8)
        for low, high in self._scale * self._boxes_px[len(self._turns)]:
            if np.isfinite(low).all():
                pad = _PADDING * float((high - low).max()) + 2.0
                x0, y0 = np.clip(low - pad, 0, shape[::-1]).astype(int)
                x1, y1 = np.clip(high + pad, 0, shape[::-1]).astype(int)
                mask[y0:y1, x0:x1] = 0
        return mask

    def _refer(self, grey: Image, is_free: Image, turn: Array) -> None:
        """Make an image the reference."""
        import cv2

        is_strong = cv2.cornerMinEigenVal(grey, _BLOCK_PX) >= _MIN_STRENGTH
        strong = cv2.goodFeaturesToTrack(grey, _NUM_CORNERS, 0.003, 5.0, mask=is_free * is_strong, blockSize=_BLOCK_PX)
        corners = np.zeros((0, 2), np.float32) if strong is None else strong.reshape(-1, 2)
        self._reference = (grey, corners, turn, corners.copy()) if len(corners) >= _MIN_CORNERS else None

    def _follow(self, grey: Image, is_free: Image) -> Array | None:
        """Return the turn (4,) of the camera since the first image, see `_homography`; None if it is unknown."""
        import cv2
        from scipy.optimize import least_squares

        if self._reference is None:
            return None
        image, corners, turn, places = self._reference
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
        homography, fits = cv2.findHomography(moved[chosen], corners[chosen], cv2.RANSAC, _MAX_MISFIT_PX)
        fitting = chosen[:0] if fits is None else chosen[fits.reshape(-1) > 0]
        enough = max(_MIN_CORNERS, _MIN_FITTING * len(chosen), _MIN_KEPT * len(corners))
        if homography is None or len(fitting) < enough:
            return None
        seen, wanted = moved[fitting].astype(np.float64), apply(self._homography(turn), corners.astype(np.float64))

        def misfit_px(tried: Array) -> Array:
            return (apply(self._homography(tried), seen) - wanted[fitting]).ravel()

        new_turn = np.asarray(least_squares(misfit_px, self._turns[-1], method="lm").x, dtype=np.float64)
        # Corners that were hidden or lost are searched next at their predicted places in this image.
        places = apply(inverse(self._homography(new_turn)), wanted).astype(np.float32)
        self._reference = (image, corners, turn, places)
        return new_turn

    def _homography(self, turn: Array) -> Array:
        """Return the matrix (3, 3) that maps pixels of an image to those of the first one.

        Args:
            turn: Rotation vector of the camera since the first image (x right, y down), and log of its zoom (4,).
        """
        width, height = self._small_px
        focal_px = self._focal_px * self._scale if self._focal_px else FOCAL_OVER_WIDTH * max(width, height)
        lens = np.array([[focal_px, 0.0, 0.5 * width], [0.0, focal_px, 0.5 * height], [0.0, 0.0, 1.0]])
        zoomed = lens * [[np.exp(turn[3]), 1.0, 1.0], [1.0, np.exp(turn[3]), 1.0], [1.0, 1.0, 1.0]]
        turned = rotmat_from_unitquat(unitquat_from_rotvec(turn[:3]))
        return np.asarray(lens @ turned @ np.linalg.inv(zoomed))
