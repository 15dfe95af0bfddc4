"""How a camera that turns and zooms moves its image, and points and images without that motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers


@dataclass(frozen=True)
class CameraMotion:
    """The motion of a camera over the frames of a sequence: a similarity for each frame.

    Pan and tilt move the image, roll turns it, and zoom scales it.  The steady image is that of a camera that keeps
    its typical direction and zoom.

    Args:
        first_frame: Frame of the sequence that the first similarity is of.
        steady_from_image: Matrices (frame, 2, 3) that take pixels of a frame to those of the steady image.
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
        """Return the matrices (n, 2, 3) of some frames; frames outside get that of the nearest frame."""
        return np.asarray(self.steady_from_image[np.clip(frames - self.first_frame, 0, len(self.frames) - 1)])

    def steady_px(self, frames: Integers, points_px: Array) -> Array:
        """Return pixels (frame, *batch, 2) of these frames (frame,) in the steady image; NaN stays NaN."""
        return _moved(self.at(frames), points_px)

    def image_px(self, frames: Integers, steady_px: Array) -> Array:
        """Return where points (frame, *batch, 2) of the steady image are in the images of these frames (frame,)."""
        matrices = self.at(frames)
        turn = np.linalg.inv(matrices[:, :, :2])
        back = np.concatenate([turn, -turn @ matrices[:, :, 2:]], axis=-1)
        return _moved(back, steady_px)

    def at_times(self, numbers: Integers, places: Array) -> CameraMotion:
        """Return the motion at other moments: for each of these successive frames a place (frame,) among its own."""
        flat = self.steady_from_image.reshape(len(self.frames), -1)
        matrices = np.stack([np.interp(places, self.frames, entry) for entry in flat.T], axis=-1)
        return CameraMotion(int(numbers[0]), matrices.reshape(-1, 2, 3), self.image_size_px)

    def resized(self, scale: float) -> CameraMotion:
        """Return the same motion for images scaled by a factor."""
        # Pixel centres: the middle of a pixel of the smaller image is the middle of those it stands for.
        shift = 0.5 * (scale - 1.0)
        linear = self.steady_from_image[:, :, :2]
        offset = scale * self.steady_from_image[:, :, 2] + shift - linear @ np.full(2, shift)
        width, height = (round(scale * side) for side in self.image_size_px)
        return CameraMotion(self.first_frame, np.concatenate([linear, offset[..., None]], axis=-1), (width, height))

    @property
    def displacement_px(self) -> Array:
        """Displacement of the image centre from that of the steady image (frame, 2), pixels."""
        middle = 0.5 * np.array(self.image_size_px, dtype=np.float64)
        return np.asarray(self.steady_px(self.frames, np.broadcast_to(middle, (len(self.frames), 2))) - middle)

    @property
    def roll_rad(self) -> Array:
        """How far the steady image is turned against each image (frame,), clockwise."""
        return np.asarray(np.arctan2(self.steady_from_image[:, 1, 0], self.steady_from_image[:, 0, 0]))

    @property
    def zoom(self) -> Array:
        """Magnification of each image beside the steady one (frame,)."""
        return np.asarray(1.0 / np.linalg.norm(self.steady_from_image[:, :, 0], axis=-1))

    def in_words(self, *, is_subtracted: bool = True) -> str:
        """Say how the camera moves, and whether that is subtracted."""
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


def _moved(matrices: Array, points_px: Array) -> Array:
    flat = np.asarray(points_px, dtype=np.float64).reshape(len(points_px), -1, 2)
    moved = flat @ matrices[:, :, :2].swapaxes(1, 2) + matrices[:, None, :, 2]
    return np.asarray(moved.reshape(np.shape(points_px)))
