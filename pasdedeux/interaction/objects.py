"""Objects that people handle: capsules that move as they were captured in every variant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.errors import FormatError
from pasdedeux.formats.npz import get_array, is_npz, read_npz
from pasdedeux.formats.text import Lines, parse_integer, parse_number

FLOOR = "floor"
"""Name of the floor among objects."""
_ENDS = [f"{axis}_{end}_m" for end in ("start", "end") for axis in "xyz"]
_COLUMNS = ("frame", "name", *_ENDS, "radius_m")
_LARGEST_M = 100.0
"""Coordinates and radii beyond this must be in another unit."""


@dataclass(frozen=True)
class MovingObjects:
    """Capsules in the world over time.

    Args:
        names: Their names.
        ends_m: Both ends of each axis (frame, capsule, 2, 3), metres; equal for a sphere.
        radii_m: Their radii (capsule,), metres.
    """

    names: tuple[str, ...]
    ends_m: Array
    radii_m: Array

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.ends_m)

    def at(self, frames: slice) -> MovingObjects:
        """Return them in some frames."""
        return replace(self, ends_m=self.ends_m[frames])

    def closest_m(self, people_m: Array) -> Array:
        """Return the least distance (capsule,), metres, of each axis to joints of people (frame, person, joint, 3)."""
        joints = merge_axes(people_m, 1, -1)
        closest = []
        for start, end in self.ends_m.transpose(1, 2, 0, 3)[..., None, :]:
            axis = end - start
            share = ((joints - start) * axis).sum(axis=-1) / np.maximum((axis**2).sum(axis=-1), 1e-12)
            nearest = start + np.clip(share, 0.0, 1.0)[..., None] * axis
            closest.append(np.linalg.norm(joints - nearest, axis=-1).min())
        return np.array(closest)


def read_objects(data: bytes) -> MovingObjects:
    """Read the capsules of a take, in its files' axes, metres; a sphere is a capsule with equal ends.

    CSV has the columns frame, name, x_start_m, y_start_m, z_start_m, x_end_m, y_end_m, z_end_m, radius_m, a row for
    each frame and capsule, all frames from 0 on.  An npz has `names` (capsule,), `ends_m` (frame, capsule, 2, 3) and
    `radii_m` (capsule,).

    Raises:
        FormatError: Something is missing, repeated, not a number or absurd; the line or array is named.
    """
    return _of_arrays(data) if is_npz(data) else _of_table(data)


def _of_arrays(data: bytes) -> MovingObjects:
    arrays = read_npz(data, "archive of objects")
    names = get_array(arrays, "names", "U", (None,))
    ends = get_array(arrays, "ends_m", "fiu", (None, len(names), 2, 3))
    radii = get_array(arrays, "radii_m", "fiu", (len(names),))
    return _checked(tuple(map(str, names)), ends.astype(np.float64), radii.astype(np.float64))


def _of_table(data: bytes) -> MovingObjects:
    by_object: dict[tuple[int, str], list[float]] = {}
    with Lines(data, "table of objects") as lines:
        for row in lines.table(_COLUMNS)[1]:
            key = parse_integer(row["frame"], "frame"), row["name"]
            if key in by_object:
                raise FormatError(f"frame {key[0]} of '{key[1]}' is there twice")
            by_object[key] = [parse_number(row[name], name) for name in (*_ENDS, "radius_m")]
    names = tuple(dict.fromkeys(name for _, name in by_object))
    frames = 1 + max((frame for frame, _ in by_object), default=-1)
    # The first missing row comes early, however large a frame number is.
    all_of_them = ((frame, name) for frame in range(frames) for name in names)
    missing_key = next((key for key in all_of_them if key not in by_object), None)
    if missing_key:
        raise FormatError(
            f"frame {missing_key[0]} of '{missing_key[1]}' is missing; needed are all from 0 to {frames - 1}"
        )
    values = np.array([[by_object[frame, name] for name in names] for frame in range(frames)])
    values = values.reshape(frames, len(names), 7)
    radii = np.median(values[..., 6], axis=0) if frames else np.zeros(0)
    if (values[..., 6] != radii).any():
        frame, index = np.argwhere(values[..., 6] != radii)[0]
        raise FormatError(f"frame {frame}: the radius of '{names[index]}' changes; objects keep their size")
    return _checked(names, values[..., :6].reshape(frames, len(names), 2, 3), radii)


def _checked(names: tuple[str, ...], ends_m: Array, radii_m: Array) -> MovingObjects:
    if not names or not len(ends_m):
        raise FormatError("there is no object in it")
    if len(set(names)) < len(names) or not all(names):
        raise FormatError("every capsule needs a name of its own")
    is_bad = ~(np.abs(ends_m) < _LARGEST_M).all(axis=(2, 3))
    if is_bad.any():
        frame, index = np.argwhere(is_bad)[0]
        raise FormatError(
            f"frame {frame}: '{names[index]}' is not finite or further than {_LARGEST_M:g} m from the origin; "
            "are these metres?"
        )
    is_size = (radii_m >= 0) & (radii_m < _LARGEST_M)
    if not is_size.all():
        index = int(np.argmin(is_size))
        raise FormatError(f"the radius of '{names[index]}' is {radii_m[index]:g}; allowed are 0 to {_LARGEST_M:g} m")
    if FLOOR in names:
        raise FormatError(f"no capsule may be called {FLOOR}: that is what contacts call the floor")
    return MovingObjects(names, ends_m, radii_m)
