"""A film that is cheap to make: two walkers of coco17, a patch of cloth at every joint, before a wall."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tests.builders.source_samples import person_px

NAMES = KEYPOINT_LAYOUTS["coco17"].keypoint_names


def scene(seed: int) -> np.ndarray:
    """Return a wall that a person can be painted on."""
    cells = np.random.default_rng(seed).uniform(40, 120, (15, 20, 3)).astype(np.float32)
    return cv2.resize(cells, (640, 480), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def walker_px(frame: int, person: int = 0) -> np.ndarray:
    """Return coco17 keypoints, whole pixels, of a person who walks to the right."""
    return np.asarray(np.round(person_px("coco17")) + np.array([200.0 * person + 2.0 * frame, 40.0]))


@cache
def patch(person: int, joint: int) -> np.ndarray:
    cells = np.random.default_rng(100 * person + joint).uniform(0, 255, (5, 5, 1)).astype(np.float32)
    return np.repeat(cv2.resize(cells, (25, 25), interpolation=cv2.INTER_CUBIC).clip(0, 255)[..., None], 3, axis=2)


def painted(seed: int, frame: int) -> np.ndarray:
    """Return an image with two walkers: a patch of their own at every joint."""
    image = scene(seed)
    for person in range(2):
        for joint, (x, y) in enumerate(walker_px(frame, person).astype(int).tolist()):
            image[y - 12 : y + 13, x - 12 : x + 13] = patch(person, joint)
    return image


def write_keys(path: Path, frames: Iterable[int], *, notes: str = "", scale: tuple[float, float] = (1.0, 1.0)) -> Path:
    """Write both walkers in these frames as our CSV, pixels times a scale."""
    lines = [f"# layout: coco17\n{notes}frame,person,joint,x,y"]
    for frame in frames:
        for person in range(2):
            for name, (x, y) in zip(NAMES, walker_px(frame, person) * scale, strict=True):
                lines.append(f"{frame},{person},{name},{x:.6f},{y:.6f}")
    path.write_text("\n".join(lines) + "\n")
    return path
