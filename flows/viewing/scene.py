"""A scene of the viewer: people over time, figures for comparison, and facts about each frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.skeletons import Skeleton


@dataclass(frozen=True)
class People:
    """People over time: positions (frame, person, joint, 3), metres, Y up, NaN for absent people."""

    skeleton: Skeleton
    positions_m: Array

    def frame(self, number: int) -> Array:
        """Return one frame (person, joint, 3) in double precision."""
        return np.asarray(self.positions_m[number], dtype=np.float64)


@dataclass(frozen=True)
class Flat:
    """2D poses of a frame (person, joint, 2), y down, NaN: missing, with size and title of their image.

    `image` reads the image (height, width, 3), RGB, of any size, or returns None if it is gone; None without an image.
    """

    skeleton: Skeleton
    points_px: Array
    size_px: tuple[int, int]
    title: str
    image: Callable[[], Array | None] | None = None


@dataclass(frozen=True)
class Scene:
    """One item of the store, ready to be shown.

    Args:
        people: The people.
        frame_of_row: The frame of each row of the item (row,).
        rate_hz: Frames per second; None if the frames are no motion.
        flat: The 2D poses of `people`, standing in the room.
        behind: Figures for comparison: the source of a variant, the capture behind a reconstruction.
        behind_name: Their name.
        ends_m: Ends of the axes of objects (frame, object, 2, 3), metres, with `radii_m` (object,).
        camera: Camera of the footage.
        film: Returns the camera's image of a frame (height, width, 3), RGB; None without one.
        curves: Figures over the frames (frame,), by name.
        others: The first of these figures for other chains of the same seed (frame,), NaN after their end.
        levels: Verdict of each frame: 0 passes, 1 warns, 2 fails.
        facts: Facts about the item, a line each.
        say: Returns facts about a frame, a line each.
        images: Returns the 2D pictures of a frame.
        nearest: Returns the nearest poses of the database as pictures, which takes time.
        numbers: Stored numbers of the frames (frame,), rising, with gaps without people.
        has_floor: Whether the floor is at y = 0; else it is drawn under the lowest joint.
    """

    people: People
    frame_of_row: Integers
    rate_hz: float | None = None
    flat: People | None = None
    behind: People | None = None
    behind_name: str = ""
    ends_m: Array | None = None
    radii_m: Array | None = None
    camera: PinholeCamera | None = None
    film: Callable[[int], Array | None] | None = None
    curves: Mapping[str, Array] = field(default_factory=dict)
    others: Sequence[Array] = ()
    levels: Integers | None = None
    facts: tuple[str, ...] = ()
    say: Callable[[int], list[str]] = lambda frame: []
    images: Callable[[int], list[Flat]] = lambda frame: []
    nearest: Callable[[int], list[Flat]] | None = None
    numbers: Integers | None = None
    has_floor: bool = True

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.people.positions_m)

    @cached_property
    def is_flat(self) -> bool:
        """Whether the people are an image that stands in the room."""
        return bool(np.fmax.reduce(np.abs(self.people.positions_m[..., 2]), axis=None, initial=0.0) == 0.0)

    def number_of(self, frame: int) -> int:
        """Return the stored number of a frame."""
        return frame if self.numbers is None else int(self.numbers[frame])

    def frame_at(self, number: int) -> int:
        """Return the frame of a stored number, or the next one if that is in a gap."""
        return number if self.numbers is None else int(np.searchsorted(self.numbers, number))

    def row_of(self, frame: int) -> int:
        """Return the first row of a frame in the item."""
        return int(np.flatnonzero(self.frame_of_row == frame)[0])


@dataclass(frozen=True)
class Grid:
    """Arranges rows by frame and person: the frame and person of each row (row,)."""

    frames: Integers
    persons: Integers
    frame_of_row: Integers
    person_of_row: Integers

    @classmethod
    def of(cls, frames: Any, persons: Any) -> Grid:
        """Sort rows, given their frames and people, into a grid."""
        numbers, at = np.unique(np.asarray(frames), return_inverse=True)
        people, who = np.unique(np.asarray(persons), return_inverse=True)
        return cls(numbers, people, at, who)

    def fill(self, values: Array) -> Array:
        """Return values (row, ...) as (frame, person, ...), NaN where there is no row."""
        filled = np.full((len(self.frames), len(self.persons), *values.shape[1:]), np.nan, dtype=np.float32)
        filled[self.frame_of_row, self.person_of_row] = values
        return filled

    def first(self, values: Any) -> Any:
        """Return the value of the first row of each frame (frame, ...)."""
        return np.asarray(values)[np.unique(self.frame_of_row, return_index=True)[1]]
