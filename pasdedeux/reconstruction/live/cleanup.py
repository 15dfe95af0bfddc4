"""Clean-up of a motion that is still going on: what `cleanup` does to a whole one, a frame at a time and once for all.

A foot that slows down near the floor is planted where it is shown at that moment and stays there.  The way of the body
follows what its planted feet say, within a moment and never by a jump; what is left is taken up by the legs.  A foot
that leaves goes back to where it is seen within the time of a blend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14

__all__ = ["LiveCleanUp", "LiveCleanUpOptions"]

Array = npt.NDArray[np.float64]

_LEGS = np.array([OP14.indices([f"{side}_{name}" for name in ("hip", "knee", "ankle")]) for side in ("left", "right")])
_UP, _AWAY = 1, 2
_FLOOR_QUANTILE = 0.1
_STRAIGHT = 1.0 - 1e-6
_LEAST_BEND_M = 1e-4
_LEAVING = 1.5
"""A planted foot is let go of at this many times the speed and the height that it was planted at."""


@dataclass(frozen=True)
class LiveCleanUpOptions:
    """What counts as a planted foot, and how far a motion may be changed.

    Args:
        contact_speed_m_s: Feet slower than this may be planted.
        away_share: Part of the speed along z, away from the camera, that counts: one camera sees it badly.
        contact_height_m: Feet lower than this over the lower foot and, twice this, over the floor may be planted.
        floor_s: The floor is that of the last so many seconds.
        way_s: The body's way follows its planted feet within this time.
        hold_s: A correction of the way fades over this time while no foot is planted.
        blend_s: A foot that is let go of comes back to its place over this time.
        most_bend_m: The legs move a foot by at most this.
        most_drift_m: A planted foot that is seen further away than this has left.
    """

    contact_speed_m_s: float = 0.45
    away_share: float = 0.25
    contact_height_m: float = 0.05
    floor_s: float = 1.5
    way_s: float = 0.2
    hold_s: float = 2.0
    blend_s: float = 0.12
    most_bend_m: float = 0.04
    most_drift_m: float = 0.12

    def __post_init__(self) -> None:
        """Refuse values without meaning."""
        times = (self.floor_s, self.way_s, self.hold_s, self.blend_s)
        if min(self.contact_speed_m_s, self.contact_height_m, *times) <= 0:
            raise InputError(f"live clean-up: speeds, heights and times must be positive: {self}")
        if min(self.away_share, self.most_bend_m, self.most_drift_m) < 0:
            raise InputError(f"live clean-up: shares and ways must not be negative: {self}")


class LiveCleanUp:
    """One person's clean-up as poses leave; the state is this person's alone.

    Args:
        rate_hz: Frames per second.
        options: How.
    """

    def __init__(self, rate_hz: float, options: LiveCleanUpOptions | None = None) -> None:
        self._options = options or LiveCleanUpOptions()
        self._rate_hz = rate_hz
        self._frame: int | None = None
        self._heights: Array = np.full(max(2, round(self._options.floor_s * rate_hz)), np.nan)
        self._is_planted = np.zeros(2, dtype=np.bool_)
        self._raw_m = np.zeros((2, 3))
        self._anchor_m = np.zeros((2, 3))
        self._offset_m = np.zeros((2, 3))
        self._shift_m = np.zeros(3)

    @property
    def is_planted(self) -> npt.NDArray[np.bool_]:
        """Tell whether the left and the right foot are planted now (2,)."""
        return self._is_planted.copy()

    def step(self, frame: int, positions_m: Array) -> Array:
        """Return a pose (14, 3), upright axes (y up, z towards the camera), cleaned up; bones keep their lengths.

        Args:
            frame: Its number, after that of the pose before.
            positions_m: The pose with its place, metres.
        """
        passed_s = 0.0 if self._frame is None else (frame - self._frame) / self._rate_hz
        self._heights[frame % len(self._heights)] = positions_m[_LEGS[:, 2], _UP].min()
        self._frame = frame
        one = self._options
        return _clean_pose(
            positions_m,
            passed_s,
            _low_quantile(self._heights, _FLOOR_QUANTILE),
            self._is_planted,
            self._raw_m,
            self._anchor_m,
            self._offset_m,
            self._shift_m,
            (
                one.contact_speed_m_s,
                one.away_share,
                one.contact_height_m,
                one.way_s,
                one.hold_s,
                one.blend_s,
                one.most_bend_m,
                one.most_drift_m,
            ),
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _low_quantile(values: Array, share: float) -> float:
    """Return the value that this share of the finite ones is below."""
    known = np.sort(values[np.isfinite(values)])
    return known[int(share * (known.shape[0] - 1))]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _clean_pose(
    positions: Array,
    passed: float,
    floor: float,
    is_planted: npt.NDArray[np.bool_],
    raw: Array,
    anchor: Array,
    offset: Array,
    shift: Array,
    options: tuple[float, float, float, float, float, float, float, float],
) -> Array:
    """Return the cleaned pose (14, 3) and bring the state of both feet and of the way up to it."""
    speed_limit, away_share, height_limit, way_s, hold_s, blend_s, most_bend, most_drift = options
    legs, up = _LEGS, _UP
    lower = min(positions[legs[0, 2], up], positions[legs[1, 2], up])
    wanted = np.zeros(3)
    count = 0
    for foot in range(2):
        ankle = legs[foot, 2]
        slack = _LEAVING if is_planted[foot] else 1.0
        is_slow = False
        if passed > 0.0:
            squared = 0.0
            for axis in range(3):
                part = (positions[ankle, axis] - raw[foot, axis]) / passed
                if axis == _AWAY:
                    part *= away_share
                squared += part * part
            is_slow = squared < (slack * speed_limit) ** 2
        height = positions[ankle, up]
        stays = is_slow and height < lower + slack * height_limit and height < floor + 2.0 * slack * height_limit
        if stays and is_planted[foot]:
            drift = 0.0
            for axis in range(3):
                drift += (anchor[foot, axis] - positions[ankle, axis] - shift[axis]) ** 2
            stays = drift < most_drift**2
        if stays and not is_planted[foot]:
            for axis in range(3):
                anchor[foot, axis] = positions[ankle, axis] + shift[axis] + offset[foot, axis]
            anchor[foot, up] = max(anchor[foot, up], floor)
        is_planted[foot] = stays
        for axis in range(3):
            raw[foot, axis] = positions[ankle, axis]
            if stays:
                wanted[axis] += anchor[foot, axis] - positions[ankle, axis]
        count += stays
    for axis in range(3):
        if count > 0:
            shift[axis] += (1.0 - np.exp(-passed / way_s)) * (wanted[axis] / count - shift[axis])
        else:
            shift[axis] *= np.exp(-passed / hold_s)
    cleaned = positions + shift
    facing = _facing(cleaned)
    for foot in range(2):
        hip, knee, ankle = legs[foot, 0], legs[foot, 1], legs[foot, 2]
        if is_planted[foot]:
            squared = 0.0
            for axis in range(3):
                offset[foot, axis] = anchor[foot, axis] - cleaned[ankle, axis]
                squared += offset[foot, axis] ** 2
            if squared > most_bend**2:
                offset[foot] *= most_bend / np.sqrt(squared)
        else:
            offset[foot] *= np.exp(-passed / blend_s)
        target = cleaned[ankle] + offset[foot]
        target[up] = max(target[up], floor)
        _bend(cleaned, hip, knee, ankle, target, facing)
    return cleaned


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _facing(positions: Array) -> Array:
    """Return where the body faces (3,), level."""
    across = positions[_LEGS[0, 0]] - positions[_LEGS[1, 0]]
    facing = np.array([-across[2], 0.0, across[0]])
    length = np.sqrt((facing**2).sum())
    return facing / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bend(positions: Array, hip: int, knee: int, ankle: int, target: Array, facing: Array) -> None:
    """Do `cleanup.bend_leg` for one leg, in place."""
    start, middle, end = positions[hip], positions[knee].copy(), positions[ankle].copy()
    thigh, shank = np.sqrt(((middle - start) ** 2).sum()), np.sqrt(((end - middle) ** 2).sum())
    old_line, line = end - start, target - start
    old_reach, reach = np.sqrt((old_line**2).sum()), np.sqrt((line**2).sum())
    down = np.array([0.0, -1.0, 0.0])
    old_line = old_line / old_reach if old_reach > 1e-12 else down
    line = line / reach if reach > 1e-12 else down
    reach = min(max(reach, abs(thigh - shank) + _LEAST_BEND_M), _STRAIGHT * (thigh + shank))
    bend = (middle - start) - ((middle - start) * old_line).sum() * old_line
    if np.sqrt((bend**2).sum()) <= _LEAST_BEND_M:
        bend = facing
    pole = bend - (bend * line).sum() * line
    length = np.sqrt((pole**2).sum())
    pole = pole / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    along = (thigh**2 - shank**2 + reach**2) / (2.0 * reach)
    aside = np.sqrt(max(thigh**2 - along**2, 0.0))
    positions[knee] = start + along * line + aside * pole
    positions[ankle] = start + reach * line
