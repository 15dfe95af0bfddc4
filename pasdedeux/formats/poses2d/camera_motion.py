"""The image motion of a camera that turns and zooms, and its removal from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers

FOCAL_OVER_WIDTH = 0.72
"""Assumed focal length over the longer side of the image: a 26 mm phone lens on 36 mm film."""


@dataclass(frozen=True)
class CameraMotion:
    """The motion of a camera over the frames of a sequence: a homography for each frame.

    Pan, tilt and roll turn the camera, and zoom scales its image.  The steady image is that of a camera that keeps the
    typical direction and zoom.

    Args:
        first_frame: Frame of the sequence for the first homography.
        steady_from_image: Matrices (frame, 3, 3) that map pixels (x, y, 1) of a frame to the steady image, last entry
            1.
        image_size_px: Width and height of the images.
    """

    first_frame: int
    steady_from_image: Array
    image_size_px: tuple[int, int]

    @property
    def frames(self) -> Integers:
        """Frames of the sequence (frame,)."""
        return self.first_frame + np.arange(len(self.steady_from_image))

    def at(self, frames: Integers) -> Array:
        """Return the matrices (n, 3, 3) of some frames; frames outside use the nearest one."""
        return np.asarray(self.steady_from_image[np.clip(frames - self.first_frame, 0, len(self.frames) - 1)])

    def steady_px(self, frames: Integers, points_px: Array) -> Array:
        """Map pixels (frame, *batch, 2) of these frames (frame,) to the steady image; NaN stays NaN."""
        return apply(self.at(frames), points_px)

    def image_px(self, frames: Integers, steady_px: Array) -> Array:
        """Map points (frame, *batch, 2) of the steady image to the images of these frames (frame,)."""
        return apply(inverse(self.at(frames)), steady_px)

    def at_times(self, numbers: Integers, places: Array) -> CameraMotion:
        """Resample the motion: `places` (frame,) are old frame numbers, with fractions, of the new frames `numbers`."""
        flat = self.steady_from_image.reshape(len(self.frames), -1)
        matrices = np.stack([np.interp(places, self.frames, entry) for entry in flat.T], axis=-1)
        return CameraMotion(int(numbers[0]), matrices.reshape(-1, 3, 3), self.image_size_px)

    def resized(self, scale: float) -> CameraMotion:
        """Return the same motion for images scaled by a factor."""
        # Pixel centres: the middle of a pixel of the smaller image is the middle of those it stands for.
        shift = 0.5 * (scale - 1.0)
        grow = np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])
        width, height = (round(scale * side) for side in self.image_size_px)
        matrices = grow @ self.steady_from_image @ np.linalg.inv(grow)
        return CameraMotion(self.first_frame, matrices / matrices[:, 2:, 2:], (width, height))

    @property
    def displacement_px(self) -> Array:
        """Displacement of the image centre from that of the steady image (frame, 2), pixels."""
        return self._middle_px[:, 0] - 0.5 * np.array(self.image_size_px)

    @property
    def roll_rad(self) -> Array:
        """Clockwise rotation of the steady image against each image (frame,), radians."""
        across = self._middle_px[:, 1] - self._middle_px[:, 0]
        return np.asarray(np.arctan2(across[:, 1], across[:, 0]))

    @property
    def zoom(self) -> Array:
        """Magnification of each image relative to the steady one (frame,)."""
        sides = self._middle_px[:, 1:] - self._middle_px[:, :1]
        return np.asarray(1.0 / np.sqrt(np.abs(np.linalg.det(sides))))

    @property
    def _middle_px(self) -> Array:
        """Centre of each image, and the points one pixel right and below, in the steady image (frame, 3, 2)."""
        points = 0.5 * np.array(self.image_size_px) + np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
        return self.steady_px(self.frames, np.broadcast_to(points, (len(self.frames), 3, 2)))

    def in_words(self, *, is_subtracted: bool = True) -> str:
        """Describe the motion of the camera, and whether it is subtracted."""
        across, down = np.ptp(self.displacement_px, axis=0)
        low, high = self.zoom.min(), self.zoom.max()
        return (
            f"the camera moves: {across:.0f} px across, {down:.0f} px down, {np.rad2deg(np.ptp(self.roll_rad)):.1f} "
            f"degrees of roll, zoom {low:.2f} to {high:.2f}; "
            + (
                "this is subtracted"
                if is_subtracted
                else "not subtracted: people stay where the image shows them, as "
                "before a camera that goes round them, which is not supported"
            )
        )


def apply(matrices: Array, points_px: Array) -> Array:
    """Map points (*batch, *others, 2) by homographies (*batch, 3, 3); NaN stays NaN."""
    points = np.asarray(points_px, dtype=np.float64)
    batch = matrices.shape[:-2]
    flat = points.reshape(*batch, -1, 2)
    moved = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) @ matrices.swapaxes(-1, -2)
    return np.asarray((moved[..., :2] / moved[..., 2:]).reshape(points.shape))


def inverse(matrices: Array) -> Array:
    """Return the inverse homographies (*batch, 3, 3)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
