"""Moving people for the report: positions packed small, which the page's own player draws and lets a reader turn.

Left limbs are drawn darker than right ones, so that a mirrored figure is seen at a glance.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.skeletons import Skeleton

PERSON_COLOURS = ("#c1440e", "#1f5fa8", "#8a5a9e", "#b58900", "#3f7f7f")
"""Colours of person A, B, ... in every picture; a sixth person has the first one again."""
COLOUR_NAMES = ("orange", "blue", "purple", "ochre", "teal")
"""What these are called."""
_TRUTH_COLOUR, _LINK_COLOUR, _OBJECT_COLOUR = "#8c8c8c", "#111111", "#777777"
_SHADES = {"left_": 0.62, "right_": 1.0}
"""Brightness of left and right limbs."""
_SHADE_BETWEEN = 0.85

_MISSING = -32768
_UNIT_M = 0.001
"""Positions are kept to the millimetre, coarser only where people are further apart than int16 reaches."""
_MAX_RATE_HZ = 12.5
_MAX_S = 5.0


@dataclass(frozen=True)
class Figure:
    """One person: positions (frame, joint, 3) in metres, Y up, NaN where not there, and a colour."""

    skeleton: Skeleton
    positions_m: Array
    colour: str
    is_thin: bool = False


@dataclass(frozen=True)
class Panel:
    """What is shown beside others: a title, people, ends (frame, n, 2, 3) of contacts and of objects' axes, NaN: none.

    A flat panel is not turned: it shows an image, whose middle is the origin.
    """

    title: str
    figures: tuple[Figure, ...]
    links_m: Array | None = None
    objects_m: Array | None = None
    is_flat: bool = False


def people_panel(
    title: str,
    skeleton: Skeleton,
    people_m: Array,
    links_m: Array | None = None,
    objects_m: Array | None = None,
    *,
    truth_m: Array | None = None,
) -> Panel:
    """Return the panel of people (frame, person, joint, 3) in everybody's colour, over the thin grey ground truth."""
    behind = [] if truth_m is None else [truth_m[:, person] for person in range(truth_m.shape[1])]
    colours = zip(range(people_m.shape[1]), cycle(PERSON_COLOURS), strict=False)
    figures = (
        *(Figure(skeleton, one, _TRUTH_COLOUR, is_thin=True) for one in behind),
        *(Figure(skeleton, people_m[:, person], colour) for person, colour in colours),
    )
    return Panel(title, figures, links_m, objects_m)


def image_panel(title: str, skeleton: Skeleton, people_px: Array, size_px: tuple[int, int]) -> Panel:
    """Return the panel of an image and its edge: people (frame, person, joint, 2), pixels, y down, NaN: missing."""
    width, height = size_px
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    edge = np.broadcast_to(np.stack([edge, np.roll(edge, -1, axis=0)], axis=1), (len(people_px), 4, 2, 2))

    def placed(points_px: Array) -> Array:
        return np.insert((points_px - [width / 2, height / 2]) * [1.0, -1.0] / height, 2, 0.0, axis=-1)

    return replace(people_panel(title, skeleton, placed(people_px), None, placed(edge)), is_flat=True)


def shown_frames(num_frames: int, rate_hz: float) -> tuple[npt.NDArray[np.int64], float]:
    """Return the frames of a motion that are shown, some seconds from its middle, thinned, and their rate.

    >>> shown_frames(300, 30.0)[0][:3], shown_frames(300, 30.0)[1]
    (array([75, 77, 79]), 15.0)
    """
    step = max(1, round(rate_hz / _MAX_RATE_HZ))
    count = min(num_frames, max(1, round(_MAX_S * rate_hz)))
    start = (num_frames - count) // 2
    return np.arange(start, start + count, step), rate_hz / step


def pack_player(
    panels: Sequence[Panel], *, rate_hz: float, labels: Sequence[str] = (), has_floor: bool = True
) -> bytes:
    """Return what the page's player shows, as JSON; the same panels always give the same bytes.

    Args:
        panels: Panels of the same number of frames.
        rate_hz: Frames per second.
        labels: A label for each frame; its time where there are none.
        has_floor: The floor, y = 0, is drawn.
    """
    num_frames = len(panels[0].figures[0].positions_m) if panels and panels[0].figures else 0
    skeletons: list[Skeleton] = []
    parts: list[Array] = []
    num_points = 0

    def add(points: Array) -> int:
        nonlocal num_points
        parts.append(points.reshape(num_frames, int(np.prod(points.shape[1:-1])), 3))
        num_points += parts[-1].shape[1]
        return num_points - parts[-1].shape[1]

    described = []
    for panel in panels:
        figures, lines = [], []
        for figure in panel.figures:
            if figure.skeleton not in skeletons:
                skeletons.append(figure.skeleton)
            figures.append(
                {
                    "skeleton": skeletons.index(figure.skeleton),
                    "start": add(figure.positions_m),
                    "num_points": figure.skeleton.num_joints,
                    "colour": figure.colour,
                    "is_thin": figure.is_thin,
                }
            )
        for ends, colour, width in (
            (panel.objects_m, _OBJECT_COLOUR, 1 if panel.is_flat else 6),
            (panel.links_m, _LINK_COLOUR, 2),
        ):
            if ends is not None and ends.size:
                lines.append({"start": add(ends), "num_lines": ends.shape[1], "colour": colour, "width": width})
        described.append({"title": panel.title, "figures": figures, "lines": lines, "is_flat": panel.is_flat})
    points = np.concatenate(parts, axis=1) if parts else np.zeros((0, 0, 3))
    points = np.where(np.isfinite(points).all(axis=-1, keepdims=True), points, np.nan)
    unit = (
        max(_UNIT_M, float(np.nanmax(np.abs(points), initial=0.0)) / 32000.0) if np.isfinite(points).any() else _UNIT_M
    )
    whole = np.where(np.isfinite(points), np.round(points / unit), _MISSING).astype("<i2")
    scene = {
        "rate_hz": round(rate_hz, 6),
        "num_frames": num_frames,
        "num_points": num_points,
        "unit_m": unit,
        "has_floor": has_floor,
        "labels": list(labels),
        "skeletons": [_described(skeleton) for skeleton in skeletons],
        "panels": described,
        "data": base64.b64encode(whole.tobytes()).decode(),
    }
    return json.dumps(scene, separators=(",", ":"), allow_nan=False).encode()


def _described(skeleton: Skeleton) -> dict[str, object]:
    names = skeleton.joint_names
    shades = [
        next((shade for side, shade in _SHADES.items() if name.startswith(side)), _SHADE_BETWEEN) for name in names
    ]
    return {
        "bones": [[parent, child, shades[child]] for parent, child in skeleton.bones],
        "head": skeleton.index("head"),
    }
