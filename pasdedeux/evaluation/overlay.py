"""Short clips of 2D skeletons as a camera saw them, drawn with OpenCV, as animated WebP bytes.

WebP because the same frames always give the same bytes and every browser plays it from within a page; OpenCV's own
WebM writer puts a random identifier into each file.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import PinholeCamera
from pasdedeux.evaluation.drawing import PERSON_COLOURS, shaded
from pasdedeux.skeletons import Skeleton

__all__ = ["floor_grid", "overlay_clip"]

_BACKGROUND = (238, 240, 242)
_FLOOR = (205, 210, 214)
_MAX_WIDTH_PX = 480


def overlay_clip(
    skeleton: Skeleton,
    keypoints_px: npt.NDArray[np.float64],
    *,
    image_size_px: tuple[int, int],
    rate_hz: float,
    floor_px: npt.NDArray[np.float64] | None = None,
    labels: Sequence[str] = (),
    colours: Sequence[str] = PERSON_COLOURS,
    titles: Sequence[str] = (),
    max_width_px: int = _MAX_WIDTH_PX,
) -> bytes:
    """Draw 2D skeletons over time and give an animated WebP.

    Args:
        skeleton: Topology of the keypoints.
        keypoints_px: (frame, person, joint, 2) pixels, x right, y down; NaN where missing: its bones are left out.
        image_size_px: Width and height of the image.
        rate_hz: Frames per second.
        floor_px: Line segments (n, 2, 2) of a floor grid, drawn behind.
        labels: A caption for each frame; none when empty.
        colours: Colours of the people, in turn.
        titles: Headings of equal columns of the image.
        max_width_px: Wider images are scaled down.

    Returns:
        The bytes of the clip; a clip of no frames has one empty image.
    """
    width, height = image_size_px
    scale = min(1.0, max_width_px / width)
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    frames = [
        _draw_frame(
            skeleton,
            people * scale,
            size,
            floor_px,
            scale,
            (labels[index],) if index < len(labels) else titles,
            colours,
        )
        for index, people in enumerate(keypoints_px)
    ] or [np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)]
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = [round(1000.0 / rate_hz)] * len(frames)
    animation.loop_count = 0
    is_written, buffer = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 60])
    assert is_written, "OpenCV was built without WebP"
    return bytes(np.asarray(buffer).tobytes())


def floor_grid(camera: PinholeCamera, *, reach_m: float = 4.0, step_m: float = 1.0) -> npt.NDArray[np.float64]:
    """Return the lines of a square grid on the floor under what a camera looks at, in pixels.

    Args:
        camera: The camera.
        reach_m: Half the side of the grid.
        step_m: Distance between its lines.

    Returns:
        Line segments (n, 2, 2); pieces behind the camera are NaN.
    """
    forward = -camera.direction * [1.0, 0.0, 1.0]
    ahead = np.linalg.norm(camera.position_m * [1.0, 0.0, 1.0])
    centre = np.round((camera.position_m + forward * ahead) * [1.0, 0.0, 1.0])
    ticks = np.arange(-reach_m, reach_m + step_m / 2, step_m)
    starts, stops = np.meshgrid(ticks, ticks[:-1], indexing="ij")
    along = np.stack([np.stack([starts, stops], -1), np.stack([starts, stops + step_m], -1)], axis=-2).reshape(-1, 2, 2)
    lines = np.concatenate([along, along[..., ::-1]])
    world = centre + np.stack([lines[..., 0], np.zeros(lines.shape[:-1]), lines[..., 1]], axis=-1)
    return camera.project(world).px


def _draw_frame(
    skeleton: Skeleton,
    people_px: npt.NDArray[np.float64],
    size: tuple[int, int],
    floor_px: npt.NDArray[np.float64] | None,
    scale: float,
    titles: Sequence[str],
    colours: Sequence[str],
) -> npt.NDArray[np.uint8]:
    image = np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)
    if floor_px is not None:
        for segment in floor_px * scale:
            _line(image, segment[0], segment[1], _FLOOR, 1)
    for person, points in enumerate(people_px):
        colour = colours[person % len(colours)]
        for parent, child in skeleton.bones:
            _line(image, points[parent], points[child], _bgr(shaded(colour, skeleton.joint_names[child])), 2)
        for point in points[np.isfinite(points).all(axis=-1)]:
            cv2.circle(image, _fixed(point), 2 << _SHIFT, _bgr(shaded(colour)), -1, cv2.LINE_AA, _SHIFT)
    for column, title in enumerate(titles):
        at = (8 + column * size[0] // len(titles), 18)
        cv2.putText(image, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (90, 90, 90), 1, cv2.LINE_AA)
    return image


_SHIFT = 3
"""Bits of sub-pixel precision in OpenCV's drawing calls."""
_FAR_PX = 1e4


def _fixed(point: npt.NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.clip(point, -_FAR_PX, _FAR_PX) * (1 << _SHIFT)
    return round(float(x)), round(float(y))


def _line(
    image: npt.NDArray[np.uint8],
    start: npt.NDArray[np.float64],
    end: npt.NDArray[np.float64],
    colour: tuple[float, ...],
    thickness: int,
) -> None:
    if np.isfinite(start).all() and np.isfinite(end).all():
        cv2.line(image, _fixed(start), _fixed(end), colour, thickness, cv2.LINE_AA, _SHIFT)


def _bgr(rgb: tuple[float, float, float]) -> tuple[float, ...]:
    return tuple(255.0 * part for part in reversed(rgb))
