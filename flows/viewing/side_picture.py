"""The side picture: 2D poses, over their image if there is one; joints can be dragged.

A page reports the pointer as shares of the picture's size (`server.py`), so the picture may have any size, as in the
window that enlarges it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from flows.viewing.scene import Flat
from pasdedeux.arrays import Array
from pasdedeux.evaluation.pictures import person_rgb, shade_of

DRAG_LABEL = "2D: drag a joint"
"""Label of the picture while joints can be dragged, by which the script in the page finds it."""
PAPER = 250
INK = (60, 60, 60)
_SIZE, _IMAGE_SIZE, _SMALL_SIZE = (640, 480), (960, 720), (320, 240)
"""Largest sizes of a panel of 2D poses alone, of one with an image, and of one of several."""
_TITLE_PX = 20
_REACH = 0.04
"""Largest distance at which a joint is grabbed, as a share of the panel's width."""


@dataclass(frozen=True)
class Pointer:
    """Position of a pointer as shares of the picture's width and height, and its action."""

    phase: Literal["down", "move", "up"]
    across: float
    down: float


@dataclass(frozen=True)
class Dragged:
    """A dragged joint: person, joint, target (2,) in pixels of the image, and whether it was released."""

    person: int
    joint: int
    point_px: Array
    is_last: bool


@dataclass(frozen=True)
class PicturePanel:
    """Place of the image of 2D poses in the picture: corner, size, and scale."""

    corner: Array
    size: Array
    scale: float

    @classmethod
    def of(cls, flat: Flat, largest: tuple[int, int]) -> PicturePanel:
        """Return the largest panel of 2D poses that fits below a title."""
        scale = min(largest[0] / flat.size_px[0], (largest[1] - _TITLE_PX) / flat.size_px[1])
        size = scale * np.array(flat.size_px)
        return cls(np.array([(largest[0] - size[0]) / 2, _TITLE_PX]), size, scale)

    def place(self, points_px: Array) -> Array:
        """Return the position of pixels of the image (..., 2) in the picture."""
        return np.asarray(self.corner + self.scale * points_px)

    def point(self, placed: Array) -> Array:
        """Return the pixel of the image (2,) at a place of the picture, or the nearest one."""
        return np.asarray(np.clip((placed - self.corner) / self.scale, 0.0, self.size / self.scale))


class SidePicture:
    """The picture in the panel; joints of its first 2D poses can be dragged while `on_drag` is set.

    Args:
        gui: The panel of the viewer.
    """

    def __init__(self, gui: Any) -> None:
        self._handle = gui.add_image(flat_picture([]), label=None, visible=False)
        self._on_drag: Callable[[Dragged], None] | None = None
        self.flats: Sequence[Flat] = ()
        """2D poses for the pointer: those of the current scene, also before they are drawn."""
        self._held: tuple[int, int] | None = None
        self.chosen: tuple[int, int] | None = None
        """Person and joint that a click far from all joints moves."""

    @property
    def on_drag(self) -> Callable[[Dragged], None] | None:
        """Receives dragged joints; None: nothing can be dragged."""
        return self._on_drag

    @on_drag.setter
    def on_drag(self, heard: Callable[[Dragged], None] | None) -> None:
        self._on_drag = heard
        label = None if heard is None else DRAG_LABEL
        if self._handle.label != label:
            self._handle.label = label

    def draw(self, flats: Sequence[Flat]) -> None:
        """Draw 2D poses, or hide the picture without any."""
        if flats:
            self._handle.image = flat_picture(flats)
        if self._handle.visible is not bool(flats):
            self._handle.visible = bool(flats)

    def point(self, pointer: Pointer) -> None:
        """Grab the joint under a pointer, drag it, or release it."""
        if self._on_drag is None or not self.flats:
            self._held = None
            return
        flat, size = self.flats[0], picture_size(self.flats)
        panel = PicturePanel.of(flat, size)
        height, width = self._handle.image.shape[:2]
        placed = np.array([pointer.across * width, pointer.down * height])
        if pointer.phase == "down":
            self._held = joint_at(flat, panel, placed, _REACH * size[0]) or self.chosen
        if self._held is not None:
            self._on_drag(Dragged(*self._held, panel.point(placed), is_last=pointer.phase == "up"))
        if pointer.phase == "up":
            self._held = None


def joint_at(flat: Flat, panel: PicturePanel, placed: Array, reach: float) -> tuple[int, int] | None:
    """Return person and joint nearest to a place of the picture; None if none is in reach."""
    away = np.linalg.norm(panel.place(flat.points_px) - placed, axis=-1)
    if not (np.nan_to_num(away, nan=np.inf) <= reach).any():
        return None
    person, joint = np.unravel_index(int(np.nanargmin(away)), away.shape)
    return int(person), int(joint)


def picture_size(flats: Sequence[Flat]) -> tuple[int, int]:
    """Return width and height of the first panel of a picture; alone, or over film, it has the height of its image."""
    is_over_film = bool(flats) and flats[0].image is not None
    if len(flats) != 1 and not is_over_film:
        return _SMALL_SIZE
    width, height = _IMAGE_SIZE if is_over_film else _SIZE
    return width, min(height, int(width * flats[0].size_px[1] / flats[0].size_px[0]) + _TITLE_PX + 1)


def flat_picture(flats: Sequence[Flat]) -> Array:
    """Return 2D poses as one image (height, width, 3), RGB: a large first one above the others, two in a row.

    Below film, three in a row.
    """
    size = picture_size(flats)
    first = [] if size == _SMALL_SIZE else [_drawn(flats[0], size)]
    small = [_drawn(flat, _SMALL_SIZE) for flat in flats[len(first) :]] or ([] if first else [_paper(size)])
    in_row = max(1, (size[0] if first else min(len(small), 2) * size[0]) // _SMALL_SIZE[0])
    small += [_paper(_SMALL_SIZE)] * (-len(small) % in_row)
    return np.vstack([*first, *(np.hstack(small[at : at + in_row]) for at in range(0, len(small), in_row))])


def _paper(size: tuple[int, int]) -> Any:
    return np.full((*size[::-1], 3), PAPER, dtype=np.uint8)


def _drawn(flat: Flat, size: tuple[int, int]) -> Any:
    """Return a panel: the image or an empty frame, the bones of each person, and the title."""
    panel, image = PicturePanel.of(flat, size), _paper(size)
    (left, top), (right, bottom) = np.round(panel.corner).astype(int), np.round(panel.corner + panel.size).astype(int)
    seen = None if flat.image is None else flat.image()
    if seen is None:
        cv2.rectangle(image, (left, top), (right, bottom), (200, 200, 200), 1)
    else:
        image[top:bottom, left:right] = cv2.resize(seen, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    thick = max(2, size[0] // 280)
    for person, points in enumerate(flat.points_px):
        colour = np.array(person_rgb(person))
        placed = panel.place(points)
        for parent, child in flat.skeleton.bones:
            if np.isfinite(placed[[parent, child]]).all():
                start, end = (list(map(int, placed[joint] * 8)) for joint in (parent, child))
                shade = shade_of(flat.skeleton.joint_names[child])
                cv2.line(image, start, end, (shade * colour).tolist(), thick, cv2.LINE_AA, 3)
    font = 0.55 if size == _SMALL_SIZE else 0.6
    title = flat.title[: int(0.06 * size[0] / font)]
    cv2.putText(image, title, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, font, INK, 1, cv2.LINE_AA)
    return image
