"""Drawings of people over images of film, with blurred faces; sheets and short clips of them."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.tracking import Image
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, get_keypoint_layout
from pasdedeux.people.identity import body_size_px
from pasdedeux.skeletons import OP14

_COLOURS = ((60, 60, 230), (230, 140, 40), (60, 190, 60), (200, 60, 200), (40, 200, 220))
"""Colours of people in turn, BGR."""
_FACE_SHARE = 0.085
"""Half the height of a face with hair, a share of the body height; the blurred radius is 1.5 times that."""
_CELL_PX = 320


def draw_people(image: Image, frames: AnnotatedFrames, number: int, *, has_faces: bool = False) -> Image:
    """Return an image with the people of its frame drawn: tracked and known joints filled, others as rings.

    Args:
        image: BGR.
        frames: Annotations of the film.
        number: The frame.
        has_faces: Show faces instead of blurring them.
    """
    import cv2  # here: a quarter of a second that others need not wait for

    drawn = image.copy() if has_faces else blur_faces(image, frames, number)
    rows = np.flatnonzero(frames.frame == number)
    op14 = get_keypoint_layout(frames.layout).derive(OP14.name, frames.keypoints_px[rows], frames.confidence[rows])
    thick = max(1, round(image.shape[0] / 300))
    status = frames.status if frames.status is not None else np.full(frames.confidence.shape, KeypointStatus.DETECTED)
    for row, points in zip(rows.tolist(), op14.positions, strict=True):
        colour = _COLOURS[int(frames.person_id[row]) % len(_COLOURS)]
        for parent, child in OP14.bones:
            if np.isfinite(points[[parent, child]]).all():
                cv2.line(drawn, _pixel(points[parent]), _pixel(points[child]), colour, thick, cv2.LINE_AA)
        for point, kind in zip(frames.keypoints_px[row], status[row], strict=True):
            if np.isfinite(point).all():
                filled = -1 if kind >= KeypointStatus.TRACKED else 1
                cv2.circle(drawn, _pixel(point), 2 * thick, colour, filled, cv2.LINE_AA)
    return drawn


def blur_faces(image: Image, frames: AnnotatedFrames, number: int) -> Image:
    """Return an image with the faces of the people of its frame blurred."""
    blurred = image.copy()
    rows = np.flatnonzero(frames.frame == number)
    op14 = get_keypoint_layout(frames.layout).derive(OP14.name, frames.keypoints_px[rows], frames.confidence[rows])
    for points, height in zip(op14.positions, body_size_px(op14.positions, op14.confidence), strict=True):
        _blur_face(blurred, points, float(height))
    return blurred


def contact_sheet(images: Sequence[Image], titles: Sequence[str], *, num_columns: int = 4) -> Image:
    """Return images side by side, each with its title."""
    import cv2  # here: a quarter of a second that others need not wait for

    height, width = images[0].shape[:2]
    cell = (_CELL_PX, max(1, round(_CELL_PX * height / width)))
    columns = min(num_columns, len(images))
    rows = math.ceil(len(images) / columns)
    sheet = np.full((rows * cell[1], columns * cell[0], 3), 255, dtype=np.uint8)
    for index, (image, title) in enumerate(zip(images, titles, strict=True)):
        small = cv2.resize(image, cell, interpolation=cv2.INTER_AREA)
        for right, down, level in ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 255)):  # white on its shadow
            at, colour = (6 + right, 16 + down), (level, level, level)
            cv2.putText(small, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
        y, x = (index // columns) * cell[1], (index % columns) * cell[0]
        sheet[y : y + cell[1], x : x + cell[0]] = small
    return sheet


def moving_svg(images: Sequence[Image], rate_hz: float) -> bytes:
    """Return images of one size as an SVG that shows them in a loop; a single image is static."""
    import cv2  # here: a quarter of a second that others need not wait for

    height, width = images[0].shape[:2]
    size = f'width="{width}" height="{height}"'
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {size}>']
    for index, image in enumerate(images):
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])
        source = f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
        parts.append(f'<image {size} href="{source}">')
        if len(images) > 1:
            share, step = len(images), 1.0 / len(images)
            times = ";".join(f"{at:.5f}" for at in (0.0, index * step, (index + 1) * step, 1.0))
            parts.append(
                f'<animate attributeName="visibility" calcMode="discrete" values="hidden;visible;hidden;hidden" '
                f'keyTimes="{times}" dur="{share / rate_hz:.3f}s" repeatCount="indefinite"/>'
            )
        parts.append("</image>")
    return "".join([*parts, "</svg>"]).encode()


def _blur_face(image: Image, op14_px: Array, height_px: float) -> None:
    """Blur the face of a person in place: around the head, or above the neck if the head is not seen."""
    import cv2  # here: a quarter of a second that others need not wait for

    head, neck = op14_px[OP14.index("head")], op14_px[OP14.index("neck")]
    if not np.isfinite(height_px) or not (np.isfinite(head).all() or np.isfinite(neck).all()):
        return
    centre = head if np.isfinite(head).all() else neck - [0.0, 1.2 * _FACE_SHARE * height_px]
    radius = max(3, round(1.5 * _FACE_SHARE * height_px))
    x, y = _pixel(centre)
    left, top = max(x - radius, 0), max(y - radius, 0)
    part = image[top : max(y + radius + 1, 0), left : max(x + radius + 1, 0)]
    if part.size == 0:
        return
    coarse = cv2.resize(part, (4, 4), interpolation=cv2.INTER_AREA)
    blurred = cv2.resize(coarse, part.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    mask = np.zeros(part.shape[:2], dtype=np.uint8)
    cv2.circle(mask, (x - left, y - top), radius, 1, -1)
    np.copyto(part, blurred.astype(np.uint8), where=mask[..., None] > 0)


def _pixel(point: Array) -> tuple[int, int]:
    """Round to a pixel, limited to coordinates that OpenCV accepts."""
    x, y = np.clip(np.round(point), -30_000, 30_000).astype(int).tolist()
    return x, y
