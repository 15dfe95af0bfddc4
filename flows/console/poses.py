"""A pose at the terminal: drawn in braille cells, eight dots a letter, beside its numbers by joint."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_uppercase

import numpy as np
import numpy.typing as npt

from flows.console.display import format_table
from pasdedeux.arrays import Array
from pasdedeux.skeletons import WORKING_SKELETONS

_BRAILLE = 0x2800
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a cell's dots, four rows of two (Unicode, block Braille Patterns)."""
_WIDTH, _HEIGHT = 26, 17
_VIEWS = {2: {"image": (0, 1, 1.0)}, 3: {"front": (0, 1, -1.0), "side": (2, 1, -1.0)}}
"""Views by the number of axes: what goes right, what goes up or down, and its sign on the screen."""


def pose_lines(values: npt.NDArray[np.floating], joints: str, *, unit: str) -> list[str]:
    """Return the lines of people (*batch, joint, 2 or 3) of the working skeleton of this name.

    People in space are seen along -Z (front) and along +X (side), images as they are.  NaN, joints that are not there,
    are not drawn.
    """
    skeleton = WORKING_SKELETONS[joints]
    people = values.reshape(-1, *values.shape[-2:]).astype(np.float64)
    views = _VIEWS[people.shape[-1]]
    drawn = [_drawing(people[..., [right, down]] * [1.0, sign], skeleton.bones) for right, down, sign in views.values()]
    heading = "  ".join(f"{name:<{_WIDTH}}" for name in views)
    picture = [heading, *("  ".join(row) for row in zip(*drawn, strict=True))]
    header = [f"{letter} {axis}" for letter in ascii_uppercase[: len(people)] for axis in "xyz"[: people.shape[-1]]]
    decimals = 1 if unit == "px" else 3
    rows = [
        (name, *(f"{value:.{decimals}f}" if np.isfinite(value) else "-" for value in people[:, joint].ravel()))
        for joint, name in enumerate(skeleton.joint_names)
    ]
    numbers = format_table((f"joint ({unit})", *header), rows)
    height = max(len(picture), len(numbers))
    left = [*picture, *[" " * len(heading)] * (height - len(picture))]
    right = [*numbers, *[""] * (height - len(numbers))]
    return [f"{one}   {other}".rstrip() for one, other in zip(left, right, strict=True)]


def braille_lines(segments: Array, *, width: int, height: int) -> list[str]:
    """Draw segments (n, 2, 2) in dots, x right and y down, into width x height letters; nothing outside.

    >>> braille_lines(np.array([[[0.0, 0.0], [3.0, 3.0]]]), width=2, height=1)
    ['⠑⢄']
    """
    cells = np.zeros((height, width), dtype=np.int64)
    for start, end in segments[np.isfinite(segments).all(axis=(1, 2))]:
        steps = int(np.abs(end - start).max()) + 1
        dots = np.round(start + (end - start) * np.linspace(0.0, 1.0, steps + 1)[:, None]).astype(np.int64)
        column, row = dots[((dots >= 0) & (dots < (2 * width, 4 * height))).all(axis=1)].T
        np.bitwise_or.at(cells, (row // 4, column // 2), _DOTS[row % 4, column % 2])
    return ["".join(chr(_BRAILLE + cell) if cell else " " for cell in row) for row in cells.tolist()]


def _drawing(seen: Array, bones: Sequence[tuple[int, int]]) -> list[str]:
    """Draw people (person, joint, 2), y down, as large as fits."""
    finite = seen[np.isfinite(seen).all(axis=-1)]
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(2), np.ones(2))
    room = np.array([2 * _WIDTH - 1, 4 * _HEIGHT - 1])
    scale = float((room / np.maximum(high - low, 1e-9)).min())
    dots = (seen - (low + high) / 2.0) * scale + room / 2.0
    return braille_lines(dots[:, np.array(bones)].reshape(-1, 2, 2), width=_WIDTH, height=_HEIGHT)
