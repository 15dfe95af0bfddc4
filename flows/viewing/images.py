"""Pictures of the viewer that are pixels: 2D poses, who is there over time, and clips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flows.viewing.bodies import rgb
from flows.viewing.scene import Flat
from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.evaluation.pictures import PERSON_COLOURS, shade_of

_PANEL = (320, 240)
_PAPER, _INK = 250, (60, 60, 60)


def flat_panels(flats: Sequence[Flat]) -> Array:
    """Return 2D poses as one image (height, width, 3), RGB, two panels in a row."""
    panels = [_panel(flat) for flat in flats] or [_blank(_PANEL[1])]
    if len(panels) > 1:
        if len(panels) % 2:
            panels.append(np.full_like(panels[0], _PAPER))
        panels = [np.hstack(panels[row : row + 2]) for row in range(0, len(panels), 2)]
    return np.vstack(panels)


def _panel(flat: Flat) -> Any:
    import cv2

    width, height = flat.size_px
    scale = min(_PANEL[0] / width, (_PANEL[1] - 20) / height)
    image = _blank(_PANEL[1])
    low = np.array([(_PANEL[0] - scale * width) / 2, 20.0])
    corner = low + scale * np.array([width, height])
    cv2.rectangle(image, list(map(int, low)), list(map(int, corner)), (200, 200, 200), 1)
    for person, points in enumerate(flat.points_px):
        colour = np.array(rgb(PERSON_COLOURS[person % len(PERSON_COLOURS)]))
        placed = low + scale * points
        for parent, child in flat.skeleton.bones:
            if np.isfinite(placed[[parent, child]]).all():
                start, end = (list(map(int, placed[joint] * 8)) for joint in (parent, child))
                shade = shade_of(flat.skeleton.joint_names[child])
                cv2.line(image, start, end, (shade * colour).tolist(), 2, cv2.LINE_AA, 3)
    cv2.putText(image, flat.title[:52], (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.36, _INK, 1, cv2.LINE_AA)
    return image


def _blank(height: int) -> Any:
    return np.full((height, _PANEL[0], 3), _PAPER, dtype=np.uint8)


def presence_strip(is_there: Flags, levels: Integers | None) -> Array:
    """Return who is there (frame, person) and how each frame was judged (frame,) as a strip, time to the right."""
    rows = [
        np.where(is_there[:, p, None], rgb(PERSON_COLOURS[p % len(PERSON_COLOURS)]), _PAPER)
        for p in range(is_there.shape[1])
    ]
    if levels is not None:
        rows.append(np.array([(120, 170, 120), (230, 170, 40), (200, 30, 50)])[levels])
    columns = np.linspace(0, len(is_there) - 1, _PANEL[0] * 2).round().astype(int)
    return np.repeat(np.stack(rows)[:, columns], 12, axis=0).astype(np.uint8)


def encode(image: Array, suffix: str) -> bytes:
    """Return an image (height, width, 3 or 4), RGB, as the bytes of a file of this kind."""
    import cv2

    return cv2.imencode(suffix, cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2BGR))[1].tobytes()


def encode_clip(images: Sequence[Array], rate_hz: float) -> bytes:
    """Return images (height, width, 3), RGB, as an animated WebP that repeats."""
    import cv2

    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(one[..., :3], cv2.COLOR_RGB2BGRA) for one in images]
    animation.durations = [round(1000.0 / rate_hz)] * len(images)
    animation.loop_count = 0
    return cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
