"""Pictures of the viewer that are pixels: curves, who is there over time, and clips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flows.viewing.bodies import rgb
from flows.viewing.side import PAPER
from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.evaluation.pictures import PERSON_COLOURS

_WIDTH = 640
_INK = (60, 60, 60)


def presence_strip(is_there: Flags, levels: Integers | None) -> Array:
    """Return who is there (frame, person) and how each frame was judged (frame,) as a strip, time to the right."""
    rows = [
        np.where(is_there[:, p, None], rgb(PERSON_COLOURS[p % len(PERSON_COLOURS)]), PAPER)
        for p in range(is_there.shape[1])
    ]
    if levels is not None:
        rows.append(np.array([(120, 170, 120), (230, 170, 40), (200, 30, 50)])[levels])
    columns = np.linspace(0, len(is_there) - 1, _WIDTH).round().astype(int)
    return np.repeat(np.stack(rows)[:, columns], 12, axis=0).astype(np.uint8)


def plot_curves(curves: Sequence[Array], frame: int) -> Any:
    """Return figures over the frames as an image: the last of them over the others, and a line at a frame."""
    import cv2

    height, width, edge = 170, _WIDTH, 22
    image = np.full((height, width, 3), PAPER, dtype=np.uint8)
    low, high = (take([take(one) for one in curves if np.isfinite(one).any()]) for take in (np.nanmin, np.nanmax))
    across = np.linspace(0, width - 1, len(curves[-1]))
    for number, curve in enumerate(curves, 1 - len(curves)):
        points = np.stack(
            [across, height - edge - (curve - low) / max(high - low, 1e-12) * (height - 2 * edge)], axis=-1
        )
        is_there = np.isfinite(points[:, 1])
        runs = np.split(points[is_there], np.flatnonzero(np.diff(np.flatnonzero(is_there)) > 1) + 1)
        colour = rgb(PERSON_COLOURS[(number + 2) % 3 + 2]) if number else rgb(PERSON_COLOURS[1])
        cv2.polylines(image, [np.round(8 * run).astype(np.int32) for run in runs], False, colour, 1, cv2.LINE_AA, 3)
    at = round(across[min(frame, len(across) - 1)])
    cv2.line(image, [at, 0], [at, height], rgb(PERSON_COLOURS[0]), 2)
    for value, y in ((high, edge - 4), (low, height - 4)):
        cv2.putText(image, f"{value:.3g}", (4, y), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _INK, 1, cv2.LINE_AA)
    return image


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
